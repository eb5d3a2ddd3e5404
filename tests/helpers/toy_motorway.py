"""A hand-made motorway of straight lanes, and vehicles put on it."""

from __future__ import annotations

import numpy as np

from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.sim.lanes import Lane

W = 3.6


def lane(edge, index, x0, x1, y=None, **kwargs):
    y = index * W if y is None else y
    points = np.array([[x0, y], [x1, y]], float)
    return Lane(f"{edge}_{index}", edge, points, W, 30.0, float(x1 - x0), **kwargs)


def put(table: VehicleTable, name, x, y, speed, goal_speed=None) -> int:
    """A car with its front bumper at x, which PHASE drives if it has a target speed."""
    row = table.add(name, shape_from_type("passenger", 5.0, 1.8))
    table["x"][row], table["y"][row], table["speed"][row] = x - 4.0, y, speed
    if goal_speed is not None:
        table.controlled[row] = True
        table["goal_speed"][row] = table.wanted_speed[row] = goal_speed
    return row


def nodes(table: VehicleTable, road: Road) -> np.ndarray:
    """[N] of the front bumpers, -1 for empty rows."""
    x, y = table.front
    node, active = np.full(len(table), -1), np.flatnonzero(table.active)
    node[active], _ = road.track(node[active], x[active], y[active], table["yaw"][active])
    return node


def plan(planner: GoalPlanner, time: float, table: VehicleTable, road: Road, routes) -> None:
    """Set goals as `Controller.drive` does."""
    node = nodes(table, road)
    planner.update(time, node, Occupancy(road, table, node), routes)
