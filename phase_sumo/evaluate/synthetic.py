"""Goal, collision and road-edge rates of a policy in generated worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from phase_sumo.config import ScenarioConfig, TaskConfig
from phase_sumo.policy.checkpoint import Policy
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.scenario import WORLD_KINDS
from phase_sumo.sim.worlds import Transition

RATES = ("goal_rate", "agent_collision_rate", "at_fault_rate", "road_collision_rate", "success_rate")


def evaluate_synthetic(
    policy: Policy,
    maps: list[MapBundle],
    scenarios: ScenarioConfig,
    worlds: int,
    slots: int,
    episodes: int = 1,
    seed: int = 0,
    sampled: bool = False,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Roll out whole episodes and count what became of every agent.

    Success is the paper's SR: the goal reached without causing a collision. Every agent of every world
    counts once, so short failures weigh no more than long successes.

    Returns:
        JSON types: ``scenarios``, ``agents``, `RATES` (shares of the agents), and the same per traffic
        regime, per vehicle type and per kind of world (with standing or scripted vehicles, or with goals that
        roll on) under ``by_regime``, ``by_type`` and ``by_kind``.
    """
    tallies: dict[str, Tensor] = {}
    horizon = scenarios.rolling_horizon if scenarios.rolling_worlds else policy.sim.horizon
    for episode in range(episodes):
        env = Environment(
            maps,
            worlds,
            slots,
            TaskConfig(sim=policy.sim, actions=policy.actions, scenarios=scenarios),
            seed=seed + episode,
            training=False,
            rho=1.0,
        )
        generator = torch.Generator().manual_seed(seed + episode) if sampled else None
        for t in range(horizon):
            first = env.worlds.clock == t  # worlds still in the scenario they began with
            if not first.any():
                break
            agents = env.worlds.controlled
            action = torch.zeros(agents.shape, dtype=torch.long)
            action[agents] = policy.act(env.observation.rows(agents), generator)
            groups = _groups(env)
            step = env.step(action)
            for name, group in groups.items():
                counted = step.finished & first.unsqueeze(-1) & group
                tallies[name] = tallies.get(name, torch.zeros(6)) + _tally(step, counted)
            if progress is not None:
                progress((episode + (t + 1) / horizon) / episodes)
    result: dict[str, Any] = {"scenarios": worlds * episodes, **_rates(tallies["all"])}
    for family in ("by_regime", "by_type", "by_kind"):
        prefix = family + ":"
        result[family] = {
            n.removeprefix(prefix): _rates(t) for n, t in tallies.items() if n.startswith(prefix)
        }
    return result


def _groups(env: Environment) -> dict[str, Tensor]:
    """Which agents [W, N] belong to each group."""
    worlds = env.worlds
    truck, articulated = worlds.shape.truck, worlds.shape.articulated

    def everybody(of: Tensor) -> Tensor:
        return of.unsqueeze(-1).expand_as(truck)

    groups = {
        "all": torch.ones_like(truck),
        "by_type:car": ~truck,
        "by_type:rigid_truck": truck & ~articulated,
        "by_type:articulated_truck": articulated,
        "by_kind:rolling": everybody(worlds.rolling),
    }
    for index, regime in enumerate(env.task.scenarios.regimes):
        groups[f"by_regime:{regime.name}"] = everybody(env.regime_index == index)
    for index, kind in enumerate(WORLD_KINDS):
        groups[f"by_kind:{kind}"] = everybody((worlds.kind == index) & ~worlds.rolling)
    return groups


def _tally(step: Transition, counted: Tensor) -> Tensor:
    outcome = step.outcome
    columns = (
        torch.ones_like(counted),
        outcome.goal,
        outcome.collision,
        outcome.at_fault,
        outcome.road_edge,
        outcome.goal & ~outcome.at_fault,
    )
    return torch.stack([(column & counted).sum() for column in columns]).float()


def _rates(tally: Tensor) -> dict[str, Any]:
    agents = int(tally[0])
    return {
        "agents": agents,
        **{n: float(v) / max(agents, 1) for n, v in zip(RATES, tally[1:].tolist(), strict=True)},
    }
