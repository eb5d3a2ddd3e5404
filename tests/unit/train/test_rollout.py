"""Rollouts: samples stand in the order of the world columns, and actions follow the policy."""

from __future__ import annotations

import pytest
import torch

from phase_sumo.policy.build import build_network
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.environment import Environment
from phase_sumo.train.presets import preset
from phase_sumo.train.rollout import ROWS, Buffer, collect, whole_batches

MEAN, STD = 0.5, 2.0


def environment(bundle: MapBundle) -> Environment:
    c = preset("smoke")
    return Environment([bundle], 6, 8, c, seed=4)


def test_samples_are_those_of_the_active_agents_in_order(straight_map):
    config, env = preset("smoke"), environment(straight_map)
    torch.manual_seed(0)
    network, buffer = build_network(config.network, config.actions).eval(), Buffer(env, 5)
    generator = torch.Generator().manual_seed(1)
    for _ in range(2):  # the second one finds the first one's samples in the buffer
        first = env.observation.rows(env.worlds.controlled)
        rollout = collect(env, network, buffer, 5, 0.99, (MEAN, STD), generator, bf16=False)
        with torch.no_grad():
            logits, value = network(rollout.observation)
        taken = logits.log_softmax(-1).gather(-1, rollout.action.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(rollout.log_prob, taken)
        torch.testing.assert_close(rollout.value[rollout.active], value * STD + MEAN)
        assert torch.equal(rollout.observation.road[: len(first)], first.road)
        active = env.worlds.controlled
        with torch.no_grad():
            last = network(env.observation.rows(active))[1] * STD + MEAN
        torch.testing.assert_close(rollout.last_value[active], last)
        assert not rollout.last_value[~active].any()
        assert rollout.counts.steps == int(rollout.active.sum()) == len(rollout.action)


def test_the_buffer_keeps_what_is_put_in_its_layout(straight_map):
    env = environment(straight_map)
    buffer, index = Buffer(env, 1), torch.tensor([3, 0, 20])
    seen = env.seen_by(index)
    rows = buffer.put(seen, 2)
    assert len(rows) == 3 and rows.road.transpose(1, 2).is_contiguous()
    for kept, put in zip(vars(rows).values(), vars(seen).values(), strict=True):
        assert torch.equal(kept, put)
    assert torch.equal(buffer.observation.partner[2:5], seen.partner)


@pytest.mark.parametrize(("agents", "batches"), [(0, 1), (1, 1), (ROWS, 1), (ROWS + 1, 2)])
def test_batches_are_whole_and_hold_every_active_agent(agents: int, batches: int):
    active = torch.zeros(4, ROWS, dtype=torch.bool)
    active.view(-1)[torch.randperm(active.numel())[:agents]] = True
    index, count = whole_batches(active)
    assert count == agents and len(index) == batches * ROWS
    assert torch.equal(index[:count], active.flatten().nonzero().squeeze(-1))
