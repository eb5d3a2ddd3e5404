"""Features of SUMO that change what a lane or a crossing allows: with PHASE as without it."""

from __future__ import annotations

from collections import defaultdict

import libsumo
import pytest

import phase_sumo
from tests.helpers.rules_run import FLOW, LANES, RAMP, ROAD, Run, taken_back
from tests.helpers.standin import Standin

OPEN = LANES[0], LANES[1].format(lanes=""), ""
RAILS = (
    '<node id="west" x="-400" y="0"/><node id="east" x="300" y="0"/><node id="south" x="0" y="-300"/>'
    '<node id="north" x="0" y="300"/><node id="mid" x="0" y="0" type="rail_crossing"/>',
    f'<edge id="w" from="west" to="mid" {ROAD}/><edge id="e" from="mid" to="east" {ROAD}/>'
    '<edge id="s" from="south" to="mid" numLanes="1" speed="20" allow="rail"/>'
    '<edge id="n" from="mid" to="north" numLanes="1" speed="20" allow="rail"/>',
    '<connection from="w" to="e" fromLane="0" toLane="0"/>'
    '<connection from="s" to="n" fromLane="0" toLane="0"/>',
)


def test_a_rail_crossing_is_not_entered_before_a_train(tmp_path):
    train = (
        '<vType id="train" vClass="rail" length="100"/>'
        '<vehicle id="train" type="train" depart="0" departSpeed="10" departPos="base">'
        '<route edges="s n"/></vehicle>'
    )
    cars = '<flow id="c" type="car" from="w" to="e" begin="0" end="9" period="3" departSpeed="18"/>'
    run = Run(tmp_path, RAILS, train + cars, end=90)
    inside = {v: [s.time for s in seen if s.lane.startswith(":")] for v, seen in run.seen.items()}
    train_in, train_out = min(inside["train"]), max(inside["train"])
    assert run.result["arrived"] == 3 and run.result["collisions"] == 0
    for vehicle in ("c.0", "c.1", "c.2"):
        assert taken_back(run, vehicle)
        assert all(not train_in - 2.0 < time < train_out for time in inside[vehicle])
    assert min(s.speed for s in run.seen["c.1"]) < 1.0  # it waited
    assert "a red signal" in run.reasons()


def test_limits_of_a_class_in_additional_files(tmp_path):
    more = '<type id="highway.motorway"><restriction vClass="truck" speed="14"/></type>'
    demand = FLOW.format("truck", 0).replace('"20"', '"14"') + FLOW.format("car", 1).replace('"f"', '"g"')
    run = Run(tmp_path, OPEN, demand, more, end=40)
    assert max(s.speed for v, seen in run.seen.items() if v[0] == "f" for s in seen) < 14.5
    assert max(s.speed for v, seen in run.seen.items() if v[0] == "g" for s in seen) > 20.0
    assert run.result["share_of_freeway_time_under_policy"] > 0.95


def test_a_zipper_shared_with_sumos_vehicles(tmp_path):
    nodes = RAMP[0].replace('<node id="b" x="400" y="0"/>', '<node id="b" x="400" y="0" type="zipper"/>')
    edges = RAMP[1].replace('numLanes="2" priority="9" type="highway.motorway" speed="25"', f"{ROAD}")
    joins = (
        '<connection from="m0" to="m1" fromLane="0" toLane="0"/>'
        '<connection from="on" to="m1" fromLane="0" toLane="0"/>'
    )
    human = '<vType id="human" length="4.8"><param key="has.phase.device" value="false"/></vType>'
    cars = human + "".join(
        f'<flow id="{name}" type="{kind}" from="{edge}" to="m1" begin="{at}" end="{at + 16}" period="8" '
        'departSpeed="18"/>'
        for name, kind, edge, at in (("a", "car", "m0", 0), ("b", "human", "m0", 4), ("c", "human", "on", 0),
                                     ("d", "car", "on", 4))
    )  # fmt: skip
    run = Run(tmp_path, (nodes, edges, joins), cars, end=90)
    assert run.result["collisions"] == 0
    assert run.result["accounts"]["arrived"] == run.result["vehicles"] == 6
    assert min(s.speed for seen in run.seen.values() for s in seen) > 2.0  # nobody has to stand


