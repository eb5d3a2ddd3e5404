"""Signals, signs, lanes and limits hold for PHASE as for SUMO: those of the vehicle's class, as they are."""

from __future__ import annotations

import pytest

from tests.helpers.rules_run import FLOW, LANES, RAMP, ROAD, Run, taken_back

CROSSING = (
    '<node id="west" x="-300" y="0"/><node id="east" x="300" y="0"/><node id="south" x="0" y="-300"/>'
    '<node id="north" x="0" y="300"/><node id="mid" x="0" y="0" type="{}"/>',
    f'<edge id="w" from="west" to="mid" priority="9" {ROAD}/><edge id="e" from="mid" to="east" {ROAD}/>'
    f'<edge id="s" from="south" to="mid" priority="2" {ROAD}/><edge id="n" from="mid" to="north" {ROAD}/>',
    '<connection from="w" to="e" fromLane="0" toLane="0"/>'
    '<connection from="s" to="n" fromLane="0" toLane="0"/>',
)
CARS = """
    <flow id="main" type="car" from="w" to="e" begin="0" end="12" period="3" departSpeed="20"/>
    <flow id="side" type="car" from="s" to="n" begin="0" end="12" period="4" departSpeed="20"/>
"""
RAMP_CARS = """
    <flow id="main" type="car" from="m0" to="m1" begin="0" end="20" period="2.5"
        departLane="0" departSpeed="24"/>
    <flow id="side" type="car" from="on" to="m1" begin="0" end="4" period="5" departSpeed="18"/>
"""
SIGNAL = """<tlLogic id="mid" programID="ours" type="static" offset="0">
    <phase duration="{red}" state="{first}"/><phase duration="100" state="{then}"/></tlLogic>"""


def crossing(kind: str) -> tuple[str, str, str]:
    return CROSSING[0].format(kind), CROSSING[1], CROSSING[2]


def test_nobody_takes_the_right_of_way_of_a_main_road(tmp_path):
    run = Run(tmp_path, crossing("priority"), CARS, end=60)
    assert run.result["collisions"] == 0
    assert run.result["arrived"] == run.result["vehicles"] == 7
    assert min(s.speed for v, seen in run.seen.items() if v.startswith("main") for s in seen) > 17.0
    assert run.reasons() <= {"others have the right of way", "a queue"}
    assert all(taken_back(run, f"side.{k}") for k in range(3))


def test_a_ramp_waits_for_a_gap_and_the_main_road_does_not_slow_down(tmp_path):
    run = Run(tmp_path, RAMP, RAMP_CARS, end=60, guard=False)  # rules alone: it brakes for a ramp's edge
    assert run.result["collisions"] == 0
    assert min(s.speed for v, seen in run.seen.items() if v.startswith("main") for s in seen) > 20.0
    assert "others have the right of way" in run.reasons()
    assert taken_back(run, "side.0")


def test_an_all_way_stop_is_a_stop_for_all(tmp_path):
    run = Run(tmp_path, crossing("allway_stop"), CARS, end=70)
    assert run.result["collisions"] == 0
    assert run.result["arrived"] == 7
    slowest = {vehicle: min(s.speed for s in seen) for vehicle, seen in run.seen.items()}
    assert max(slowest.values()) < 1.5
    assert "a stop sign" in run.reasons()


def test_a_red_signal_is_not_passed_and_a_green_one_without_a_delay(tmp_path):
    program = SIGNAL.format(
        red=25, first="Gr", then="rG"
    )  # links in the order of the roads, clockwise from north
    run = Run(tmp_path, crossing("traffic_light"), CARS, program, end=50)
    assert run.result["collisions"] == 0
    inside = {v: next((s for s in seen if s.lane.startswith(":")), None) for v, seen in run.seen.items()}
    first = {v[:4]: [] for v in inside}
    for v, seen in inside.items():
        if seen:
            first[v[:4]].append(seen.time)
    waits, goes = sorted(first, key=lambda name: min(first[name]), reverse=True)
    assert min(first[waits]) >= 25.0
    assert max(first[goes]) <= 25.0
    assert min(s.speed for v, seen in run.seen.items() if v.startswith(goes) for s in seen) > 17.0
    assert run.reasons() <= {"a red signal", "a queue"}
    assert "a red signal" in run.reasons()


