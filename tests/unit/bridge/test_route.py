"""Routes and goals on a hand-made motorway: three lanes, an exit on the right, an acceleration lane."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.fleet.goals import GOAL_BOUNDS, MAX_BULGE, GoalPlanner
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import (
    ahead,
    curve_speed,
    follow_lanes,
    kept_stretch,
    path,
    remaining,
    route_lanes,
)
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.curve_speed import BRAKING, FASTEST
from phase_sumo.sim.lanes import Lane, LaneNetwork
from tests.helpers.toy_motorway import W, lane, plan, put


@pytest.fixture(scope="module")
def road():
    """in (2 lanes) -> wide (right lane 0 is an acceleration lane fed by ramp) -> out (2 lanes) -> gore.

    ``gore`` has two lanes that go on to ``main``; its right lane also leads to ``exit``.
    """
    lanes = [
        lane("in", 1, 0, 300, left=1),  # 0
        lane("in", 2, 0, 300, right=0),  # 1
        lane("wide", 0, 300, 500, left=3, dead_end=True),  # 2, acceleration lane
        lane("wide", 1, 300, 500, left=4, right=2),  # 3
        lane("wide", 2, 300, 500, right=3),  # 4
        lane("ramp", 0, 100, 300),  # 5
        lane("out", 1, 500, 900, left=7),  # 6
        lane("out", 2, 500, 900, right=6),  # 7
        lane("main", 2, 900, 1200, right=-1),  # 8
        lane("exit", 1, 900, 1200),  # 9
    ]
    successors = [(0, 3), (1, 4), (5, 2), (3, 6), (4, 7), (7, 8), (6, 9)]
    return Road(LaneNetwork("toy", tuple(lanes), tuple(successors)))


THROUGH = ("in", "wide", "out", "main")
EXIT = ("in", "wide", "out", "exit")
MERGE = ("ramp", "wide", "out", "main")


def test_lanes_that_lead_on_need_no_change(road):
    r = route_lanes(road, THROUGH, truck=False)
    assert r.changes[[1, 4, 7, 8]].tolist() == [0, 0, 0, 0]
    assert np.isinf(r.room[[1, 4, 7, 8]]).all()
    assert np.isinf(r.changes[9])


def test_exit_needs_one_change_to_the_right_before_the_gore(road):
    r = route_lanes(road, EXIT, truck=False)
    assert r.changes[[0, 1]].tolist() == [0, 1]
    assert r.side[[1, 4, 7]].tolist() == [-1, -1, -1]
    assert r.room[1] == pytest.approx(300 + 200 + 400)


def test_acceleration_lane_must_be_left_before_it_ends(road):
    r = route_lanes(road, MERGE, truck=False)
    assert r.changes[2] == 2  # to lane 1, and on to lane 2 before the exit
    assert r.side[2] == 1
    assert r.room[2] == pytest.approx(200)
    assert r.room[5] == pytest.approx(400)  # ramp and acceleration lane
    assert r.side[5] == 0


def test_kept_stretch_stops_at_the_first_other_edge(road):
    assert kept_stretch(road, ("city", "in", "wide", "village", "out"), 1) == ("in", "wide")


def test_ahead_follows_the_route_and_runs_on_beyond_its_end(road):
    r = route_lanes(road, EXIT, truck=False)
    node = int(road.first[0] + 290)
    place = ahead(road, r, node, 100.0)
    assert place.x == pytest.approx(390.0, abs=3.0)
    last = int(road.first[9] + road.count[9] - 1)
    assert ahead(road, r, last, 50.0).x == pytest.approx(1250.0, abs=1.0)


def test_remaining_counts_to_the_end_of_the_stretch(road):
    r = route_lanes(road, THROUGH, truck=False)
    assert remaining(road, r, int(road.first[1])) == pytest.approx(1200.0, abs=5.0)
    assert remaining(road, follow_lanes(road), int(road.first[2])) == pytest.approx(200.0, abs=2.0)


def test_tracking_finds_lanes_and_loses_vehicles_off_the_road(road):
    x, y = np.array([150.0, 400.0, 400.0]), np.array([W, 2 * W + 0.5, 60.0])
    node, distance = road.track(np.full(3, -1), x, y, np.zeros(3))
    assert [road.network.lanes[road.graph.node_lane[n]].id for n in node[:2]] == ["in_1", "wide_2"]
    assert node[2] == -1
    assert distance[1] == pytest.approx(0.5, abs=0.1)
    moved, _ = road.track(node, x + 3.0, y, np.zeros(3))
    assert (moved[:2] - node[:2]).tolist() == [3, 3]


def test_a_vehicle_that_faces_the_traffic_is_on_no_lane(road):
    node, _ = road.track(np.array([-1]), np.array([150.0]), np.array([W]), np.array([np.pi]))
    assert node[0] == -1


def goals(road, vehicles, route):
    """Plan once for the first vehicle."""
    table = VehicleTable(8)
    rows = [put(table, *v) for v in vehicles]
    routes = {vehicles[0][0]: route_lanes(road, route, truck=False)}
    plan(GoalPlanner(road, table), 0.0, table, road, routes)
    return float(table["goal_x"][rows[0]]), float(table["goal_y"][rows[0]])


def test_free_vehicle_keeps_its_lane(road):
    x, y = goals(road, [("a", 50.0, 2 * W, 20.0, 20.0)], THROUGH)
    assert y == pytest.approx(2 * W)
    assert x - 50.0 == pytest.approx(120.0, abs=3.0)


def test_goal_distance_is_bounded(road):
    for speed, wanted in ((3.0, GOAL_BOUNDS[0]), (40.0, GOAL_BOUNDS[1])):
        x, _ = goals(road, [("a", 50.0, 2 * W, speed, speed)], THROUGH)
        assert x - 50.0 == pytest.approx(wanted, abs=3.0)


def test_exit_far_away_does_not_force_a_change_yet_near_it_does(road):
    assert goals(road, [("a", 20.0, 2 * W, 20.0, 20.0), ("b", 45.0, W, 20.0)], EXIT)[1] == pytest.approx(
        2 * W
    )
    assert goals(road, [("a", 720.0, 2 * W, 20.0, 20.0)], EXIT)[1] == pytest.approx(W)


def test_change_for_the_route_is_asked_for_before_the_room_ends(road):
    x, y = goals(road, [("a", 820.0, 2 * W, 20.0, 20.0)], EXIT)
    assert y == pytest.approx(W)
    assert 820.0 + 2.5 * 20.0 - 3.0 <= x <= 905.0


def test_acceleration_lane_asks_for_the_change_at_once(road):
    assert goals(road, [("a", 320.0, 0.0, 20.0, 25.0)], MERGE)[1] == pytest.approx(W)


@pytest.fixture(scope="module")
def bend():
    """A lane with 200 m straight, a quarter of a circle of 80 m radius, and 200 m straight; and a fork.

    From x = 150 on a second lane runs on straight, over the first one as far as that is straight.
    """
    turn = np.linspace(0.0, 0.5 * np.pi, 120)
    arc = np.stack((200.0 + 80.0 * np.sin(turn), 80.0 * (1.0 - np.cos(turn))), -1)
    curve = np.concatenate(([[150.0, 0.0]], arc, [[280.0, 280.0]]))
    length = float(np.hypot(*np.diff(curve, axis=0).T).sum())
    lanes = (
        lane("in", 0, 0, 150),
        Lane("turn_0", "turn", curve, W, 30.0, length),
        lane("ahead", 0, 150, 600),
    )
    return Road(LaneNetwork("bend", lanes, ((0, 1), (0, 2))))


def test_the_way_along_a_route_crosses_lanes(bend):
    route = route_lanes(bend, ("in", "turn"), truck=False)
    nodes = path(bend, route, int(bend.first[0]) + 140, 30.0)
    assert len(nodes) == 31
    assert bend.graph.node_lane[nodes].tolist() == [0] * 11 + [1] * 20
    assert np.hypot(*np.diff(bend.graph.node_xy[nodes], axis=0).T).max() < 1.1


def test_a_curve_draws_the_goal_near(bend):
    x, y = goals(bend, [("a", 10.0, 0.0, 10.0, 20.0)], ("in", "turn"))
    assert x == pytest.approx(130.0, abs=2.0)  # 6 s of target speed, all straight
    x, y = goals(bend, [("a", 145.0, 0.0, 10.0, 20.0)], ("in", "turn"))
    # 45 % of it: 60 % end 17 m into the arc, whose line lies more than MAX_BULGE beside the way
    assert np.hypot(x - 145.0, y) == pytest.approx(54.0, abs=2.0)
    assert MAX_BULGE < 55.0 * (17.0**2 / 160.0) / 72.0
    x, y = goals(bend, [("a", 145.0, 0.0, 10.0, 20.0)], ("in", "ahead"))
    assert (x, y) == pytest.approx((265.0, 0.0), abs=2.0)


def test_a_vehicle_out_of_line_gets_a_near_goal(bend):
    x, _ = goals(bend, [("a", 50.0, 1.2, 10.0, 20.0)], ("in", "ahead"))
    assert x - 50.0 == pytest.approx(16.0, abs=1.5)


def test_lanes_that_overlap_behind_a_fork(bend):
    turn, straight = (np.array([False, k == 1, k == 2]) for k in (1, 2))
    node = int(bend.first[1]) + 20
    assert bend.graph.node_lane[bend.overlapping(node, 170.3, 0.5, straight)] == 2
    assert bend.graph.node_lane[bend.overlapping(node, 170.3, 0.5, turn)] == 1
    assert bend.overlapping(node, 230.0, 5.9, straight) == -1  # they have parted


def test_curves_ahead_on_the_route_slow_down(bend):
    node = np.array([bend.first[0] + 100])
    car, truck = np.array([False]), np.array([True])
    for edges, slow in ((("in", "turn"), True), (("in", "ahead"), False)):
        routes = [route_lanes(bend, edges, truck=False)]
        speed = float(curve_speed(bend, routes, node, car, np.zeros(1))[0])
        expected = np.sqrt(3.0 * 80.0 + 2.0 * BRAKING * 105.0) if slow else FASTEST
        assert speed == pytest.approx(expected, rel=0.02)
        sooner = float(curve_speed(bend, routes, node, car, np.array([40.0]))[0])
        there = np.sqrt(3.0 * 80.0 + 2.0 * BRAKING * 65.0) if slow else FASTEST
        assert sooner == pytest.approx(there, rel=0.02)
        over_the_end = float(curve_speed(bend, routes, node, car, np.array([120.0]))[0])
        assert over_the_end == pytest.approx(np.sqrt(3.0 * 80.0) if slow else FASTEST, rel=0.02)
    routes = [route_lanes(bend, ("in", "turn"), truck=True)]
    assert curve_speed(bend, routes, node, truck, np.zeros(1))[0] == pytest.approx(
        np.sqrt(160.0 + 2.0 * BRAKING * 105.0), rel=0.02
    )


def test_an_acceleration_lane_is_no_end_of_the_road(road):
    """Whether the route stays on the freeway or not: 20 m before its end, 700 m are left."""
    for edges in (("ramp", "wide", "out", "exit"), ("ramp", "wide", "out", "main")):
        route = route_lanes(road, edges, truck=False)
        assert route.onward[2] < 0  # the lane leads nowhere
        left = remaining(road, route, int(road.first[2]) + 180)
        assert left == pytest.approx(20.0 + 400.0 + 300.0, abs=4.0)
        before = remaining(road, route, int(road.first[5]) + 100)
        assert before == pytest.approx(100.0 + 200.0 + 400.0 + 300.0, abs=4.0)


def test_positions_beside_their_lane_are_told(road):
    node = road.first[[1, 1, 1, 5]] + 50
    x, y = road.graph.node_xy[node].astype(np.float64).T
    beyond = road.beyond_lane(np.r_[node, -1], np.r_[x, 0.0], np.r_[y + np.array((0.0, 3.2, 3.4, -3.4)), 0.0])
    assert beyond.tolist() == [False, False, True, True, False]  # lanes are 3.6 m wide
