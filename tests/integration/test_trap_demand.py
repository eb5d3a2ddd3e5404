"""Demand and networks that trip up others: every vehicle is accounted for and the remedy works."""

from __future__ import annotations

import csv
import math
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import sumolib

from phase_sumo.bridge.run import run_scenario
from phase_sumo.errors import PhaseError
from tests.helpers.places import NETWORKS
from tests.helpers.scenario_files import FLOW, write_scenario
from tests.helpers.standin import Standin


def vehicle(
    name="v", kind="car", depart="0", more="", inside="", edges="main0 main1 main2", speed='departSpeed="20"'
):
    return (
        f'<vehicle id="{name}" type="{kind}" depart="{depart}" {speed} {more}><route edges="{edges}"/>'
        f"{inside}</vehicle>"
    )


def drive(tmp_path: Path, routes: str, end: float = 60.0, **files):
    result = run_scenario(
        write_scenario(tmp_path, routes, **files),
        policy=Standin(),
        seed=1,
        end=end,
        output_dir=tmp_path / "out",
    )
    accounts = dict(result["accounts"])
    assert accounts.pop("inserted") == sum(accounts.values())
    with (tmp_path / "out" / "trips.csv").open() as file:
        assert len(list(csv.DictReader(file))) == result["vehicles"]
    return result


@pytest.mark.parametrize(
    "more",
    [
        'departPos="last" departLane="free"',
        'departPos="random_free" departLane="random"',
        'departPos="base" departLane="best"',
        'departPos="50" departPosLat="left"',
        'arrivalLane="0" arrivalSpeed="current"',
    ],
)
def test_ways_to_depart_and_arrive(tmp_path, more):
    result = drive(tmp_path, vehicle(more=more))
    assert result["phase_arrived_under_policy"] == 1
    assert result["share_of_time_under_policy"] > 0.95


@pytest.mark.parametrize(
    ("stop", "seconds"),
    [
        ('endPos="100" duration="5"', 5.0),
        ('endPos="100" duration="5" parking="true"', 5.0),
        ('startPos="50" endPos="100" speed="10"', 0.0),
    ],
)
def test_sumo_drives_to_a_stop_and_phase_from_there(tmp_path, stop, seconds):
    routes = vehicle(more='departLane="0"', inside=f'<stop lane="main1_0" {stop}/>')
    stops = '<stop-output value="stops.xml"/>'
    result = drive(tmp_path, routes, options=stops)
    (done,) = ET.parse(tmp_path / "out" / "stops.xml").getroot()
    assert float(done.get("ended", "0")) - float(done.get("started", "0")) >= seconds
    assert result["phase_arrived_under_policy"] == 1
    assert 0.2 < result["share_of_time_under_policy"] < 0.8
    assert 0.2 < result["share_of_freeway_time_under_policy"] < 0.8  # parked is beside the road


def test_persons_and_containers_ride_along(tmp_path):
    routes = (
        '<person id="p" depart="0"><ride from="main0" to="main2" lines="a"/></person>'
        '<container id="c" depart="0"><transport from="main0" to="main2" lines="b"/></container>'
    )
    routes += vehicle("a", depart="triggered") + vehicle(
        "b", depart="containerTriggered", more='departLane="2"'
    )
    result = drive(tmp_path, routes, options='<tripinfo-output value="trips.xml"/>')
    assert result["accounts"]["arrived"] == 2
    kinds = {e.tag for e in ET.parse(tmp_path / "out" / "trips.xml").getroot()}
    assert {"tripinfo", "personinfo", "containerinfo"} <= kinds


def test_other_models_flows_and_sizes(tmp_path):
    types = (
        '<vType id="acc" carFollowModel="ACC"/><vType id="cacc" carFollowModel="CACC" actionStepLength="1"/>'
        '<vType id="tiny" length="0.5" width="0.3"/>'
        '<vType id="huge" vClass="trailer" length="60" width="3.2"/>'
        '<vType id="bike" vClass="motorcycle"/>'
    )
    routes = types + '<flow id="p" type="car" from="main0" to="main2" begin="0" end="15" probability="0.3"/>'
    routes += "".join(
        vehicle(kind, kind, depart=str(3 * i), speed='departSpeed="15" departLane="free"')
        for i, kind in enumerate(("acc", "cacc", "tiny", "huge", "bike"))
    )
    result = drive(tmp_path, routes)
    assert result["accounts"]["running"] == 0
    assert result["vehicles"] - result["phase_vehicles"] == 1  # the motorcycle is SUMO's


def test_no_vehicles_at_all(tmp_path):
    result = drive(tmp_path, "")
    assert result["vehicles"] == 0
    assert any("no vehicle was inserted" in text for text in result["warnings"])


