"""Which lane vehicles take: MOBIL by hand, and the rules on a toy motorway."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.fleet.goals import PATIENCE, REST, GoalPlanner
from phase_sumo.bridge.fleet.lane_choice import (
    ACCELERATION,
    BRAKING,
    POLITENESS,
    SAFE_BRAKING,
    STANDSTILL,
    TIME_GAP,
    acceleration,
    felt,
    gain,
    safe,
)
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import W, lane, plan, put


def one(speed, target, gap=np.inf, ahead=0.0):
    return float(acceleration(*(np.array([v], float) for v in (speed, target, gap, ahead)))[0])


def test_on_a_free_road_it_is_the_idm():
    assert one(0.0, 30.0) == pytest.approx(ACCELERATION)
    assert one(15.0, 30.0) == pytest.approx(ACCELERATION * 15.0 / 16.0)
    assert one(30.0, 30.0) == pytest.approx(0.0)
    assert -BRAKING < one(36.0, 30.0) < 0.0


@pytest.mark.parametrize("speed", [5.0, 20.0, 30.0])
def test_at_the_desired_gap_behind_an_equal_it_neither_gains_nor_loses_ground(speed):
    wanted = STANDSTILL + TIME_GAP * speed
    assert one(speed, 30.0, wanted, speed) == pytest.approx(0.0, abs=1e-9)
    assert one(speed, 30.0, 0.5 * wanted, speed) == pytest.approx(-3.0 * ACCELERATION)  # a (1 - 2^2)
    assert one(speed, 30.0, 2.0 * wanted, speed) >= 0.0


def test_at_the_desired_speed_a_leader_as_fast_is_no_hindrance():
    assert one(30.0, 30.0, 50.0, 30.0) == pytest.approx(0.0, abs=1e-9)


def test_approaching_a_standing_vehicle_takes_the_braking_of_kinematics():
    """Far out, where s* is v dv / (2 sqrt(a b)), stopping over s costs (v^2 / 2 s)^2 / b."""
    speed, gap = 40.0, 2.0
    kinematic = speed**2 / (2.0 * gap)
    assert one(speed, 40.0, gap, 0.0) == pytest.approx(-(kinematic**2) / BRAKING, rel=0.2)


def test_a_change_counts_the_followers_less_than_oneself():
    assert gain(np.array([1.0]), np.array([-1.0]), np.array([0.5])) == pytest.approx(1.0 - 0.5 * POLITENESS)
    assert felt(np.array([-9.0, 0.5])).tolist() == [-BRAKING, 0.5]


def test_nobody_may_have_to_brake_hard():
    hard, soft = np.array([-SAFE_BRAKING - 0.1]), np.array([-SAFE_BRAKING + 0.1])
    assert safe(soft, soft)
    assert not safe(hard, soft)
    assert not safe(soft, hard)


@pytest.fixture(scope="module")
def road():
    """Three lanes ``long`` go on as ``end``; the left lane ends, the right one also leads to ``exit``."""
    lanes = [
        lane("long", 0, 0, 1500, left=1),
        lane("long", 1, 0, 1500, left=2, right=0),
        lane("long", 2, 0, 1500, right=1, dead_end=True),
        lane("end", 0, 1500, 2000, left=4),
        lane("end", 1, 1500, 2000, right=3),
        lane("exit", 0, 1500, 2000, y=-W),
    ]
    return Road(LaneNetwork("three", tuple(lanes), ((0, 3), (1, 4), (0, 5))))


def lane_wanted(road, vehicles, edges=("long",), seconds=PATIENCE):
    """Lane of the first vehicle's goal when the scene has been the same for some seconds."""
    table = VehicleTable(16)
    rows = [put(table, *v) for v in vehicles]
    ours = {v[0]: route_lanes(road, edges, truck=False) for v in vehicles if len(v) == 5}
    planner = GoalPlanner(road, table)
    for time in np.arange(seconds + 1.0):
        plan(planner, float(time), table, road, ours)
    return round(float(table["goal_y"][rows[0]]) / W)


def test_overtaking(road):
    me, slow = ("a", 100.0, W, 20.0, 25.0), ("b", 150.0, W, 10.0)
    assert lane_wanted(road, [me, slow]) == 2
    assert lane_wanted(road, [me, slow], seconds=PATIENCE - 1.0) == 1
    right = [("c", 150.0, 0.0, 10.0)]
    assert lane_wanted(road, [me, slow, *right, ("d", 98.0, 2 * W, 25.0)]) == 1  # abreast
    assert lane_wanted(road, [me, slow, *right, ("d", 70.0, 2 * W, 35.0)]) == 1  # closing in
    assert lane_wanted(road, [me, slow, *right, ("d", 150.0, 2 * W, 10.0)]) == 1  # as slow
    assert lane_wanted(road, [me, slow, *right, ("d", 150.0, 2 * W, 30.0)]) == 2


