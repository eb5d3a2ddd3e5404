"""Batched self-play worlds: step, events, reward, termination and automatic reset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from phase_sumo.config import ActionConfig, RewardConfig, ScenarioConfig, SimConfig
from phase_sumo.sim import events as ev
from phase_sumo.sim import kinematics, scenario
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.observation import Observation, gather, nearest, observe
from phase_sumo.sim.reward import Multipliers, rewards
from phase_sumo.sim.road_map import merge
from phase_sumo.sim.vehicles import Task, VehicleShape, VehicleState, boxes

CHANGING = ("shape", "state", "task", "outcome", "observation")


@dataclass
class Outcome:
    """How one agent's episode ended or stands; all [W, N].

    Attributes:
        goal: reached its goal.
        collision, at_fault, road_edge: it happened at least once.
    """

    goal: Tensor
    collision: Tensor
    at_fault: Tensor
    road_edge: Tensor


@dataclass
class Transition:
    """Result of one step; all [W, N] except the terms.

    Attributes:
        reward: 0 for agents that were not active.
        active: agents that acted in this step.
        terminated: reached the goal or became unrecoverable.
        truncated: ran out of time.
        finished: terminated or truncated, with ``outcome`` final.
        final: what the truncated agents would have seen next, in their row-major order.
        terms: mean of every reward term over the active agents, a scalar tensor each.
    """

    reward: Tensor
    active: Tensor
    terminated: Tensor
    truncated: Tensor
    finished: Tensor
    outcome: Outcome
    final: Observation
    terms: dict[str, Tensor]


class Environment:
    """W worlds of up to N agents on a set of maps.

    World w runs on (map, regime) tuple ``w mod tuples`` for ever and samples a new scenario whenever all
    its agents have finished or the horizon is over.

    Args:
        maps: converted maps; every one is paired with the regimes it has start-goal pairs for.
        worlds, slots: W and N.
        seed: fixes everything on one device.
        training: perturb partner and road observations, and start the clocks of the worlds apart so that
            resets spread over time.
    """

    def __init__(
        self,
        maps: list[MapBundle],
        worlds: int,
        slots: int,
        sim: SimConfig,
        scenarios: ScenarioConfig,
        reward: RewardConfig,
        actions: ActionConfig,
        seed: int = 0,
        device: torch.device | str = "cpu",
        training: bool = True,
    ) -> None:
        self.sim, self.scenarios, self.reward_config, self.actions = sim, scenarios, reward, actions
        self.slots = slots
        self.generator = torch.Generator(device=device).manual_seed(seed)
        self.noise_generator = self.generator if training else None
        self.road_map = merge([m.road_map for m in maps]).to(device)
        tuples = _tuples(maps, scenarios)
        self.pairs = scenario.PairTable([(maps[m].graph, maps[m].pools[r]) for m, r in tuples], device)
        self.regimes = scenario.RegimeTable.of(
            [scenarios.regimes[r] for _, r in tuples], scenarios.agent_scale, slots, device
        )
        self.tuple_index = torch.arange(worlds, device=device) % len(tuples)
        self.map_index = torch.tensor([m for m, _ in tuples], device=device)[self.tuple_index]
        self.regime_index = torch.tensor([r for _, r in tuples], device=device)[self.tuple_index]
        self.rho = 0.0
        self.reset()

    def reset(self) -> None:
        """Sample every world anew."""
        fresh = self._sample(self.tuple_index)
        self.shape: VehicleShape = fresh.shape
        self.state: VehicleState = fresh.state
        self.task: Task = fresh.task
        self.active: Tensor = fresh.active
        worlds = self.tuple_index.shape[0]
        device = self.tuple_index.device
        latest = self.sim.horizon if self.noise_generator else 1
        self.clock = torch.randint(latest, (worlds,), generator=self.generator, device=device)
        self.outcome = Outcome(*(torch.zeros_like(self.active) for _ in range(4)))
        self.observation = self._observe(self.active, nearest(self.state.xy, self.active, self.sim))

    def _sample(self, tuple_index: Tensor) -> scenario.Scenario:
        return scenario.sample(
            self.pairs,
            self.regimes,
            tuple_index,
            self.slots,
            self.rho >= 1.0,
            self.scenarios,
            self.sim,
            -min(self.actions.jerk),
            self.generator,
        )

    def _observe(self, observers: Tensor, neighbours: tuple[Tensor, Tensor]) -> Observation:
        return observe(
            self.shape,
            self.state,
            self.task,
            observers,
            neighbours,
            self.road_map,
            self.map_index,
            self.sim,
            self.noise_generator,
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes while stepping, for a checkpoint."""
        batches = {name: _values(getattr(self, name)) for name in CHANGING}
        return {
            **batches,
            "active": self.active,
            "clock": self.clock,
            "rho": self.rho,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, stored: dict[str, Any]) -> None:
        """Continue from `state_dict` of an environment with the same maps and sizes."""
        for name in CHANGING:
            setattr(self, name, type(getattr(self, name))(*stored[name]))
        self.active, self.clock, self.rho = stored["active"], stored["clock"], stored["rho"]
        self.generator.set_state(stored["generator"])

    @torch.no_grad()
    def step(self, action: Tensor) -> Transition:
        """Advance every world by one step and reset those that are over.

        Args:
            action: [W, N] int64 tokens; those of inactive agents are ignored.
        """
        before, active = self.state, self.active
        jerk, rate = kinematics.command(action, self.task.alpha, self.actions)
        moved = kinematics.advance(self.shape, before, jerk, rate, self.sim)
        self.state = moved.where(active, before)
        neighbours = nearest(self.state.xy, active, self.sim)
        events = ev.detect(
            self.shape,
            before,
            self.state,
            self.task,
            boxes(self.shape, self.state),
            active,
            neighbours,
            self.road_map,
            self.map_index,
            self.sim,
        )
        multipliers = Multipliers.at(self.rho, self.reward_config)
        terms = rewards(before, self.state, self.task, events, multipliers, self.reward_config, self.sim)
        reward = torch.where(active, sum(terms.values(), torch.zeros_like(self.state.x)), 0.0)

        self.clock = self.clock + 1
        out_of_time = (self.clock >= self.sim.horizon).unsqueeze(-1)
        terminated = events.goal | events.unrecoverable
        truncated = active & ~terminated & out_of_time
        finished = terminated | truncated
        self.outcome = Outcome(
            self.outcome.goal | events.goal,
            self.outcome.collision | events.collision,
            self.outcome.at_fault | events.at_fault,
            self.outcome.road_edge | events.road_edge,
        )
        outcome = self.outcome
        # those who only ran out of time are still seen: the value of their last state is bootstrapped
        present = active & ~terminated
        seen = neighbours[0], neighbours[1] & gather(present.long(), neighbours[0]).bool()
        final = self._observe(truncated, seen)
        self.active = active & ~finished
        over = ~self.active.any(-1)
        if over.any():
            self._reset_worlds(over.nonzero().squeeze(-1))
            seen = nearest(self.state.xy, self.active, self.sim)
        self.observation = self._observe(self.active, seen)
        count = active.sum().clamp_min(1)
        return Transition(
            reward=reward,
            active=active,
            terminated=terminated,
            truncated=truncated,
            finished=finished,
            outcome=outcome,
            final=final,
            terms={name: (term * active).sum() / count for name, term in terms.items()},
        )

    def _reset_worlds(self, over: Tensor) -> None:
        """Sample the worlds ``over`` [B] anew, in place of their finished agents."""
        fresh = self._sample(self.tuple_index[over])
        for name in ("shape", "state", "task"):
            parts = zip(_values(getattr(self, name)), _values(getattr(fresh, name)), strict=True)
            setattr(
                self, name, type(getattr(self, name))(*(old.index_copy(0, over, new) for old, new in parts))
            )
        self.active = self.active.index_copy(0, over, fresh.active)
        self.clock = self.clock.index_fill(0, over, 0)
        self.outcome = Outcome(*(o.index_fill(0, over, False) for o in _values(self.outcome)))


def _tuples(maps: list[MapBundle], scenarios: ScenarioConfig) -> list[tuple[int, int]]:
    """(map, regime) index pairs; a regime with half the tuples of the fullest uses half the maps."""
    fullest = max(regime.tuples for regime in scenarios.regimes)
    return [
        (m, r)
        for r, regime in enumerate(scenarios.regimes)
        for m in range(math.ceil(len(maps) * regime.tuples / fullest))
        if len(maps[m].pools[r].start)
    ]


def _values(batch) -> list[Tensor]:
    return list(vars(batch).values())
