"""Worlds whose beginnings are given instead of sampled, driven to their end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import Actions, DirectActionConfig, RewardConfig, SimConfig
from phase_sumo.policy.checkpoint import Policy
from phase_sumo.policy.network import log_prior
from phase_sumo.sim.observation import Observation
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.scenario import Scenario
from phase_sumo.sim.vehicles import Task, TensorBatch, VehicleShape, VehicleState
from phase_sumo.sim.worlds import Outcome, Transition, Worlds, advance, look

MOST_WORLDS = 1_000_003  # beyond which random numbers of one seed would be those of another

Driver = Callable[[Observation], Tensor]  # observation of A agents -> logits of their actions [A, actions]


@dataclass
class Start(TensorBatch):
    """How W worlds of up to N agents begin.

    Attributes:
        shape, state, task: [W, N].
        active: [W, N] bool, slots that hold an agent.
        map_index: [W] row of the road map.
        number: [W] what the world's random numbers follow from.
    """

    shape: VehicleShape
    state: VehicleState
    task: Task
    active: Tensor
    map_index: Tensor
    number: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> Start:
        return Start(
            self.shape.map(function),
            self.state.map(function),
            self.task.map(function),
            *(function(values) for values in (self.active, self.map_index, self.number)),
        )


@dataclass
class Step:
    """One step of all worlds: as they were, what everybody did, and what came of it."""

    before: Worlds
    action: Tensor
    after: Worlds
    transition: Transition


def drive(
    start: Start,
    road_map: RoadMap,
    driver: Driver,
    sim: SimConfig,
    actions: Actions,
    seed: int = 0,
    greedy: bool = False,
) -> Iterator[Step]:
    """Step until every agent has reached its goal, become unrecoverable or run out of time.

    Every agent draws its actions from numbers of its own, which follow from the seed, its world's number,
    its slot and the step, and nothing else: worlds that differ in one agent's context draw alike.

    Args:
        driver: of all agents.
        greedy: most probable actions instead of drawn ones.
    """
    active = start.active
    nobody = torch.zeros_like(active)
    spare = Scenario(start.shape, start.state, start.task, nobody, nobody.long())
    worlds = Worlds(
        start.shape,
        start.state,
        start.task,
        Outcome(*(nobody for _ in range(4))),
        active,
        nobody.long(),
        torch.zeros_like(start.map_index),
    )
    uniform = _uniform(start, sim.horizon, seed)
    rho, reward = torch.tensor(0.0), RewardConfig()
    for t in range(sim.horizon):
        seen = look(worlds, road_map, start.map_index, None, sim)
        action = torch.zeros(active.shape, dtype=torch.long)
        # by world, since the rounding of a matrix product depends on how many rows it has
        for world in worlds.active.any(-1).nonzero().squeeze(-1).tolist():
            here = worlds.active[world]
            logits = driver(seen.map(lambda values, world=world: values[world]).rows(here))
            action[world, here] = choose(logits, None if greedy else uniform[world, t, here])
        following, transition = advance(
            worlds, spare, action, rho, road_map, start.map_index, sim, reward, actions, active.shape[1]
        )
        yield Step(worlds, action, following, transition)
        worlds = following
        if not worlds.active.any():
            return


def choose(logits: Tensor, uniform: Tensor | None) -> Tensor:
    """Tokens [A]: where the cumulated probability passes ``uniform`` [A], or the most probable ones."""
    if uniform is None:
        return logits.argmax(-1)
    passed = (logits.softmax(-1).cumsum(-1) < uniform.unsqueeze(-1)).sum(-1)
    return passed.clamp_max(logits.shape[-1] - 1)


def _uniform(start: Start, steps: int, seed: int) -> Tensor:
    """[W, steps, N] in [0, 1), a generator for every world."""
    size = steps, start.active.shape[1]
    # the generator looks at the lowest 32 bits only
    seeds = [(seed * MOST_WORLDS + number) % 2**32 for number in start.number.tolist()]
    generators = [torch.Generator().manual_seed(number) for number in seeds]
    return torch.stack([torch.rand(size, generator=generator) for generator in generators])


def policy_driver(policy: Policy) -> Driver:
    """The policy's logits."""

    @torch.no_grad()
    def drive_by_policy(seen: Observation) -> Tensor:
        return policy.network.logits(seen)

    return drive_by_policy


def prior_driver(actions: Actions) -> Driver:
    """Actions drawn from the prior, whatever is seen: the policy before it has learnt anything."""
    logits = log_prior(actions)
    return lambda seen: logits.expand(len(seen), -1)


def idle_driver(actions: Actions) -> Driver:
    """No command: the vehicle keeps its speed and its steering angle."""
    if isinstance(actions, DirectActionConfig):
        raise ValueError("a lattice of accelerations and steering angles has no action that keeps both")
    logits = torch.full((actions.count,), -torch.inf)
    logits[actions.jerk.index(0.0) * len(actions.steering_rate) + actions.steering_rate.index(0.0)] = 0.0
    return lambda seen: logits.expand(len(seen), -1)
