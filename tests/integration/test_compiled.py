"""The compiled step does what the eager step does."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.config import REGIMES, ScenarioConfig, TaskConfig
from phase_sumo.sim.environment import COMPILATION, Environment, tensors
from phase_sumo.sim.step import look
from phase_sumo.sim.synthetic_road import freeway
from phase_sumo.sim.worlds import advance

STEPS = 60


@pytest.mark.slow
def test_compiled_and_eager_steps_agree():
    """Random drivers, so that there are contacts of every kind; each step begins from the same worlds.

    Fused arithmetic may round otherwise in the last bit, so events within a hair's breadth may differ.
    """
    regime = replace(REGIMES[0], agents=(48, 48), agents_late=(48, 48))
    task = TaskConfig(scenarios=ScenarioConfig(regimes=(regime,), agent_scale=1.0))
    sim, actions = task.sim, task.actions
    bundle = build_bundle(freeway(3.0))
    env = Environment([replace(bundle, pools=bundle.pools[:1])], 4, 48, task)
    step, see = torch.compile(advance, **COMPILATION), torch.compile(look, **COMPILATION)
    generator = torch.Generator().manual_seed(0)
    noise = (
        torch.randn(4, 48, 4, sim.neighbours, generator=generator),
        torch.randn(4, 48, 2, 32, generator=generator),
    )
    worlds, rho, happened = env.worlds, torch.tensor(0.5), torch.zeros(4, dtype=torch.long)
    for _ in range(STEPS):
        action = torch.randint(actions.count, worlds.active.shape, generator=generator)
        given = (worlds, env._spare, action, rho, env.road_map, env.map_index, task)
        mine, other = advance(*given, env.trailers), step(*given, env.trailers)
        assert_close(tensors(mine[0]), tensors(other[0]))
        assert_close(tensors(mine[1].outcome), tensors(other[1].outcome))
        torch.testing.assert_close(mine[1].reward.sum(), other[1].reward.sum(), atol=0.05, rtol=1e-3)
        worlds = mine[0]
        outcome = worlds.outcome
        happened += torch.stack([o.sum() for o in vars(outcome).values()])
        agents = (worlds.shape, worlds.state, worlds.task, worlds.active)
        seen = (*agents, env.road_map, env.map_index, noise, sim)
        rows = worlds.active
        assert_close(tensors(look(*seen).rows(rows)), tensors(see(*seen).rows(rows)))
    assert (happened > 0).all(), happened  # goals, collisions, faults, road edges


def assert_close(mine: list[torch.Tensor], other: list[torch.Tensor]) -> None:
    for a, b in zip(mine, other, strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        differs = (a - b).abs() > 1e-3 if a.dtype == torch.float32 else a != b
        assert differs.float().mean() < 2e-3, differs.float().mean()
