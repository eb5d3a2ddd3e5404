"""New routes and stops while PHASE drives, standing vehicles, and how vehicles are given back to SUMO."""

from __future__ import annotations

import csv
import math
import xml.etree.ElementTree as ET
from itertools import pairwise

import libsumo
import pytest

import phase_sumo
from phase_sumo.bridge.fleet.hand_back import HandBack
from phase_sumo.bridge.run import run_scenario
from phase_sumo.bridge.sumo.session import Simulation
from tests.helpers.places import NETWORKS
from tests.helpers.standin import Standin

CAR = '<vType id="car" length="4.8" width="1.9" speedDev="0" speedFactor="0.8"/>'
THROUGH, EXIT = "main0 main1 main2", "main0 main1 offramp1"


def vehicle(name, depart=0.0, route=THROUGH, inner="", lane="0", kind="car", **more):
    values = "".join(f' {key}="{value}"' for key, value in more.items())
    return (
        f'<vehicle id="{name}" type="{kind}" depart="{depart}" departLane="{lane}" departSpeed="18"{values}>'
        f'<route edges="{route}"/>{inner}</vehicle>'
    )


@pytest.fixture
def scenario(tmp_path):
    def write(*vehicles, network="f05_offramp3", additional="", end=60):
        (tmp_path / "demand.rou.xml").write_text(f"<routes>{CAR}{''.join(vehicles)}</routes>")
        (tmp_path / "more.add.xml").write_text(f"<additional>{additional}</additional>")
        path = tmp_path / "test.sumocfg"
        path.write_text(
            f'<configuration><input><net-file value="{NETWORKS / network}.net.xml"/>'
            '<route-files value="demand.rou.xml"/><additional-files value="more.add.xml"/></input>'
            f'<output><stop-output value="stops.xml"/><tripinfo-output value="trips.xml"/></output>'
            f'<time><end value="{end}"/><step-length value="0.1"/></time></configuration>'
        )
        return path

    return write


@pytest.fixture
def loop(scenario):
    """Runs a loop of the caller's own: (what to do at a time, in s) -> the fleet and each vehicle's edges."""
    fleets = []

    def run(*vehicles, do, at=1.0, end=60.0, **written):
        libsumo.start(["sumo", "-c", str(scenario(*vehicles, **written)), *phase_sumo.SUMO_OPTIONS])
        fleet = phase_sumo.PhaseFleet(libsumo, Standin())
        fleets.append(fleet)
        libsumo.addStepListener(fleet)
        edges: dict[str, list[str]] = {}
        while libsumo.simulation.getMinExpectedNumber() and libsumo.simulation.getTime() < end:
            libsumo.simulationStep()
            if abs(libsumo.simulation.getTime() - at) < 0.01:
                do(libsumo.vehicle)
            for name in libsumo.vehicle.getIDList():
                edge = libsumo.vehicle.getRoadID(name)
                if not edge.startswith(":") and edges.setdefault(name, [edge])[-1] != edge:
                    edges[name].append(edge)
        return fleet, edges

    yield run
    for fleet in fleets:
        fleet.close()
    libsumo.close()


def reasons(events, kind):
    return [(event.vehicle, event.reason) for event in events if event.kind == kind]


def test_a_new_route_is_followed_whoever_gives_it(loop):
    def ask(api):
        api.setRoute("a", EXIT.split())
        api.changeTarget("b", "offramp1")

    fleet, edges = loop(vehicle("a"), vehicle("b", lane="1"), vehicle("c", lane="2"), do=ask)
    assert edges == {"a": EXIT.split(), "b": EXIT.split(), "c": THROUGH.split()}
    told = [(v, "a new route to offramp1") for v in "ab"]
    assert reasons(fleet.events, "reroute") == told
    assert not reasons(fleet.events, "wrong exit")
    assert fleet.report()["phase_arrived_under_policy"] == 3


@pytest.mark.parametrize(
    "how",
    [
        '<routeProbReroute id="exit"/>',
        '<destProbReroute id="offramp1"/>',
        '<closingReroute id="main2"/><destProbReroute id="offramp1"/>',
    ],
)
def test_reroutings_of_the_scenario_are_followed(scenario, tmp_path, how):
    rerouter = (
        f'<route id="exit" edges="{EXIT}"/><rerouter id="r" edges="main0"><interval begin="0" end="100">'
        f"{how}</interval></rerouter>"
    )
    path = scenario(vehicle("a", 0.5, lane="1"), additional=rerouter)
    out = tmp_path / "out"
    result = run_scenario(path, policy=Standin(), seed=1, output_dir=out)
    trip = ET.parse(out / "trips.xml").getroot()[0]
    assert trip.get("arrivalLane") == "offramp1_0"
    assert result["accounts"]["arrived"] == 1


