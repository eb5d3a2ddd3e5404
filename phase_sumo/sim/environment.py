"""Batched self-play worlds: step, events, reward, termination and automatic reset."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from phase_sumo.config import ActionConfig, GuardConfig, TaskConfig
from phase_sumo.sim import guard as guarding
from phase_sumo.sim import scenario
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.dimensions import truck_slots
from phase_sumo.sim.noise import NoiseTable
from phase_sumo.sim.observation import Observation
from phase_sumo.sim.pairs import PairTable
from phase_sumo.sim.road_map import POINTS_PER_CELL, merge
from phase_sumo.sim.scenario import Scenario, script_slots
from phase_sumo.sim.scripted import move_scripted
from phase_sumo.sim.step import look
from phase_sumo.sim.tuples import map_regime_tuples
from phase_sumo.sim.worlds import Beyond, Transition, Worlds, advance

# Steps between refills of the scenarios that finished worlds take over. The rare world that is over twice in
# between drives the same one again.
RESAMPLE_EVERY = 32
# Room to brake that a new scenario leaves, m/s^3: our lattice's, so that all policies drive the same worlds.
BRAKING_JERK = -min(ActionConfig().jerk)
# Static shapes. Values that read up to 16 tensors may be fused into their users; with the default of 4, much
# of the observation goes through memory. Indices are right by construction and not checked one by one.
COMPILATION: Any = {
    "dynamic": False,
    "options": {"realize_reads_threshold": 16, "assert_indirect_indexing": False},
}


class Environment:
    """W worlds of up to N agents on a set of maps.

    Every world keeps its (map, regime) tuple for ever; worlds take turns over the tuples. A world begins a
    new scenario whenever all its agents have finished or the horizon is over. Scenarios are sampled ahead,
    `RESAMPLE_EVERY` steps' worth at a time, so that a step itself draws nothing and waits for nothing.

    Args:
        maps: converted maps; every one is paired with the regimes it has start-goal pairs for.
        worlds, slots: W and N.
        seed: fixes everything on one device.
        training: perturb partner and road observations, and start the clocks of the worlds apart so that
            resets spread over time.
        share: (k, n) for every n-th of the worlds only, from the k-th on; the others run elsewhere.
        rho: curriculum progress to begin with.
        compiled: step through torch.compile (about a minute to start; many times faster from then on).
        guard: what vehicles must not do is kept from them (`sim.guard`); `step` takes scores then.

    Attributes:
        worlds: shapes, states, tasks of all agents.
        rho: curriculum progress; set it at will.
        decision: with a guard, what came of the last step's scores, [W, N].
    """

    def __init__(
        self,
        maps: list[MapBundle],
        worlds: int,
        slots: int,
        task: TaskConfig,
        seed: int = 0,
        device: torch.device | str = "cpu",
        training: bool = True,
        share: tuple[int, int] = (0, 1),
        compiled: bool = False,
        rho: float = 0.0,
        guard: GuardConfig | None = None,
    ) -> None:
        self.task, sim, scenarios = task, task.sim, task.scenarios
        self.slots, self.rho, self.guard = slots, rho, guard
        self.trailers = truck_slots(slots, scenarios)
        self.generator = torch.Generator(device=device).manual_seed(seed)
        self.road_map = merge([m.road_map for m in maps]).to(device)
        tuples = map_regime_tuples(maps, scenarios.regimes)
        pools = [(maps[m].graph, maps[m].pools[r]) for m, r in tuples]
        self.pairs = PairTable.of(pools, device)
        self.regimes = scenario.RegimeTable.of(
            [scenarios.regimes[r] for _, r in tuples], scenarios.agent_scale, slots, device
        )
        turn = torch.arange(worlds, device=device)[share[0] :: share[1]]
        # fewer worlds than tuples are spread over all of them
        self.tuple_index = turn % len(tuples) if worlds >= len(tuples) else turn * len(tuples) // worlds
        self.map_index = torch.tensor([m for m, _ in tuples], device=device)[self.tuple_index]
        self.regime_index = torch.tensor([r for _, r in tuples], device=device)[self.tuple_index]
        self._places = torch.Generator().manual_seed(seed)
        seen = ((len(turn), slots, 4, sim.neighbours), (len(turn), slots, 2, POINTS_PER_CELL))
        self._noise = NoiseTable(seen, self._places, device) if training else None
        self._advance = torch.compile(advance, **COMPILATION) if compiled else advance
        some = {**COMPILATION, "dynamic": None}  # the number of agents is marked as one that changes
        self._look = torch.compile(look, **some) if compiled else look
        self.reset()

    def reset(self) -> None:
        """Sample every world anew."""
        fresh = self._sample(self.tuple_index)
        worlds, device = len(self.tuple_index), self.tuple_index.device
        latest = self.task.sim.horizon if self._noise else 1
        clock = torch.randint(latest, (worlds,), generator=self.generator, device=device)
        self.worlds = Worlds.begin(fresh, clock)
        self._spare = self._sample(self.tuple_index)
        self._used = torch.zeros_like(clock, dtype=torch.bool)
        self._steps = 0
        self._perturb()

    @torch.no_grad()
    def step(self, action: Tensor) -> Transition:
        """Advance every world by one step; worlds that are over begin their next scenario.

        Args:
            action: [W, N] int64 tokens; those of inactive agents are ignored. With a guard [W, N, A], the
                scores of all actions, of which the highest is wanted; ``decision`` is what came of them.
        """
        commands = None
        if self.guard is not None:
            self.decision = guarding.of_worlds(
                action,
                self.worlds,
                self.road_map,
                self.map_index,
                self.task.actions,
                self.task.sim,
                self.guard,
            )
            action, commands = self.decision.token, (self.decision.jerk, self.decision.rate)
        rho = torch.tensor(self.rho, device=self.tuple_index.device)
        self.worlds, transition = self._advance(
            self.worlds,
            self._spare,
            action,
            rho,
            self.road_map,
            self.map_index,
            self.task,
            self.trailers,
            self._beyond(),
            commands,
        )
        self._used |= transition.over
        self._steps += 1
        if self._steps % RESAMPLE_EVERY == 0:
            self._resample()
        self._perturb()
        return transition

    def _beyond(self) -> Beyond | None:
        settings, worlds = self.task.scenarios, self.worlds
        alone = settings.script.standing_worlds == settings.script.scripted_worlds == 0.0
        if alone and settings.rolling_worlds == 0.0:
            return None
        size, device = worlds.active.shape, self.tuple_index.device
        first, most = script_slots(self.slots, settings)
        # not compiled: the way from node to node nests gathers, which fused grow beyond all bounds
        moved = move_scripted(
            worlds.shape,
            worlds.state,
            worlds.script,
            self.pairs,
            worlds.active,
            worlds.clock * self.task.sim.dt,
            (first, first if alone else first + most),
            settings.script,
            self.task.sim,
        )
        uniform = torch.rand(size, generator=self.generator, device=device)
        return Beyond(self.pairs, uniform, settings.rolling_horizon, moved)

    @property
    @torch.no_grad()
    def observation(self) -> Observation:
        """What every agent sees now, [W, N, ...]."""
        if self._observation is None:
            active = self.worlds.active
            seen = self.seen_by(torch.arange(active.numel(), device=active.device))
            self._observation = seen.map(lambda values: values.unflatten(0, active.shape))
        return self._observation

    @torch.no_grad()
    def seen_by(self, index: Tensor) -> Observation:
        """What the agents in the slots ``index`` [A] of all W N see now, [A, ...]; A is 2 or more."""
        if self._look is not look:
            torch._dynamo.mark_dynamic(index, 0)
        w, noise = self.worlds, self._perturbation
        return self._look(
            w.shape, w.state, w.task, w.active, self.road_map, self.map_index, noise, self.task.sim, index
        )

    def _perturb(self) -> None:
        """New noise for what is seen from now on."""
        self._seen_from = self._places.get_state()
        self._observation: Observation | None = None
        self._perturbation = None
        if self._noise:
            partner, road = self._noise.draw()
            self._perturbation = partner, road

    def _resample(self) -> None:
        """New scenarios for the worlds that have taken theirs."""
        used = self._used.nonzero().squeeze(-1)
        if len(used):
            fresh = self._sample(self.tuple_index[used])
            for old, new in zip(tensors(self._spare), tensors(fresh), strict=True):
                old.index_copy_(0, used, new)
            self._used.zero_()

    def _sample(self, tuple_index: Tensor) -> Scenario:
        return scenario.sample(
            self.pairs,
            self.regimes,
            tuple_index,
            self.slots,
            self.rho >= 1.0,
            self.task.scenarios,
            self.task.sim,
            BRAKING_JERK,
            self.generator,
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes while stepping, for a checkpoint.

        The observation is most of it, so it is made again, with the same noise, from what it was made of.
        """
        return {
            "worlds": tensors(self.worlds),
            "spare": tensors(self._spare),
            "used": self._used,
            "steps": self._steps,
            "rho": self.rho,
            "generator": self.generator.get_state(),
            "places": self._seen_from,
        }

    def load_state_dict(self, stored: dict[str, Any]) -> None:
        """Continue from `state_dict` of an environment with the same maps and sizes."""
        for name, batch in (("worlds", self.worlds), ("spare", self._spare)):
            for mine, theirs in zip(tensors(batch), stored[name], strict=True):
                mine.copy_(theirs)
        self._used.copy_(stored["used"])
        self._steps, self.rho = stored["steps"], stored["rho"]
        self.generator.set_state(stored["generator"])
        self._places.set_state(stored["places"])
        self._perturb()


def tensors(batch: Any) -> list[Tensor]:
    """All tensors of nested dataclasses, in the order of their fields."""
    if isinstance(batch, Tensor):
        return [batch]
    return [tensor for f in fields(batch) for tensor in tensors(getattr(batch, f.name))]
