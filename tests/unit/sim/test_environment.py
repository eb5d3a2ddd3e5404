"""Scenario sampling and the environment's bookkeeping."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import pytest
import torch

from phase_sumo.config import REGIMES, ActionConfig, RewardConfig, ScenarioConfig, SimConfig, TaskConfig
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.events import agent_contacts
from phase_sumo.sim.vehicles import boxes
from tests.helpers.rollouts import token

ACTIONS = ActionConfig()
COAST = ACTIONS.jerk.index(0.0) * len(ACTIONS.steering_rate) + ACTIONS.steering_rate.index(0.0)


def make(straight_map, worlds=8, slots=24, seed=0, training=False, scenarios=None, **options) -> Environment:
    scenarios = scenarios or ScenarioConfig(agent_scale=0.25)
    return Environment(
        [straight_map],
        worlds,
        slots,
        TaskConfig(scenarios=scenarios),
        seed,
        training=training,
        **options,
    )


def coast(env: Environment) -> torch.Tensor:
    return torch.full(env.worlds.active.shape, COAST)


def test_spawned_agents_do_not_overlap_and_fit_their_regime(straight_map):
    env = make(straight_map, worlds=32)
    box = boxes(env.worlds.shape, env.worlds.state)
    assert not agent_contacts(box, env.worlds.active, 24)[0].any()
    for w in range(32):
        regime = REGIMES[env.regime_index[w]]
        speeds = env.worlds.state.speed[w][env.worlds.active[w]]
        assert (speeds >= 0.6 * regime.base_speed - 1e-3).all()
        assert (speeds <= min(1.4 * regime.base_speed, 40.0) + 1e-3).all()
        assert 1 <= env.worlds.active[w].sum() <= 24


def test_goals_are_within_the_horizon_and_the_regimes_bounds(straight_map):
    env = make(straight_map, worlds=32)
    distance = torch.hypot(
        env.worlds.task.goal_x - env.worlds.state.x, env.worlds.task.goal_y - env.worlds.state.y
    )
    for w in range(32):
        low, high = REGIMES[env.regime_index[w]].path_bounds
        reached = distance[w][env.worlds.active[w]]
        assert (reached > 0.8 * low).all() and (reached < high + 3.0).all()
    slowest = torch.minimum(env.worlds.state.speed, env.worlds.task.goal_speed)
    in_time = distance / slowest.clamp_min(0.1) < SimConfig().horizon * SimConfig().dt
    assert in_time[env.worlds.active].float().mean() > 0.95


def test_lane_change_share_follows_the_configuration(straight_map):
    regimes = tuple(
        dataclasses.replace(r, lane_change_ratio=share)
        for r, share in zip(REGIMES, (0.0, 1.0, 0.0, 1.0), strict=True)
    )
    env = make(straight_map, worlds=40, scenarios=ScenarioConfig(regimes=regimes, agent_scale=0.25))
    changes = (env.worlds.task.goal_y - env.worlds.state.y).abs() > 2.0
    for wanted in (0.0, 1.0):
        worlds = torch.tensor([regimes[r].lane_change_ratio == wanted for r in env.regime_index.tolist()])
        # where the road ends too soon for one kind of goal the other kind serves
        assert changes[worlds][env.worlds.active[worlds]].float().mean() == pytest.approx(wanted, abs=0.05)


def test_truck_share_and_trailers(straight_map):
    env = make(straight_map, worlds=64, scenarios=ScenarioConfig(agent_scale=0.25, truck_ratio=0.5))
    trucks = env.worlds.shape.truck[env.worlds.active].float().mean()
    assert trucks == pytest.approx(0.5, abs=0.02)
    assert (env.worlds.shape.trailer_length[~env.worlds.shape.truck] == 0).all()
    assert (env.worlds.shape.articulated & env.worlds.active).any()


def test_the_same_seed_gives_the_same_worlds(straight_map):
    def play(seed: int) -> list[torch.Tensor]:
        env = make(straight_map, seed=seed, training=True)
        rewards = [env.step(coast(env)).reward for _ in range(30)]
        return [*rewards, env.worlds.state.x, env.observation.road]

    for a, b in zip(play(1), play(1), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(play(1)[-2], play(2)[-2])


def test_episodes_end_by_goal_unrecoverable_or_time_and_worlds_start_again(straight_map):
    env = make(straight_map, worlds=16)
    ended = torch.zeros(16, 24, dtype=torch.long)
    kinds = {"goal": 0, "unrecoverable": 0, "truncated": 0}
    began = env.worlds.active.clone()
    action = coast(env)
    action[::2, 0] = 4  # full braking, straight on: these stop and run out of time
    for t in range(SimConfig().horizon):
        first = (env.worlds.clock == t).unsqueeze(-1)
        step = env.step(action)
        ended += (step.finished & first).long()
        kinds["goal"] += int((step.outcome.goal & step.terminated).sum())
        kinds["unrecoverable"] += int((step.terminated & ~step.outcome.goal).sum())
        kinds["truncated"] += int(step.truncated.sum())
        assert not (step.finished & ~step.active).any()
        assert (step.reward[~step.active] == 0).all() and step.reward.isfinite().all()
    assert torch.equal(ended, began.long())  # every agent of the first scenarios ended exactly once
    assert all(count > 0 for count in kinds.values()), kinds
    assert env.worlds.active.any(-1).all()


def test_without_early_termination_only_goal_and_time_end_an_episode(straight_map):
    env = make(straight_map)
    env.task = replace(env.task, sim=SimConfig(early_termination=False))
    for _ in range(SimConfig().horizon):
        step = env.step(coast(env))
        assert not (step.terminated & ~step.outcome.goal).any()


@pytest.mark.parametrize("end", [False, True])
def test_contacts_end_an_episode_where_the_reward_says_so(straight_map, end: bool):
    env = make(straight_map)
    env.task = replace(env.task, reward=RewardConfig(contacts_end=end))
    swerve = torch.full_like(coast(env), token(5.0, 0.3))
    touched = ended = 0
    for _ in range(SimConfig().horizon):
        before = env.worlds.outcome
        step = env.step(swerve)
        first = step.active & ~(before.at_fault | before.road_edge)
        now = first & (step.outcome.at_fault | step.outcome.road_edge)
        touched += int(now.sum())
        ended += int((now & step.terminated & ~step.outcome.goal).sum())
    assert touched > 50
    assert (ended == touched) if end else (ended < 0.5 * touched)


def test_a_batch_of_worlds_equals_the_worlds_one_by_one(straight_map):
    """Worlds do not touch each other: blanking all but one leaves that one's future unchanged."""
    for w in range(6):
        alone = make(straight_map, worlds=6)
        others = torch.ones(6, dtype=torch.bool)
        others[w] = False
        alone.worlds.active = alone.worlds.active & ~others.unsqueeze(-1)
        alone.worlds.active[others, 0] = True
        reference = make(straight_map, worlds=6)
        for _ in range(10):
            a, b = alone.step(coast(alone)), reference.step(coast(reference))
            torch.testing.assert_close(a.reward[w], b.reward[w])
        torch.testing.assert_close(alone.worlds.state.x[w], reference.worlds.state.x[w])