def test_overtaking_on_the_right_where_the_left_is_no_way(road):
    me, slow = ("a", 100.0, 2 * W, 20.0, 25.0), ("b", 150.0, 2 * W, 10.0)
    assert lane_wanted(road, [me, slow, ("c", 250.0, W, 24.0)]) == 1


def test_back_to_the_right_where_that_is_free(road):
    me = ("a", 100.0, W, 25.0, 25.0)
    assert lane_wanted(road, [me]) == 0
    assert lane_wanted(road, [me, ("b", 300.0, 0.0, 18.0)]) == 1  # a slow one within 10 s


def test_a_queue_that_is_slower_than_everybody_wants_to_be_is_no_reason(road):
    queue = [(f"q{k}_{y}", 300.0 + 24.0 * k, y * W, 12.0, 25.0) for k in (-1, 1) for y in range(3)]
    queue += [(f"abreast{y}", 304.0, y * W, 12.0, 25.0) for y in (0, 2)]
    assert lane_wanted(road, [("a", 300.0, W, 12.0, 25.0), *queue], seconds=10.0) == 1
    shifted = [(name, x - (9.0 if y == 2 * W else 0.0), y, *rest) for name, x, y, *rest in queue]
    assert lane_wanted(road, [("a", 300.0, W, 12.0, 25.0), *shifted], seconds=10.0) == 1


def test_no_change_towards_a_lane_that_must_be_left_soon(road):
    route, slow = ("long", "end"), ("b", 850.0, W, 10.0)
    blocked = ("c", 850.0, 0.0, 10.0)
    assert lane_wanted(road, [("a", 800.0, W, 20.0, 25.0), slow, blocked], route) == 2
    near = [("a", 1000.0, W, 20.0, 25.0), ("b", 1050.0, W, 10.0), ("c", 1050.0, 0.0, 10.0)]
    assert lane_wanted(road, near, route) == 1  # 500 m before the left lane ends, two changes take 600 m


def test_a_lane_in_which_somebody_stands_is_left_early_whoever_drives_before(road):
    me, stands = ("a", 100.0, W, 25.0, 25.0), ("s", 450.0, W, 0.0)
    right = ("r", 170.0, 0.0, 12.0)  # no reason to go there
    assert lane_wanted(road, [me, right], seconds=0.0) == 1
    assert lane_wanted(road, [me, right, stands], seconds=0.0) == 2
    assert lane_wanted(road, [me, right, ("b", 130.0, W, 25.0, 25.0), stands], seconds=0.0) == 2
    assert lane_wanted(road, [me, stands, ("t", 450.0, 2 * W, 0.0)], seconds=0.0) == 0
    assert lane_wanted(road, [me, stands, ("d", 98.0, 2 * W, 25.0), ("c", 98.0, 0.0, 25.0)]) == 1  # no room


def test_nobody_changes_to_a_lane_in_which_somebody_stands(road):
    me = ("a", 100.0, W, 25.0, 25.0)
    assert lane_wanted(road, [me]) == 0
    assert lane_wanted(road, [me, ("s", 450.0, 0.0, 0.0)]) == 1
    table, planner = VehicleTable(4), None
    for rows in ([me], [me, ("s", 450.0, 0.0, 0.0)]):
        table = VehicleTable(4)
        for vehicle in rows:
            put(table, *vehicle)
        planner = GoalPlanner(road, table)
        planner._changing["a"], planner._review["a"] = (1, -1, 99.0), 0.0
        table["goal_x"][0], table["goal_y"][0] = 250.0, 0.0
        plan(planner, 1.0, table, road, {"a": route_lanes(road, ("long",), truck=False)})
        assert ("a" in planner._changing) == (len(rows) == 1)


def test_a_change_is_rested_after(road):
    table = VehicleTable(4)
    planner = GoalPlanner(road, table)
    row = put(table, "a", 100.0, 2 * W, 25.0, 25.0)
    route = {"a": route_lanes(road, ("long",), truck=False)}
    begun = {}
    for tenth in range(400):
        time, wanted = 0.1 * tenth, planner.changes_wanted
        plan(planner, time, table, road, route)
        if planner.changes_wanted > wanted:
            begun[len(begun)] = time
            table["y"][row] = table["goal_y"][row]  # done at once
    first, second = begun.values()
    assert first == pytest.approx(PATIENCE)
    assert second - first >= REST + PATIENCE
