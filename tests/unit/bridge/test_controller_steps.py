"""SUMO's steps and the policy's: which fit, when is decided, and that a decision in parts is one decision."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from phase_sumo.bridge.fleet.controller import Controller, Steps
from phase_sumo.bridge.fleet.drivers import Drivers
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.guarded import Guarding
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.table import STATE, VehicleTable
from phase_sumo.bridge.fleet.target_speeds import TargetSpeeds
from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.config import ActionConfig, SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.sim.observation import LAYOUT, Observation
from phase_sumo.sim.synthetic_road import freeway
from tests.helpers.standin import liking

CAR, SEMI = shape_from_type("passenger", 5.0, 1.8), shape_from_type("trailer", 22.0, 2.6)
SPEEDS = (0.0, 8.0, 35.0)
BRAKE, GAS, LEFT = 1 * 9 + 4, 5 * 9 + 4, 4 * 9 + 6  # tokens: jerk -4, jerk 3, jerk 1.5 with 0.02 rad/s
PARTS = pytest.mark.parametrize("parts", [2, 4, 5, 10])


@pytest.mark.parametrize(
    ("sumo", "per_sumo_step", "per_decision", "seconds"),
    [
        (0.001, 1, 100, 0.001),
        (0.01, 1, 10, 0.01),
        (0.02, 1, 5, 0.02),
        (0.025, 1, 4, 0.025),
        (0.05, 1, 2, 0.05),
        (0.1, 1, 1, 0.1),
        (0.5, 5, 1, 0.1),
        (1.0, 10, 1, 0.1),
    ],
)
def test_steps_that_divide_the_policys_or_are_multiples_of_it(sumo, per_sumo_step, per_decision, seconds):
    steps = Steps.fit(sumo, 0.1)
    assert (steps.per_sumo_step, steps.per_decision) == (per_sumo_step, per_decision)
    assert steps.seconds == pytest.approx(seconds, rel=1e-12)
    assert steps.per_sumo_step * steps.seconds == pytest.approx(sumo, rel=1e-12)


@pytest.mark.parametrize(
    ("sumo", "nearest"),
    [
        (0.007, "0.005"),
        (0.03, "0.025"),
        (0.04, "0.05"),
        (0.06, "0.05"),
        (0.08, "0.1"),
        (0.25, "0.2"),
        (0.97, "1"),
    ],
)
def test_other_steps_are_refused_with_the_nearest_that_fits(sumo, nearest):
    with pytest.raises(PhaseError, match=rf"step-length {sumo:g} s: .* 0\.1 s.*--step-length {nearest}$"):
        Steps.fit(sumo, 0.1)
    Steps.fit(float(nearest), 0.1)


def test_half_way_between_two_that_fit_either_is_named():
    with pytest.raises(PhaseError, match=r"--step-length 0\.[12]$"):
        Steps.fit(0.15, 0.1)


@pytest.mark.parametrize("begin", [0.0, 3600.0, 86399.98])
def test_decisions_are_at_multiples_of_the_policys_step(begin):
    """SUMO's clock is a whole number of ms, which no float is exactly."""
    steps = Steps.fit(0.02, 0.1)
    times = [round(begin + 0.02 * k, 3) for k in range(1000)]
    assert [t for t in times if steps.decides(t)] == [t for t in times if round(1000 * t) % 100 == 0]
    assert all(Steps.fit(0.5, 0.1).decides(t) for t in times)


class Script:
    """Plays tokens, the same for all vehicles, and notes what they saw of themselves."""

    def __init__(self, *tokens: int) -> None:
        self.sim, self.actions = SimConfig(), ActionConfig()
        self.seen: list[torch.Tensor] = []
        self._tokens = tokens

    def scores(self, observation: Observation) -> torch.Tensor:
        self.seen.append(observation.ego.clone())
        return liking(torch.full((len(observation),), self._tokens[len(self.seen) - 1]), self.actions)


@pytest.fixture(scope="module")
def road():
    return Road(freeway(1.0))


