"""Scenario sampling and the environment's bookkeeping."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from phase_sumo.config import REGIMES, ActionConfig, RewardConfig, ScenarioConfig, SimConfig
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.vehicles import boxes

ACTIONS = ActionConfig()
COAST = ACTIONS.jerk.index(0.0) * len(ACTIONS.steering_rate) + ACTIONS.steering_rate.index(0.0)


def make(straight_map, worlds=8, slots=24, seed=0, training=False, scenarios=None) -> Environment:
    scenarios = scenarios or ScenarioConfig(agent_scale=0.25)
    return Environment(
        [straight_map],
        worlds,
        slots,
        SimConfig(),
        scenarios,
        RewardConfig(),
        ACTIONS,
        seed,
        training=training,
    )


def coast(env: Environment) -> torch.Tensor:
    return torch.full(env.active.shape, COAST)


def test_spawned_agents_do_not_overlap_and_fit_their_regime(straight_map):
    env = make(straight_map, worlds=32)
    box = boxes(env.shape, env.state)
    touch = boxes_overlap(box[:, :, :, None, :, None], box[:, :, None, :, None, :]).flatten(-2).any(-1)
    pairs = touch & env.active.unsqueeze(1) & env.active.unsqueeze(2) & ~torch.eye(24, dtype=torch.bool)
    assert not pairs.any()
    for w in range(32):
        regime = REGIMES[env.regime_index[w]]
        speeds = env.state.speed[w][env.active[w]]
        assert (speeds >= 0.6 * regime.base_speed - 1e-3).all()
        assert (speeds <= min(1.4 * regime.base_speed, 40.0) + 1e-3).all()
        assert 1 <= env.active[w].sum() <= 24


def test_goals_are_within_the_horizon_and_the_regimes_bounds(straight_map):
    env = make(straight_map, worlds=32)
    distance = torch.hypot(env.task.goal_x - env.state.x, env.task.goal_y - env.state.y)
    for w in range(32):
        low, high = REGIMES[env.regime_index[w]].path_bounds
        reached = distance[w][env.active[w]]
        assert (reached > 0.8 * low).all() and (reached < high + 3.0).all()
    slowest = torch.minimum(env.state.speed, env.task.goal_speed)
    in_time = distance / slowest.clamp_min(0.1) < SimConfig().horizon * SimConfig().dt
    assert in_time[env.active].float().mean() > 0.95


def test_lane_change_share_follows_the_configuration(straight_map):
    regimes = tuple(
        dataclasses.replace(r, lane_change_ratio=share)
        for r, share in zip(REGIMES, (0.0, 1.0, 0.0, 1.0), strict=True)
    )
    env = make(straight_map, worlds=40, scenarios=ScenarioConfig(regimes=regimes, agent_scale=0.25))
    changes = (env.task.goal_y - env.state.y).abs() > 2.0
    for w in range(40):
        wanted = regimes[env.regime_index[w]].lane_change_ratio
        assert (changes[w][env.active[w]].float() == wanted).all()


def test_truck_share_and_trailers(straight_map):
    env = make(straight_map, worlds=64, scenarios=ScenarioConfig(agent_scale=0.25, truck_ratio=0.5))
    trucks = env.shape.truck[env.active].float().mean()
    assert 0.3 < trucks < 0.6  # long vehicles are rejected a little more often
    assert (env.shape.trailer_length[~env.shape.truck] == 0).all()
    assert (env.shape.articulated & env.active).any()


def test_the_same_seed_gives_the_same_worlds(straight_map):
    def play(seed: int) -> list[torch.Tensor]:
        env = make(straight_map, seed=seed, training=True)
        rewards = [env.step(coast(env)).reward for _ in range(30)]
        return [*rewards, env.state.x, env.observation.road]

    for a, b in zip(play(1), play(1), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(play(1)[-2], play(2)[-2])


def test_episodes_end_by_goal_unrecoverable_or_time_and_worlds_start_again(straight_map):
    env = make(straight_map, worlds=16)
    ended = torch.zeros(16, 24, dtype=torch.long)
    kinds = {"goal": 0, "unrecoverable": 0, "truncated": 0}
    began = env.active.clone()
    action = coast(env)
    action[::2, 0] = 4  # full braking, straight on: these stop and run out of time
    for t in range(SimConfig().horizon):
        first = (env.clock == t).unsqueeze(-1)
        step = env.step(action)
        ended += (step.finished & first).long()
        kinds["goal"] += int((step.outcome.goal & step.terminated).sum())
        kinds["unrecoverable"] += int((step.terminated & ~step.outcome.goal).sum())
        kinds["truncated"] += int(step.truncated.sum())
        assert not (step.finished & ~step.active).any()
        assert (step.reward[~step.active] == 0).all() and step.reward.isfinite().all()
        assert len(step.final) == int(step.truncated.sum())
        assert len(env.observation) == int(env.active.sum())
    assert torch.equal(ended, began.long())  # every agent of the first scenarios ended exactly once
    assert all(count > 0 for count in kinds.values()), kinds
    assert env.active.any(-1).all()


def test_a_batch_of_worlds_equals_the_worlds_one_by_one(straight_map):
    """Worlds do not touch each other: blanking all but one leaves that one's future unchanged."""
    for w in range(6):
        alone = make(straight_map, worlds=6)
        others = torch.ones(6, dtype=torch.bool)
        others[w] = False
        alone.active = alone.active & ~others.unsqueeze(-1)
        alone.active[others, 0] = True
        reference = make(straight_map, worlds=6)
        for _ in range(10):
            a, b = alone.step(coast(alone)), reference.step(coast(reference))
            torch.testing.assert_close(a.reward[w], b.reward[w])
        torch.testing.assert_close(alone.state.x[w], reference.state.x[w])


def test_state_dict_continues_bit_for_bit(straight_map):
    env = make(straight_map, training=True)
    for _ in range(20):
        env.step(coast(env))
    stored = env.state_dict()
    other = make(straight_map, seed=99, training=True)
    other.load_state_dict(stored)
    for _ in range(40):
        assert torch.equal(env.step(coast(env)).reward, other.step(coast(other)).reward)


@pytest.mark.parametrize("jerk", [-8.0, 5.0])
@pytest.mark.parametrize("rate", [-0.3, 0.3])
def test_everything_stays_finite_under_extreme_actions(straight_map, jerk: float, rate: float):
    env = make(straight_map, training=True)
    token = ACTIONS.jerk.index(jerk) * len(ACTIONS.steering_rate) + ACTIONS.steering_rate.index(rate)
    for _ in range(60):
        step = env.step(torch.full(env.active.shape, token))
        assert step.reward.isfinite().all()
        assert all(t.isfinite().all() for t in vars(env.observation).values())