def test_parking_areas_and_their_rerouters_are_sumos(tmp_path):
    areas = "".join(
        f'<parkingArea id="{name}" lane="{lane}" startPos="150" endPos="170" roadsideCapacity="1"/>'
        for name, lane in (("full", "m1_0"), ("free", "m2_0"))
    )
    rerouter = (
        '<rerouter id="r" edges="m0"><interval begin="0" end="100">'
        '<parkingAreaReroute id="full" visible="true"/><parkingAreaReroute id="free" visible="true"/>'
        "</interval></rerouter>"
    )
    cars = "".join(
        f'<vehicle id="{name}" type="car" depart="{at}" departLane="0" departSpeed="20">'
        '<route edges="m0 m1 m2"/><stop parkingArea="full" duration="60"/></vehicle>'
        for name, at in (("a", 0), ("b", 40))
    )
    run = Run(tmp_path, OPEN, cars, areas + rerouter, end=180)
    stood = {v: {s.lane for s in seen if s.speed < 0.1} for v, seen in run.seen.items()}
    assert stood == {"a": {"m1_0"}, "b": {"m2_0"}}
    assert run.result["arrived"] == 2 and run.result["collisions"] == 0
    assert "a stop ahead" in run.reasons() and taken_back(run, "a")


@pytest.fixture
def driven(tmp_path):
    """Runs a loop of the caller's own: what is done at 2 s -> lanes of each vehicle, and the events."""

    def run(demand, do):
        Run(tmp_path, OPEN, demand, end=1)  # for its files
        libsumo.start(["sumo", "-c", str(tmp_path / "s.sumocfg"), "--end", "60", *phase_sumo.SUMO_OPTIONS])
        fleet = phase_sumo.PhaseFleet(libsumo, Standin())
        libsumo.addStepListener(fleet)
        lanes = defaultdict(set)
        while libsumo.simulation.getMinExpectedNumber() and libsumo.simulation.getTime() < 59.0:
            libsumo.simulationStep()
            if abs(libsumo.simulation.getTime() - 2.0) < 0.01:
                do()
            for vehicle in libsumo.vehicle.getIDList():
                lanes[vehicle].add(libsumo.vehicle.getLaneID(vehicle))
        fleet.close()
        assert fleet.report()["vehicles"] == len(lanes) and fleet.report()["accounts_balance"]
        return lanes, fleet.events

    yield run
    libsumo.close()


@pytest.mark.parametrize("call", ["setDisallowed", "setAllowed"])
def test_lanes_closed_by_a_call(driven, call):
    def close():
        getattr(libsumo.lane, call)("m1_0", ["passenger"] if call == "setDisallowed" else ["bus"])

    lanes, events = driven(FLOW.format("car", 0), close)
    assert set(lanes) == {"f.0", "f.1"}
    for on in lanes.values():
        assert "m1_1" in on and "m1_0" not in on
    assert not [e for e in events if e.kind == "removal"]


@pytest.mark.parametrize("forbidden", [False, True])
def test_lane_changes_forbidden_by_a_call(driven, forbidden):
    vehicles = "".join(
        f'<vehicle id="{name}" type="car" depart="0" departPos="{at}" departLane="0" departSpeed="{speed}">'
        f'<route edges="m0 m1 m2"/><param key="phase.target_speed" value="{speed}"/></vehicle>'
        for name, at, speed in (("quick", 20, 20), ("slow", 170, 8))
    )

    def forbid():
        for edge in ("m0", "m1", "m2") if forbidden else ():
            libsumo.lane.setChangePermissions(f"{edge}_0", ["bus"], 1)

    lanes, _ = driven(vehicles, forbid)
    assert any(lane.endswith("_1") for lane in lanes["quick"]) != forbidden
