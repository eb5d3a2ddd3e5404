"""Each reward term by hand, the curriculum multipliers, and finiteness at standstill."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from phase_sumo.config import RewardConfig, SimConfig
from phase_sumo.sim.curriculum import curriculum_progress
from phase_sumo.sim.events import Events
from phase_sumo.sim.reward import Multipliers, alignment, goal_quality, progress, rewards
from phase_sumo.train.presets import preset
from tests.helpers.factories import column, task_to, vehicle_state

SIM = SimConfig()
SI = RewardConfig(distance_unit=1.0)


def events(**happened: bool) -> Events:
    names = [f.name for f in dataclasses.fields(Events)]
    return Events(*(torch.tensor([[happened.get(name, False)]]) for name in names))


def terms(config=SI, rho=0.0, before=None, after=None, task=None, **happened):
    after = vehicle_state(x=10.0, speed=20.0) if after is None else after
    before = vehicle_state(x=8.0, speed=20.0) if before is None else before
    task = task_to() if task is None else task
    now, multipliers = events(**happened), Multipliers.at(rho, config)
    all_terms = rewards(before, after, task, now, multipliers, config, SIM)
    return {name: value.item() for name, value in all_terms.items()}


def test_multipliers_at_the_ends_of_the_curriculum():
    start, end = Multipliers.at(0.0, SI), Multipliers.at(1.0, SI)
    assert (start.penalty, start.progress) == (1.0, 1.0)
    assert (end.penalty, end.progress) == (pytest.approx(2.69), 0.0)
    quality = torch.tensor([1.0, 0.1, 0.01])
    torch.testing.assert_close(start.goal(quality), torch.ones(3))
    torch.testing.assert_close(end.goal(quality), quality)


def test_penalties_grow_with_the_curriculum_and_fall_on_the_culprit_only():
    assert terms(collision=True)["collision"] == 0.0
    assert terms(at_fault=True)["collision"] == pytest.approx(-1.0)
    assert terms(at_fault=True, rho=1.0)["collision"] == pytest.approx(-2.69)
    assert terms(road_edge=True)["road_edge"] == pytest.approx(-0.9)
    assert terms(road_edge=True, rho=0.5)["road_edge"] == pytest.approx(-0.9 * 1.845)


def test_who_is_not_at_fault_pays_a_share():
    config = RewardConfig(collision=5.0, not_at_fault=0.25)
    assert terms(config, collision=True, at_fault=True)["collision"] == pytest.approx(-5.0)
    assert terms(config, collision=True)["collision"] == pytest.approx(-1.25)


@pytest.mark.parametrize("rho", [0.0, 1.0])
def test_the_baseline_knows_goal_collision_and_road_edge_only(rho: float):
    config = preset("gpudrive").reward
    worst = vehicle_state(x=99.0, speed=0.0, yaw=3.0)
    happened = dict.fromkeys(("goal", "collision", "road_edge", "unrecoverable"), True)
    found = terms(config, rho, after=worst, **happened)
    assert {name: value for name, value in found.items() if value} == {
        "goal": 1.0,
        "collision": -0.75,
        "road_edge": -0.75,
    }


def test_termination_costs_the_distance_left():
    assert terms(unrecoverable=True)["termination"] == pytest.approx(-8.3 * 90.0)
    assert terms(RewardConfig(), unrecoverable=True)["termination"] == pytest.approx(-8.3 * 90.0 / 20.0)


def test_goal_reward_and_its_quality():
    near = vehicle_state(x=99.0, speed=20.5, yaw=0.05)
    assert terms(after=near, goal=True)["goal"] == pytest.approx(3.3)
    for state, quality in (
        (near, 1.0),
        (vehicle_state(x=99.0, speed=25.0), 0.1),
        (vehicle_state(x=99.0, speed=20.0, yaw=0.3), 0.1),
        (vehicle_state(x=99.0, speed=10.0, yaw=0.3), 0.01),
    ):
        assert goal_quality(state, task_to(), SI).item() == pytest.approx(quality)
        assert terms(after=state, goal=True, rho=1.0)["goal"] == pytest.approx(3.3 * quality, rel=1e-4)


def test_speed_and_lane_terms():
    assert terms(after=vehicle_state(x=10.0, speed=17.0))["speed"] == pytest.approx(-0.07 * 3.0)
    slower = RewardConfig(speed=0.05, speed_below=0.005)
    assert terms(slower, after=vehicle_state(x=10.0, speed=17.0))["speed"] == pytest.approx(-0.005 * 3.0)
    assert terms(slower, after=vehicle_state(x=10.0, speed=23.0))["speed"] == pytest.approx(-0.05 * 3.0)
    assert terms()["lane"] == pytest.approx(0.005)
    assert terms(lane_boundary=True)["lane"] == 0.0


def test_progress_by_hand():
    expected = (92.0 - 1.01 * 90.0) / 20.0 * math.exp(-0.9)
    got = progress(column(92.0, 1), column(90.0, 1), column(20.0, 1), SI).item()
    assert got == pytest.approx(expected, rel=1e-4)
    assert terms()["progress"] == pytest.approx(0.25 * expected, rel=1e-4)
    assert terms(rho=1.0)["progress"] == 0.0
    assert progress(column(92.0, 1), column(10.0, 1), column(1.0, 1), SI).item() == 0.5
    assert progress(column(10.0, 1), column(92.0, 1), column(1.0, 1), SI).item() == -0.5


def test_alignment_grows_as_time_to_go_shrinks():
    state, task = vehicle_state(speed=20.0), task_to(goal_x=50.0, goal_y=5.0)
    distance = torch.hypot(task.goal_x, task.goal_y)
    expected = math.atan2(5.0, 50.0) * (1.0 - distance.item() / 100.0)
    assert alignment(state, task, distance, state.speed, SI).item() == pytest.approx(expected, rel=1e-5)
    slow = torch.full((1, 1), 5.0)
    assert alignment(state, task, distance, slow, SI).item() == 0.0


@pytest.mark.parametrize("config", [SI, RewardConfig()], ids=["SI units", "default units"])
def test_all_terms_are_finite_at_standstill_and_at_the_goal(config):
    standing = vehicle_state(x=100.0, speed=0.0)
    happened = {f.name: True for f in dataclasses.fields(Events)}
    values = terms(config, 0.5, standing, standing, task_to(goal_x=100.0), **happened)
    assert all(math.isfinite(v) for v in values.values())


def test_curriculum_progress():
    assert [curriculum_progress(s, 100.0, 0.2, 0.8) for s in (0, 20, 50, 80, 100)] == pytest.approx(
        [0.0, 0.0, 0.5, 1.0, 1.0]
    )
