"""Target speeds behind leaders against the equations, and what a long run of them leads to."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.fleet.drivers import Member
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.fleet.target_speeds import (
    CLOSING_UP,
    LAG,
    LOOK,
    OTHER_LANE,
    OWN_LANE,
    STOPPING,
    TargetSpeeds,
)
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import W, lane, nodes, put

LIMIT, T, S0, LENGTH = 30.0, 1.2, 2.5, 5.0


@pytest.fixture(scope="module")
def road():
    """Two lanes of 2 km."""
    return Road(LaneNetwork("two", (lane("e", 0, 0, 2000, left=1), lane("e", 1, 0, 2000, right=0)), ()))


class Traffic:
    """Vehicles (name, x, y, speed, wanted speed or None for SUMO's) on a road, and their target speeds."""

    def __init__(self, road: Road, vehicles, time_gap: float = T) -> None:
        self.road, self.table = road, VehicleTable(16)
        self.rows = [put(self.table, *v) for v in vehicles]
        self.planner = GoalPlanner(road, self.table)
        self.speeds = TargetSpeeds(road, self.table, np.zeros(len(road.count), bool))
        route = route_lanes(road, ("e",), truck=False)
        self.members = {
            v[0]: Member(route, ("e",), False, 1.0, 50.0, S0, target_speed=v[4], time_gap=time_gap)
            for v in vehicles
            if len(v) == 5
        }

    def update(self) -> np.ndarray:
        node = nodes(self.table, self.road)
        occupancy = Occupancy(self.road, self.table, node)
        self.speeds.update(node, self.planner.beside(node), occupancy, self.members)
        return self.table["goal_speed"][self.rows]


def behind(road: Road, gap: float, leader: float, time_gap: float = T) -> float:
    """Target speed of a vehicle that wants 28 m/s, with ``gap`` m to a leader of this speed."""
    pair = [("a", 100.0, 0.0, 20.0, 28.0), ("b", 100.0 + gap + LENGTH, 0.0, leader)]
    return float(Traffic(road, pair, time_gap).update()[0])


@pytest.mark.parametrize(
    ("gap", "leader"), [(60.0, 15.0), (40.0, 20.0), (20.0, 20.0), (3.0, 12.0), (30.0, 3.0)]
)
def test_behind_a_leader(road, gap, leader):
    room = gap - (S0 + T * leader)
    offset = np.sqrt(2.0 * CLOSING_UP * room) if room >= 0 else max(room / OWN_LANE[0], -OWN_LANE[1])
    expected = np.clip(leader + offset, 3.0, 28.0)
    slack = 1.0 * CLOSING_UP / np.sqrt(2.0 * CLOSING_UP * room) if room > 2 else 0.3  # a node is 1 m
    assert behind(road, gap, leader) == pytest.approx(expected, abs=slack + 0.1)


@pytest.mark.parametrize("between", [[], [("c", 150.0, 0.0, 28.0)]])
def test_who_stands_is_heeded_from_far_and_behind_others(road, between):
    for gap in (200.0, 100.0, 60.0):
        scene = [("a", 100.0, 0.0, 20.0, 28.0), ("b", 100.0 + gap + LENGTH, 0.0, 0.0), *between]
        far = np.sqrt(2.0 * STOPPING * (gap - S0 - LAG * 20.0))
        near = np.sqrt(2.0 * CLOSING_UP * (gap - S0)) if gap < LOOK and not between else np.inf
        assert Traffic(road, scene).update()[0] == pytest.approx(min(far, near), abs=0.3)
    assert behind(road, 400.0, 0.0) == 28.0


def test_without_a_leader_in_reach_or_without_a_time_gap_the_driver_decides(road):
    assert behind(road, 400.0, 5.0) == 28.0
    assert behind(road, 5.0, 5.0, time_gap=0.0) == 28.0
    assert Traffic(road, [("a", 100.0, 0.0, 20.0, 0.0)]).update()[0] == LIMIT  # the lane's limit


@pytest.mark.parametrize(
    ("turn", "speed", "told"), [(0.15, 12.0, 28.0), (0.25, 12.0, 12.0), (-0.25, 2.0, 5.0)]
)
def test_vehicles_askew_do_not_speed_up(road, turn, speed, told):
    traffic = Traffic(road, [("a", 100.0, 0.0, speed, 28.0)])
    traffic.table["yaw"][traffic.rows] = turn
    assert traffic.update()[0] == pytest.approx(told)


def test_what_is_wanted_is_kept_apart(road):
    traffic = Traffic(road, [("a", 100.0, 0.0, 20.0, 28.0), ("b", 120.0, 0.0, 10.0)])
    assert traffic.update()[0] < 15.0
    assert traffic.table.wanted_speed[traffic.rows[0]] == 28.0


def test_a_vehicle_that_changes_lanes_heeds_both_lanes_the_new_one_gently(road):
    for x, expected in ((190.0, behind(road, 85.0, 12.0)), (112.0, 12.0 - 9.9 / OTHER_LANE[0])):
        scene = [("a", 100.0, 0.0, 20.0, 28.0), ("slow", 160.0, 0.0, 15.0), ("slower", x, W, 12.0)]
        traffic = Traffic(road, scene)
        alone = traffic.update()[0]
        assert alone == pytest.approx(behind(road, 55.0, 15.0))
        traffic.planner._changing["a"] = (0, 1, 99.0)
        assert traffic.update()[0] == pytest.approx(min(alone, expected), abs=0.15)


def test_those_who_reach_their_target_speed_at_once_come_to_the_desired_gap(road):
    """A follower that is always as fast as it is told, within what can be braked, settles T v + s0 behind."""
    traffic = Traffic(road, [("a", 100.0, 0.0, 30.0, 30.0), ("b", 300.0, 0.0, 20.0)])
    a, b = traffic.rows
    table, gaps = traffic.table, []
    for _ in range(700):
        target = float(traffic.update()[0])
        change = np.clip(target - float(table["speed"][a]), -0.3, 0.15)
        table["speed"][a] += change
        table["x"][[a, b]] += 0.1 * table["speed"][[a, b]]
        gaps.append(float(table["x"][b] - table["x"][a]) - LENGTH)
    assert min(gaps) > T * 20.0 * 0.8
    assert gaps[-1] == pytest.approx(S0 + T * 20.0, abs=1.5)
    assert table["speed"][a] == pytest.approx(20.0, abs=0.3)
