"""Rollouts: samples stand in the order of the world columns, and actions follow the policy."""

from __future__ import annotations

import torch

from phase_sumo.config import preset
from phase_sumo.policy.build import build_network
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.environment import Environment
from phase_sumo.train.rollout import ROWS, Buffer, collect, draw

MEAN, STD = 0.5, 2.0


def environment(bundle: MapBundle) -> Environment:
    c = preset("smoke")
    return Environment([bundle], 6, 8, c.sim, c.scenarios, c.reward, c.actions, seed=4)


def test_samples_are_those_of_the_active_agents_in_order(straight_map):
    config, env = preset("smoke"), environment(straight_map)
    torch.manual_seed(0)
    network, buffer = build_network(config.network, config.actions).eval(), Buffer(env.observation, 5)
    generator = torch.Generator().manual_seed(1)
    for _ in range(2):  # the second one finds the first one's samples in the buffer
        first = env.observation.rows(env.worlds.active)
        rollout = collect(env, network, buffer, 5, 0.99, (MEAN, STD), generator, bf16=False)
        with torch.no_grad():
            logits, value = network(rollout.observation)
        taken = logits.log_softmax(-1).gather(-1, rollout.action.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(rollout.log_prob, taken)
        torch.testing.assert_close(rollout.value[rollout.active], value * STD + MEAN)
        assert torch.equal(rollout.observation.road[: len(first)], first.road)
        active = env.worlds.active
        with torch.no_grad():
            last = network(env.observation.rows(active))[1] * STD + MEAN
        torch.testing.assert_close(rollout.last_value[active], last)
        assert not rollout.last_value[~active].any()
        assert rollout.counts.steps == int(rollout.active.sum()) == len(rollout.action)


def test_the_buffer_hands_out_whole_batches_and_keeps_the_layout(straight_map):
    env = environment(straight_map)
    buffer, index = Buffer(env.observation, 1), torch.tensor([3, 0, 20])
    rows = buffer.put(env.observation, index, 2)
    assert len(rows) == ROWS and rows.road.transpose(1, 2).is_contiguous()
    assert torch.equal(rows.partner[:3], env.observation.partner.flatten(0, 1)[index])
    assert not rows.road_mask[3:].any()


def test_actions_are_drawn_as_often_as_they_are_likely():
    chance = torch.tensor([0.0, 0.1, 0.0, 0.6, 0.3, 0.0])
    tokens = draw(chance.log().expand(20_000, -1), torch.Generator().manual_seed(0))
    share = torch.bincount(tokens, minlength=6) / len(tokens)
    torch.testing.assert_close(share, chance, atol=0.015, rtol=0.0)  # 4 standard deviations
    assert not share[chance == 0.0].any()