@pytest.mark.parametrize("name", ["a#1/2", "é=(1):x!", "a.b.c"])
def test_odd_vehicle_ids(tmp_path, name):
    assert drive(tmp_path, vehicle(name))["phase_arrived_under_policy"] == 1


@pytest.mark.parametrize("name", ["a b", "a,b", "a&lt;b", "a&quot;b"])
def test_ids_that_sumo_refuses(tmp_path, name):
    with pytest.raises(PhaseError, match="Invalid vehicle id"):
        drive(tmp_path, vehicle(name))


@pytest.mark.parametrize("begin", ["3600", "1:00:00"])
def test_simulations_need_not_begin_at_zero(tmp_path, begin):
    routes = FLOW.format(begin=3600, end=3610)
    result = drive(tmp_path, routes, end=3660.0, options=f'<begin value="{begin}"/>')
    assert result["accounts"]["arrived"] == result["vehicles"] == 5
    assert result["sim_seconds"] < 60.0


@pytest.mark.parametrize(
    ("step", "remedy"),
    [(0.02, ""), (0.03, "--step-length 0.025"), (0.25, "--step-length 0.2"), (0.5, ""), (1.0, "")],
)
def test_step_lengths(tmp_path, step, remedy):
    if remedy:
        with pytest.raises(PhaseError, match=f"step-length {step}.*{remedy}"):
            drive(tmp_path, vehicle(), step=step)
    else:
        assert drive(tmp_path, vehicle(), step=step)["phase_arrived_under_policy"] == 1


def test_limits_that_change_during_the_run(tmp_path):
    sign = (
        '<variableSpeedSign id="s" lanes="main1_0 main1_1 main1_2 main1_3 main2_0 main2_1 main2_2">'
        '<step time="0" speed="12"/></variableSpeedSign>'
    )
    free = drive(tmp_path, vehicle())
    slow = drive(tmp_path, vehicle(), additional=sign)
    assert slow["mean_travel_time"] > free["mean_travel_time"] + 8.0


@pytest.mark.parametrize(
    "additional",
    [
        '<vType id="c" length="4.8"/><route id="rt" edges="main0 main1 main2"/><calibrator id="cal" '
        'lane="main0_1" pos="20" output="cal.xml" period="10"><flow begin="0" end="30" route="rt" '
        'vehsPerHour="900" speed="20" type="c"/></calibrator>',
        '<rerouter id="r" edges="main0"><interval begin="0" end="100"><closingLaneReroute id="main1_0" '
        'disallow="all"/></interval></rerouter>',
        '<inductionLoop id="d" lane="main1_1" pos="50" period="10" file="sub/d.xml"/>'
        '<laneAreaDetector id="e" lane="main1_1" pos="10" endPos="100" period="10" file="sub/e.xml"/>',
    ],
)
def test_additional_objects(tmp_path, additional):
    assert drive(tmp_path, FLOW.format(begin=0, end=10), additional=additional)["phase_vehicles"] >= 5


@pytest.mark.parametrize(
    "option",
    [
        '<lateral-resolution value="0.8"/>',
        '<step-method.ballistic value="true"/>',
        '<default.action-step-length value="1"/>',
        '<device.rerouting.probability value="1"/><device.rerouting.period value="5"/>',
        '<device.ssm.probability value="1"/><device.ssm.file value="ssm.xml"/>'
        '<device.emissions.probability value="1"/>'
        '<device.driverstate.probability value="1"/>',
        '<time-to-teleport value="10"/><time-to-teleport.highways value="5"/>',
        '<collision.action value="remove"/>',
    ],
)
def test_options_of_others(tmp_path, option):
    result = drive(tmp_path, FLOW.format(begin=0, end=10), options=option)
    assert result["accounts"] == {"inserted": 5, "arrived": 5, "running": 0}


def test_left_hand_traffic(tmp_path):
    net = NETWORKS / "f20_lefthand2.net.xml"
    result = drive(tmp_path, vehicle(edges="main0 main1 main2 main3 main4"), net=net)
    assert result["phase_arrived_under_policy"] == 1
    assert result["off_road"] == 0


