"""The guard over rows of a table: whom it keeps from what, whom it leaves alone, and what is counted."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from phase_sumo.bridge.fleet.controller import Controller, Steps
from phase_sumo.bridge.fleet.drivers import Drivers
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.guarded import Guarding, tally
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.scene import Trip
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.fleet.target_speeds import TargetSpeeds
from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.config import ActionConfig, SimConfig
from phase_sumo.sim.synthetic_road import freeway
from tests.helpers.rollouts import token
from tests.helpers.standin import liking

CAR = shape_from_type("passenger", 5.0, 1.8)


class Gas:
    """Full throttle straight on."""

    sim, actions = SimConfig(), ActionConfig()

    def scores(self, observation):
        return liking(torch.full((len(observation),), token(5.0, 0.0)), self.actions)


@pytest.fixture(scope="module")
def road():
    return Road(freeway(1.0))


def driven(road, guards, gap, speed, seconds=0.1):
    """Vehicles "v0", "v1" ... under PHASE in lanes of their own, each ``gap`` m behind one that stands.

    Args:
        guards: whether each has a guard.

    Returns:
        table, trips, guarding.
    """
    lanes = [i for i, lane in enumerate(road.network.lanes) if not lane.connector]
    table, trips = VehicleTable(8), {}
    for k, guard in enumerate(guards):
        first = int(road.first[lanes[k]])
        for name, at, own in ((f"v{k}", first + 100, True), (f"w{k}", first + 105 + gap, False)):
            row = table.add(name, CAR)
            table["x"][row], table["y"][row] = road.graph.node_xy[at - 4]
            table["yaw"][row], table["speed"][row] = road.graph.node_yaw[at], speed * own
            table["alpha"][row], table.controlled[row], table.guarded[row] = 1.0, own, own and guard
            trips[name] = Trip(name, "car", 0.0)
    speeds = TargetSpeeds(road, table, np.zeros(len(road.count), bool))
    planner, guarding = GoalPlanner(road, table), Guarding(table, trips)
    controller = Controller(road, table, Drivers(Gas()), Steps.fit(0.1, 0.1), speeds, planner, guarding)
    for k in range(round(seconds / 0.1)):
        controller.drive(0.1 * k, np.full(len(table), -1), {})  # no lane, hence no goals
    return table, trips, guarding


def test_only_vehicles_with_a_guard_are_kept_from_who_stands_ahead(road):
    table, trips, guarding = driven(road, (True, False), gap=28, speed=20.0)
    accel = table["accel"][[table.row_of["v0"], table.row_of["v1"]]]
    assert accel[0] < -0.5 and accel[1] == pytest.approx(0.5)
    assert guarding.decisions == 1 and trips["v0"].guard_standing == 1
    assert trips["v0"].guard_seconds == pytest.approx(0.1)
    assert trips["v0"].guard_jerk == pytest.approx(0.5 - accel[0], abs=1e-3)
    assert trips["v1"] == Trip("v1", "car", 0.0)
    total = tally(trips.values(), guarding.decisions)
    assert total["guard_interventions"] == total["guard_standing"] == 1
    assert total["guard_share_of_decisions"] == 1.0 and total["guard_leader"] == 0


def test_it_stops_behind_who_stands_and_would_not_without(road):
    table, trips, _ = driven(road, (True, False), gap=60, speed=20.0, seconds=8.0)
    assert 5.3 < np.hypot(*_apart(table, 0)) < 7.0 and table["speed"][table.row_of["v0"]] < 0.5
    assert np.hypot(*_apart(table, 1)) > 5.0 and table["speed"][table.row_of["v1"]] > 20.0
    assert trips["v0"].guard_unsafe < 3 < trips["v0"].guard_standing


def test_what_is_safe_is_left_alone(road):
    table, trips, guarding = driven(road, (True,), gap=250, speed=20.0)
    assert table["accel"][table.row_of["v0"]] == pytest.approx(0.5)
    assert guarding.decisions == 1 and trips["v0"] == Trip("v0", "car", 0.0)


def _apart(table, k):
    a, b = table.row_of[f"v{k}"], table.row_of[f"w{k}"]
    return table["x"][b] - table["x"][a], table["y"][b] - table["y"][a]