def test_state_dict_continues_bit_for_bit(straight_map):
    env = make(straight_map, training=True)
    for _ in range(20):
        env.step(coast(env))
    stored = env.state_dict()
    other = make(straight_map, seed=99, training=True)
    other.load_state_dict(stored)
    for _ in range(40):
        for mine, theirs in zip(
            vars(env.observation).values(), vars(other.observation).values(), strict=True
        ):
            assert torch.equal(mine, theirs)
        assert torch.equal(env.step(coast(env)).reward, other.step(coast(other)).reward)


@pytest.mark.parametrize("jerk", [-8.0, 5.0])
@pytest.mark.parametrize("rate", [-0.3, 0.3])
def test_everything_stays_finite_under_extreme_actions(straight_map, jerk: float, rate: float):
    env = make(straight_map, training=True)
    token = ACTIONS.jerk.index(jerk) * len(ACTIONS.steering_rate) + ACTIONS.steering_rate.index(rate)
    for _ in range(60):
        step = env.step(torch.full(env.worlds.active.shape, token))
        assert step.reward.isfinite().all()
        assert all(t.isfinite().all() for t in vars(env.observation).values())


def test_rolling_goals_go_on_until_the_road_ends(straight_map):
    env = make(straight_map, worlds=16, scenarios=ScenarioConfig(agent_scale=0.25, rolling_worlds=1.0))
    reached = ended_at_goal = 0
    for _ in range(SimConfig().horizon - 1):
        before = env.worlds
        step = env.step(coast(env))
        same = ~step.over.unsqueeze(-1) & step.active
        moved = same & (env.worlds.goal_node != before.goal_node)
        reached += int(moved.sum())
        assert not (moved & step.terminated & ~step.outcome.goal).any()
        # the next goal lies ahead in the direction of travel, the context stays
        ahead = (env.worlds.task.goal_x - env.worlds.state.x)[moved]
        assert (ahead > 0).all()
        assert torch.equal(env.worlds.task.alpha[moved], before.task.alpha[moved])
        first = step.outcome.goal & ~before.outcome.goal
        at_the_end = same & step.terminated & first & ~moved
        ended_at_goal += int(at_the_end.sum())
        assert (env.worlds.state.x[at_the_end] > 300).all()
    assert reached > 100
    assert ended_at_goal > 0


@pytest.mark.parametrize("training", [True, False])
def test_some_agents_see_what_they_see_among_all(straight_map, training: bool):
    env = make(straight_map, training=training)
    index = env.worlds.active.flatten().nonzero().squeeze(-1)[1::2]
    some, every = env.seen_by(index), env.observation
    for rows, values in zip(vars(some).values(), vars(every).values(), strict=True):
        torch.testing.assert_close(rows, values.flatten(0, 1)[index])
    assert env.observation is every  # not worked out again, nor perturbed anew
