"""Which neighbours the bridge shows the policy, against a search of all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.fleet.controller import SAME_WAY, Controller, Steps
from phase_sumo.bridge.fleet.drivers import Drivers
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.guarded import Guarding
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.fleet.target_speeds import TargetSpeeds
from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.sim.synthetic_road import freeway
from tests.helpers.standin import Standin

CAR = shape_from_type("passenger", 5.0, 1.8)


@pytest.fixture(scope="module")
def road():
    return Road(freeway(1.0))


def neighbours(road, x, y, yaw, controlled):
    """Rows of each controlled vehicle's neighbours, nearest first."""
    table = VehicleTable(4)
    for i in range(len(x)):
        row = table.add(f"v{i}", CAR)
        table["x"][row], table["y"][row], table["yaw"][row] = x[i], y[i], yaw[i]
        table.controlled[row] = controlled[i]
    rows = np.flatnonzero(table.controlled)
    speeds = TargetSpeeds(road, table, np.zeros(len(road.count), bool))
    steps = Steps.fit(0.1, 0.1)
    planner, guarding = GoalPlanner(road, table), Guarding(table, {})
    controller = Controller(road, table, Drivers(Standin()), steps, speeds, planner, guarding)
    controller._node = np.full(len(table), -1)  # on no lane: told by the direction
    index, mask = (t.numpy() for t in controller._neighbours(rows, Standin().sim))
    assert (np.diff(mask.astype(int), axis=1) <= 0).all()  # real ones come first
    return table, rows, [i[m].tolist() for i, m in zip(index, mask, strict=True)]


def brute_force(table, row):
    sim = Standin().sim
    found = []
    for other in np.flatnonzero(table.active):
        dx, dy = table["x"][row] - table["x"][other], table["y"][row] - table["y"][other]
        squared = dx * dx + dy * dy
        same_way = np.cos(table["yaw"][row] - table["yaw"][other]) >= SAME_WAY
        if other != row and same_way and squared < sim.neighbour_range**2:
            found.append((squared, int(other)))
    return [other for _, other in sorted(found)[: sim.neighbours]]


@pytest.mark.parametrize(("count", "length"), [(1, 10.0), (9, 900.0), (60, 200.0), (300, 4000.0)])
def test_neighbours_are_those_of_all_pairs(road, count, length):
    rng = np.random.default_rng(count)
    x, y = rng.uniform(-length, 0.0, count), rng.integers(0, 6, count) * 3.7
    yaw = np.where(y > 9.0, np.pi, 0.0) + rng.normal(0.0, 0.05, count)
    controlled = rng.random(count) < 0.9
    controlled[0] = True
    table, rows, found = neighbours(road, x, y, yaw, controlled)
    assert found == [brute_force(table, row) for row in rows]


def test_equally_near_neighbours_come_in_the_order_of_rows(road):
    side = np.arange(11) * 4.0  # a grid of equal distances, whole numbers in float32
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    table, rows, found = neighbours(road, x, y, np.zeros(len(x)), np.ones(len(x), bool))
    assert found == [brute_force(table, row) for row in rows]


def test_the_range_ends_before_its_last_metre(road):
    reach = np.float32(Standin().sim.neighbour_range)
    x = np.array([0.0, reach, -np.nextafter(reach, np.float32(0.0))])
    table, _, found = neighbours(road, x, np.zeros(3), np.zeros(3), np.array([True, False, False]))
    assert found == [[table.row_of["v2"]]]


def test_alone_there_is_nobody(road):
    *_, found = neighbours(road, np.zeros(1), np.zeros(1), np.zeros(1), np.ones(1, bool))
    assert found == [[]]