def test_a_lane_closed_by_a_rerouter_is_not_driven_in(tmp_path):
    closing = (
        '<rerouter id="r" edges="m0 m1"><interval begin="0" end="100">'
        '<closingLaneReroute id="m1_0" disallow="all"/></interval></rerouter>'
    )
    net = LANES[0], LANES[1].format(lanes=""), ""
    run = Run(tmp_path, net, FLOW.format("car", 0), closing)
    assert run.result["arrived"] == 2
    assert not run.on("m1_0")
    assert run.on("m1_1")
    assert run.result["share_of_freeway_time_under_policy"] > 0.9


def test_each_class_keeps_to_its_lanes(tmp_path):
    lanes = '<lane index="0" disallow="bus"/><lane index="1" disallow="truck"/>'
    net = LANES[0], LANES[1].format(lanes=lanes), ""
    demand = FLOW.format("bus", 1) + FLOW.format("truck", 0).replace('"f"', '"g"')
    run = Run(tmp_path, net, demand)
    assert run.result["arrived"] == 4
    assert {v[0] for v, _ in run.on("m0_0", "m1_0", "m2_0")} == {"g"}
    assert {v[0] for v, _ in run.on("m0_1", "m1_1", "m2_1")} == {"f"}
    assert run.result["share_of_freeway_time_under_policy"] > 0.95


@pytest.mark.parametrize(("may", "passes"), [("passenger", False), ("truck", True)])
def test_lines_are_crossed_by_those_who_may(tmp_path, may, passes):
    net = LANES[0], LANES[1].format(lanes=f'<lane index="0" changeLeft="{may}"/>'), ""
    vehicles = "".join(
        f'<vehicle id="{name}" type="truck" depart="0" departPos="{at}" departLane="0" departSpeed="{speed}">'
        f'<route edges="m0 m1 m2"/><param key="phase.target_speed" value="{speed}"/></vehicle>'
        for name, at, speed in (("quick", 20, 20), ("slow", 150, 8))
    )
    run = Run(tmp_path, net, vehicles, end=40)
    assert bool([v for v, _ in run.on("m0_1", "m1_1", "m2_1") if v == "quick"]) == passes


def test_the_limit_of_the_own_class(tmp_path):
    net = LANES[0], LANES[1].format(lanes=""), ""
    own = '<type id="highway.motorway"><restriction vClass="truck" speed="15"/></type>'
    run = Run(tmp_path, net, FLOW.format("truck", 0).replace('"20"', '"15"'), in_net=own, end=30)
    assert max(s.speed for seen in run.seen.values() for s in seen) < 15.5
    assert run.result["share_of_freeway_time_under_policy"] > 0.95


def test_speeds_that_the_policy_cannot_drive_are_sumos(tmp_path):
    net = LANES[0], LANES[1].format(lanes=""), ""
    sign = '<variableSpeedSign id="v" lanes="m1_0 m1_1"><step time="0" speed="0"/></variableSpeedSign>'
    works = '<vehicle id="works" type="works" depart="0" departPos="5"><route edges="m0 m1 m2"/></vehicle>'
    cars = FLOW.format("car", 1).replace('from="m0" to="m2"', 'route="r"')
    run = Run(tmp_path, net, '<route id="r" edges="m0 m1 m2"/>' + works + cars, sign, end=40)
    assert max(s.speed for s in run.seen["works"]) <= 1.4
    assert not run.on("m1_0", "m1_1")
    assert "the speed limit is too low" in run.reasons()
    assert {e.vehicle for e in run.events if e.kind == "adoption"} == {"f.0", "f.1"}


def test_an_exit_to_a_street_is_phases_almost_to_its_end(tmp_path):
    net = (
        '<node id="a" x="0" y="0"/><node id="b" x="900" y="0"/><node id="c" x="1100" y="0"/>',
        '<edge id="off" from="a" to="b" type="highway.motorway_link" numLanes="2" speed="22"/>'
        '<edge id="street" from="b" to="c" type="highway.secondary" numLanes="1" speed="14"/>',
        '<connection from="off" to="street" fromLane="0" toLane="0"/>',
    )
    flow = (
        '<flow id="f" type="car" from="off" to="street" begin="0" end="16" period="4" '
        'departSpeed="20" departLane="{}"/>'
    )
    run = Run(tmp_path, net, flow.format(0), end=75)
    assert run.result["arrived"] == 4 and run.result["collisions"] == 0
    assert run.result["share_of_freeway_time_under_policy"] > 0.96
    back = [event for event in run.events if event.kind == "hand-back"]
    assert len(back) == 4 and all(event.position > 870.0 and event.speed < 16.0 for event in back)
    (tmp_path / "two").mkdir()
    astray = Run(tmp_path / "two", net, flow.format(1), end=75)  # the left lane ends there
    assert astray.result["arrived"] == 4 and astray.result["collisions"] == 0
