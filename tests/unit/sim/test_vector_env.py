"""The Gymnasium adapter: gymnasium's own checks, honest resets, and the very worlds underneath."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils import env_checker
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.wrappers.vector import ClipReward, DictInfoToList, RecordEpisodeStatistics

from phase_sumo.config import ActionConfig, SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.sim.bundle import save_bundle
from phase_sumo.sim.observation import EGO
from phase_sumo.sim.vector_env import NAME, HighwayVectorEnv

HORIZON = SimConfig().horizon
ACTIONS = ActionConfig()
COAST = ACTIONS.jerk.index(0.0) * len(ACTIONS.steering_rate) + ACTIONS.steering_rate.index(0.0)
BRAKE = ACTIONS.steering_rate.index(0.0)
COLUMN = {feature.name: k for k, feature in enumerate(EGO)}


def make(straight_map, num_envs: int = 32, slots: int = 8, **kwargs: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(NAME, num_envs=num_envs, slots=slots, maps=[straight_map], **kwargs)


def rollout(envs, steps: int, seed: int = 0, coast: bool = False) -> list[Any]:
    """What reset and every step return. Coasting agents reach their goals or not; every fourth one stops."""
    envs.action_space.seed(seed)
    begin = envs.reset(seed=seed)
    fixed = np.where(np.arange(envs.num_envs) % 4, COAST, BRAKE)
    actions = (fixed if coast else envs.action_space.sample() for _ in range(steps))
    return [begin, *map(envs.step, actions)]


class OneRow(gymnasium.Env):
    """A vector environment of one agent as a plain environment, which is what `check_env` takes."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, envs: HighwayVectorEnv) -> None:
        self.envs = envs
        self.observation_space, self.action_space = (
            envs.single_observation_space,
            envs.single_action_space,
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        seen, info = self.envs.reset(seed=seed, options=options)
        return {name: values[0] for name, values in seen.items()}, info

    def step(self, action):
        seen, reward, terminated, truncated, info = self.envs.step(np.array([action]))
        first = {name: values[0] for name, values in seen.items()}
        return first, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


@pytest.mark.filterwarnings("ignore:.*infinity", "ignore:.*alternative render modes")
def test_gymnasiums_checker_passes_on_a_row(straight_map):
    env_checker.check_env(OneRow(HighwayVectorEnv(1, maps=[straight_map])))


def test_gymnasiums_checks_pass_on_the_whole(straight_map):
    envs = make(straight_map)
    for check in (
        env_checker.check_seed_deprecation,
        env_checker.check_reset_return_info_deprecation,
        env_checker.check_reset_return_type,
        env_checker.check_reset_seed_determinism,
        env_checker.check_reset_options,
    ):
        check(envs)  # type: ignore[arg-type]
    assert envs.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP


def test_a_seed_fixes_everything_and_nothing_returned_is_used_again(straight_map):
    first, second = (rollout(make(straight_map), 100) for _ in range(2))
    assert data_equivalence(first, second, exact=True)
    assert any("final_obs" in step[-1] for step in first[1:])
    assert not data_equivalence(first[0], make(straight_map).reset(seed=1))
    seen = [(step[0], step[-1]) for step in first]
    kept = rollout(make(straight_map), 3)
    for observation, *_, info in kept:
        for values in observation.values():
            values.fill(7)
        info["active"].fill(False)
    assert data_equivalence(seen[3], [(s[0], s[-1]) for s in rollout(make(straight_map), 3)][3], exact=True)


def test_every_observation_lies_in_its_space_with_its_types(straight_map):
    envs = make(straight_map)
    for step in rollout(envs, 95):
        assert step[0] in envs.observation_space
        for final in step[-1].get("final_obs", ()):
            assert final is None or final in envs.single_observation_space
        if len(step) == 5:
            _, reward, terminated, truncated, _ = step
            assert (reward.dtype, terminated.dtype, truncated.dtype) == (float, bool, bool)
            assert reward.shape == terminated.shape == truncated.shape == (32,)


def test_rows_are_the_slots_of_the_worlds(straight_map):
    """Seed for seed the same as stepping the worlds in torch."""
    envs, other = make(straight_map), make(straight_map)
    for either in (envs, other):
        either.reset(seed=5)
    environment = other.unwrapped.environment  # type: ignore[attr-defined]
    envs.action_space.seed(5)
    for _ in range(95):
        action = envs.action_space.sample()
        seen, reward, terminated, truncated, info = envs.step(action)
        step = environment.step(torch.from_numpy(action).view(4, 8))
        np.testing.assert_array_equal(reward, step.reward.flatten().numpy())
        np.testing.assert_array_equal(terminated, step.terminated.flatten().numpy())
        np.testing.assert_array_equal(truncated, step.truncated.flatten().numpy())
        np.testing.assert_array_equal(info["valid"], step.active.flatten().numpy())
        active = info["active"].reshape(4, 8)
        np.testing.assert_array_equal(active, environment.worlds.active.numpy())
        rows = environment.observation.rows(environment.worlds.active)
        np.testing.assert_array_equal(seen["partner"][info["active"]], rows.partner.numpy())


def test_padding_is_silent_and_the_agents_of_a_world_begin_together(straight_map):
    envs = make(straight_map, num_envs=64, slots=16)
    steps = rollout(envs, 2 * HORIZON, coast=True)
    active = steps[0][1]["active"]
    assert active.any() and not active.all()
    ends, restarts = 0, 0
    for seen, reward, terminated, truncated, info in steps[1:]:
        finished = terminated | truncated
        np.testing.assert_array_equal(info["valid"], active)
        assert not (finished & ~active).any() and (reward[~active] == 0).all()
        left = (active & ~finished).reshape(4, 16)
        following = info["active"].reshape(4, 16)
        for world in range(4):
            if left[world].any():
                np.testing.assert_array_equal(following[world], left[world])
            else:
                assert following[world].any()
                restarts += 1
        assert all((values[~info["active"]] == 0).all() for values in seen.values())
        np.testing.assert_array_equal(info.get("_final_obs", np.zeros(64, bool)), finished)
        ends, active = ends + finished.sum(), info["active"]
    assert ends > 50 and restarts >= 8


def test_what_an_agent_saw_last_follows_from_what_it_saw_before(straight_map):
    envs = make(straight_map, num_envs=64, slots=16)
    steps = rollout(envs, HORIZON, coast=True)
    seen, kinds = steps[0][0], np.zeros(2, int)
    for following, _, terminated, truncated, info in steps[1:]:
        rows = np.flatnonzero(terminated | truncated)
        if len(rows):
            last = np.stack([info["final_obs"][row]["ego"] for row in rows])
            for now, ago in (("accel", "accel_1_ago"), ("steer", "steer_1_ago"), ("alpha", "alpha")):
                np.testing.assert_allclose(
                    last[:, COLUMN[ago]], seen["ego"][rows, COLUMN[now]], rtol=1e-6, atol=1e-7
                )
            driven = (seen["ego"][rows] - last)[:, COLUMN["goal_x"]] * 100
            np.testing.assert_allclose(driven, last[:, COLUMN["speed"]] * 20 * 0.1, atol=0.1)
            kinds += terminated[rows].sum(), truncated[rows].sum()
        seen = following
    assert (kinds > 0).all(), kinds


def test_what_became_of_an_agent(straight_map):
    goals = 0
    for _, _, terminated, truncated, info in rollout(make(straight_map), HORIZON, coast=True)[1:]:
        if "final_info" in info:
            final = info["final_info"]
            assert {"goal", "collision", "at_fault", "road_edge"} <= set(final)
            assert not (final["goal"] & ~terminated).any()
            assert not (final["at_fault"] & ~final["collision"]).any()
            np.testing.assert_array_equal(info["_final_info"], terminated | truncated)
            goals += final["goal"].sum()
    assert goals > 0


def test_gymnasiums_wrappers_work(straight_map):
    envs = DictInfoToList(RecordEpisodeStatistics(ClipReward(make(straight_map), -1.0, 1.0)))
    envs.reset(seed=0)
    returns = []
    for _ in range(HORIZON):
        _, _, terminated, truncated, infos = envs.step(envs.action_space.sample())
        assert [("episode" in info) for info in infos] == (terminated | truncated).tolist()
        returns += [info["episode"]["r"] for info in infos if "episode" in info]
    assert len(returns) > 10 and np.isfinite(returns).all()


def test_flat_observations_hold_the_same_numbers(straight_map):
    flat, tree = make(straight_map, flat=True), make(straight_map)
    space = tree.single_observation_space
    for one, other in zip(rollout(flat, HORIZON), rollout(tree, HORIZON), strict=True):
        assert one[0] in flat.observation_space
        rows = [{name: values[row] for name, values in other[0].items()} for row in (0, 9)]
        np.testing.assert_array_equal(one[0][[0, 9]], [spaces.flatten(space, row) for row in rows])
        for row in np.flatnonzero(one[-1].get("_final_obs", [])):
            expected = spaces.flatten(space, other[-1]["final_obs"][row])
            np.testing.assert_array_equal(one[-1]["final_obs"][row], expected)


def test_progress_of_the_curriculum_can_be_set(straight_map):
    envs = make(straight_map, rho=0.25)
    envs.reset(seed=0)
    unwrapped = envs.unwrapped
    assert isinstance(unwrapped, HighwayVectorEnv) and unwrapped.environment.rho == 0.25
    unwrapped.rho = 1.0
    envs.step(envs.action_space.sample())
    assert unwrapped.environment.rho == 1.0


def test_maps_come_as_bundles_or_files(straight_map, tmp_path):
    save_bundle(tmp_path / "straight.npz", straight_map)
    envs = HighwayVectorEnv(4, maps=[straight_map, tmp_path / "straight.npz"])
    envs.reset(seed=0)
    assert envs.environment.road_map.count == 2
    with pytest.raises(PhaseError, match="maps="):
        HighwayVectorEnv(4)


def test_misuse_is_named(straight_map):
    with pytest.raises(PhaseError, match="num_envs 10 is no multiple of slots 4"):
        make(straight_map, num_envs=10, slots=4)
    envs = make(straight_map)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros(32, int))
    envs.reset(seed=0)
    for actions in (np.zeros(31, int), np.zeros(32), np.full(32, 63), np.full(32, -1)):
        with pytest.raises(PhaseError, match="actions"):
            envs.step(actions)