def driven(road, step, tokens, begin=0.0, seconds=None, accel=0.0):
    """States of a car and an articulated truck at each of `SPEEDS`, and what the script saw.

    They start at ``begin`` s and move for ``seconds``, or for as long as the tokens last.
    """
    table, script = VehicleTable(8), Script(*tokens)
    for k, speed in enumerate(SPEEDS):
        for name, shape in (("car", CAR), ("semi", SEMI)):
            row = table.add(f"{name}{k}", shape)
            table["x"][row], table["y"][row] = 100.0, -6.0
            table["speed"][row], table["accel"][row] = speed, accel
            table["alpha"][row], table.controlled[row] = 1.0, True
    steps = Steps.fit(step, script.sim.dt)
    speeds = TargetSpeeds(road, table, np.zeros(len(road.count), bool))
    planner, guarding = GoalPlanner(road, table), Guarding(table, {})
    controller = Controller(road, table, Drivers(script), steps, speeds, planner, guarding)
    nowhere = np.full(len(table), -1)  # no lane, hence no goals
    for k in range(round((seconds or len(tokens) * script.sim.dt) / step)):
        controller.drive(begin + k * step, nowhere, {})
    rows = np.flatnonzero(table.controlled)
    return {name: table[name][rows].astype(np.float64) for name in STATE}, script.seen


@PARTS
def test_parts_of_decisions_are_behind_by_half_a_step_of_the_change_of_speed(road, parts):
    """Closed form: a held over dt moves v dt + a dt^2 at once and v dt + (1 + 1/n) a dt^2 / 2 in n parts."""
    tokens = [GAS, GAS, GAS, BRAKE, GAS]
    (whole, _), (split, _) = (driven(road, step, tokens) for step in (0.1, 0.1 / parts))
    gained = whole["speed"] - np.repeat(SPEEDS, 2)
    assert gained.min() > 0.3
    np.testing.assert_allclose(split["speed"], whole["speed"], rtol=0, atol=1e-4)
    np.testing.assert_allclose(whole["x"] - split["x"], 0.05 * (1 - 1 / parts) * gained, rtol=0, atol=2e-3)


@PARTS
def test_a_decision_in_parts_stays_on_the_path_of_the_whole(road, parts):
    (whole, _), (split, _) = (driven(road, step, [LEFT]) for step in (0.1, 0.1 / parts))
    dx, dy = split["x"] - whole["x"], split["y"] - whole["y"]
    across = dy * np.cos(whole["yaw"]) - dx * np.sin(whole["yaw"])
    np.testing.assert_allclose(across, 0.0, atol=2e-5)
    assert np.hypot(dx, dy).max() < 1e-3
    assert whole["yaw"].max() > 1e-3
    for name, error in (("yaw", 1e-5), ("speed", 1e-5), ("accel", 1e-6), ("steer", 1e-7)):
        np.testing.assert_allclose(split[name], whole[name], rtol=0, atol=error, err_msg=name)
    bent = whole["hitch"] > 1e-4  # relaxes at v / trailer base, 2.7 1/s at most here: Euler's error in dt
    np.testing.assert_allclose(split["hitch"][bent], whole["hitch"][bent], rtol=0.15)
    assert bent.sum() == 2


@PARTS
def test_the_policy_sees_its_own_past_decisions_however_many_parts_they_have(road, parts):
    tokens = [GAS, LEFT, BRAKE, LEFT, GAS]
    (_, whole), (_, split) = (driven(road, step, tokens) for step in (0.1, 0.1 / parts))
    assert len(split) == len(whole) == len(tokens)
    names = [k for k, f in enumerate(LAYOUT["ego"]) if f.name.startswith(("accel", "steer"))]
    assert len(names) == 8
    past = [torch.stack(seen)[..., names] for seen in (whole, split)]
    assert len(past[0][-1, 0].unique()) == 8 - 1  # steered twice only: one angle is there twice
    torch.testing.assert_close(past[1], past[0], rtol=0, atol=2e-6)


def test_between_two_decisions_a_new_vehicle_keeps_its_acceleration(road):
    state, seen = driven(road, 0.02, [GAS], begin=0.04, seconds=0.06, accel=1.0)
    assert not seen
    np.testing.assert_allclose(state["speed"], np.add(np.repeat(SPEEDS, 2), 0.06), rtol=1e-6)
    assert (state["accel"] == 1.0).all()
    assert (state["accel_history"] == 0.0).all()
    _, seen = driven(road, 0.02, [GAS], begin=0.04, seconds=0.08, accel=1.0)
    assert len(seen) == 1