def plain_net(folder: Path, nodes: str, edges: str) -> Path:
    (folder / "p.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "p.edg.xml").write_text(f"<edges>{edges}</edges>")
    out = folder / "p.net.xml"
    args = ["-n", folder / "p.nod.xml", "-e", folder / "p.edg.xml", "-o", out, "--no-turnarounds", "true"]
    subprocess.run([sumolib.checkBinary("netconvert"), *args], check=True, capture_output=True)
    return out


def test_a_route_that_uses_an_edge_twice_is_sumos(tmp_path):
    """Moved by hand, SUMO would count the vehicle on its first lap for ever."""
    corner = [(200 * math.cos(a), 200 * math.sin(a)) for a in (0.0, 1.57, 3.14, 4.71)]
    nodes = "".join(f'<node id="n{k}" x="{x:.1f}" y="{y:.1f}"/>' for k, (x, y) in enumerate(corner))
    arcs = [
        " ".join(
            f"{200 * math.cos(1.57 * k + t / 13):.1f},{200 * math.sin(1.57 * k + t / 13):.1f}"
            for t in range(21)
        )
        for k in range(4)
    ]
    edges = "".join(
        f'<edge id="e{k}" from="n{k}" to="n{(k + 1) % 4}" numLanes="2" speed="22" shape="{arcs[k]}"/>'
        for k in range(4)
    )
    net = plain_net(tmp_path, nodes, edges)
    laps = vehicle(edges="e0 e1 e2 e3 e0 e1") + vehicle("once", depart="5", edges="e0 e1 e2")
    result = drive(tmp_path, laps, end=150.0, net=net)
    assert result["accounts"]["arrived"] == 2
    assert result["phase_arrived_under_policy"] == result["phase_vehicles"] == 1


def test_town_roads_traffic_lights_and_rails_are_sumos(tmp_path):
    """Departing in town, over a signal, onto the motorway; a tram beside it."""
    nodes = (
        '<node id="a" x="0" y="0"/><node id="l" x="200" y="0" type="traffic_light"/>'
        '<node id="c" x="400" y="0"/>'
        '<node id="d" x="1000" y="0"/><node id="s" x="200" y="-200"/><node id="t" x="200" y="200"/>'
    )
    edges = (
        '<edge id="town" from="a" to="l" numLanes="1" speed="10"/>'
        '<edge id="out" from="l" to="c" numLanes="2" '
        'speed="10"/><edge id="fast" from="c" to="d" numLanes="2" speed="33"/>'
        '<edge id="side" from="s" to="l" speed="10"/><edge id="up" from="l" to="t" speed="10"/>'
        '<edge id="rail" from="s" to="t" speed="20" allow="tram rail" shape="230,-200 230,200"/>'
    )
    net = plain_net(tmp_path, nodes, edges)
    routes = (
        vehicle(edges="town out fast", speed="")
        + '<vType id="tram" vClass="tram"/>'
        + vehicle("t", "tram", edges="rail", speed="")
        + vehicle("x", edges="side up", speed="")
    )
    result = drive(tmp_path, routes, end=200.0, net=net)
    assert result["accounts"]["arrived"] == 3
    assert result["phase_arrived_under_policy"] == result["phase_vehicles"] == 1
    assert 0.1 < result["share_of_time_under_policy"] < 0.9
    assert 0.9 < result["share_of_freeway_time_under_policy"] <= 1.0


def test_before_a_queue_at_the_end_of_the_freeway_sumo_takes_over(tmp_path):
    """Where vehicles wait on it to get into town, for a driver that looks at nobody."""
    nodes = '<node id="a" x="0" y="0"/><node id="b" x="700" y="0"/><node id="c" x="900" y="0"/>'
    edges = (
        '<edge id="fast" from="a" to="b" numLanes="2" speed="33"/>'
        '<edge id="town" from="b" to="c" numLanes="2" speed="10"/>'
    )
    net = plain_net(tmp_path, nodes, edges)
    human = '<vType id="human" length="4.8"><param key="has.phase.device" value="false"/></vType>'
    queue = human + "".join(
        f'<vehicle id="q{k}" type="human" depart="0" departLane="{k}" departPos="500">'
        f'<route edges="fast town"/>'
        f'<stop lane="fast_{k}" endPos="520" duration="60"/></vehicle>'
        for k in range(2)
    )
    cfg = write_scenario(tmp_path, queue + vehicle(edges="fast town", depart="1"), net=net)
    result = run_scenario(cfg, policy=Standin(reckless=True), end=120.0, time_gap=0.0, guard=False)
    assert result["phase_vehicles"] == 1
    assert result["fleet"]["hand_backs"] == 2  # before the queue, and where the freeway ends
    assert result["collisions"] == 0
    assert result["accounts"] == {"inserted": 3, "arrived": 3, "running": 0}


def test_sublanes_without_internal_lanes(tmp_path):
    """SUMO crashes there when a moved vehicle straddles two lanes over a junction."""
    bare = tmp_path / "bare.net.xml"
    netconvert = [sumolib.checkBinary("netconvert"), "-s", str(NETWORKS / "f04_onramp3.net.xml")]
    subprocess.run([*netconvert, "--no-internal-links", "-o", str(bare)], check=True, capture_output=True)
    result = drive(
        tmp_path, FLOW.format(begin=0, end=20), options='<lateral-resolution value="0.8"/>', net=bare
    )
    assert any("lateral-resolution 0" in warning for warning in result["warnings"])
    assert result["phase_arrived_under_policy"] > 3