def test_a_stop_told_on_the_way_is_made_and_the_vehicle_taken_back(loop, tmp_path):
    fleet, edges = loop(
        vehicle("a"), do=lambda api: api.setStop("a", "main2", 20, 0, 3), network="f05_offramp3", end=90
    )
    assert edges["a"] == THROUGH.split()
    assert reasons(fleet.events, "hand-back")[0] == ("a", "a stop ahead")
    assert reasons(fleet.events, "adoption")[-1] == ("a", "taken back")
    fleet.close()
    libsumo.close()
    libsumo.start(["sumo", "-n", str(NETWORKS / "f05_offramp3.net.xml"), *phase_sumo.SUMO_OPTIONS])
    stops = ET.parse(tmp_path / "stops.xml").getroot().findall("stopinfo")
    assert [(stop.get("id"), stop.get("lane")) for stop in stops] == [("a", "main2_0")]


def test_vehicles_arrive_where_the_demand_says(scenario, tmp_path):
    out = tmp_path / "out"
    path = scenario(vehicle("a", arrivalPos="60"), vehicle("b", 3.0))
    assert run_scenario(path, policy=Standin(), seed=1, output_dir=out)["phase_arrived_under_policy"] >= 1
    places = {t.get("id"): float(t.get("arrivalPos", "nan")) for t in ET.parse(out / "trips.xml").getroot()}
    assert 60.0 <= places["a"] < 75.0
    assert places["b"] > 160.0


def test_lines_and_taxis_stay_sumos(scenario, tmp_path):
    taxi = '<param key="has.taxi.device" value="true"/>'
    path = scenario(vehicle("car"), vehicle("bus", 2.0, line="7"), vehicle("taxi", 4.0, inner=taxi), end=6)
    run_scenario(path, policy=Standin(), seed=1, output_dir=tmp_path / "out")
    with (tmp_path / "out" / "trips.csv").open() as file:
        assert {row["vehicle"] for row in csv.DictReader(file) if row["adopted"] == "1"} == {"car"}


def test_who_stands_on_a_lane_is_passed_without_a_contact(scenario):
    stands = '<stop lane="main0_1" endPos="400" duration="60"/>'
    broken = vehicle("broken", 0.0, "main0", stands, "1", departPos="390").replace('Speed="18"', 'Speed="0"')
    cars = [vehicle(f"v{k}", 1.0 + 2.0 * k, "main0", lane=f"{k % 3}") for k in range(12)]
    result = run_scenario(
        scenario(broken, *cars, network="f01_straight3", end=90), policy=Standin(), seed=1, end=90.0
    )
    assert result["phase_vehicles"] == 13
    assert result["collisions"] == 0
    assert result["phase_arrived_under_policy"] >= 10


def put_out_of_order():
    """``a`` is moved past ``b`` within their lane; both are SUMO's then."""
    api = libsumo.vehicle
    libsumo.route.add("r", ["main0"])
    for name, place in (("a", 50.0), ("b", 100.0)):
        api.add(name, "r", departSpeed="10", departLane="1", departPos=str(place))
    libsumo.simulationStep()
    at = {name: api.getPosition(name) for name in "ab"}
    for _ in range(80):
        for name, metres in (("a", 2.2), ("b", 1.0)):
            yaw = math.radians(90.0 - api.getAngle(name))
            at[name] = at[name][0] + metres * math.cos(yaw), at[name][1] + metres * math.sin(yaw)
            api.moveToXY(name, "", -1, *at[name], api.getAngle(name), 2, 10)
        libsumo.simulationStep()


@pytest.mark.parametrize("repaired", [False, True])
def test_sumos_order_of_leaders_is_right_after_vehicles_passed_within_a_lane(repaired):
    options = ["--no-step-log", "true", "--step-length", "0.1", *phase_sumo.SUMO_OPTIONS]
    libsumo.start(["sumo", "-n", str(NETWORKS / "f01_straight3.net.xml"), *options])
    try:
        put_out_of_order()
        lane, place = "main0_1", libsumo.vehicle.getLanePosition
        back = HandBack(Simulation(libsumo))
        before = {name: place(name) for name in "ab"}
        assert before["a"] > before["b"]
        if repaired:
            back.order([lane])
            assert list(libsumo.lane.getLastStepVehicleIDs(lane)) == ["b", "a"]
            assert {name: place(name) for name in "ab"} == before
        for name in "ab":
            back.give(name) if repaired else None
        leader = libsumo.vehicle.getLeader("b", 100)
        assert (leader is not None and leader[0] == "a") == repaired
    finally:
        libsumo.close()


def test_a_vehicle_beside_the_middle_of_its_lane_is_given_back_without_a_jump(loop):
    places: list[float] = []

    def aside(api):
        places.append(api.getLateralLanePosition("a"))

    car = vehicle("a", route="main0", lane="1")
    fleet, _ = loop(car, do=aside, at=3.0, end=3.05, network="f01_straight3")
    table, row = fleet.scene.table, fleet.scene.table.row_of["a"]
    yaw = float(table["yaw"][row])
    table["x"][row] -= math.sin(yaw)
    table["y"][row] += math.cos(yaw)
    libsumo.simulationStep()
    libsumo.simulationStep()
    fleet.release("a")
    for _ in range(40):
        libsumo.simulationStep()
        aside(libsumo.vehicle)
    steps = [abs(b - a) for a, b in pairwise(places[1:])]
    assert abs(places[1]) > 0.5 and abs(places[-1]) < 1e-3
    assert max(steps) < 0.1
