"""Worlds whose beginnings are given instead of sampled, driven to their end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import Actions, DirectActionConfig, SimConfig
from phase_sumo.policy.checkpoint import Policy
from phase_sumo.policy.network import choose, log_prior
from phase_sumo.sim import kinematics
from phase_sumo.sim.events import Outcome
from phase_sumo.sim.observation import Observation
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.step import look, step
from phase_sumo.sim.vehicles import Task, TensorBatch, VehicleShape, VehicleState

MOST_WORLDS = 1_000_003  # beyond which random numbers of one seed would be those of another

CHUNK = 256  # agents
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
    """One step of all worlds; all [W, N].

    Attributes:
        before, after: states; who has finished stays where that happened.
        active: who took part.
        action: tokens, 0 for the others.
        finished: for whom this was the last step.
        outcome: what has become of them so far.
    """

    before: VehicleState
    after: VehicleState
    active: Tensor
    action: Tensor
    finished: Tensor
    outcome: Outcome


def drive(
    start: Start,
    road_map: RoadMap,
    driver: Driver,
    sim: SimConfig,
    actions: Actions,
    seed: int = 0,
    sampled: bool = False,
) -> Iterator[Step]:
    """Step until every agent has reached its goal, become unrecoverable or run out of time.

    Every agent draws its actions from numbers of its own, which follow from the seed, its world's number,
    its slot and the step, and nothing else: worlds that differ in one agent's context draw alike.

    Args:
        driver: of all agents.
        sampled: actions drawn from the driver's distribution instead of the most probable ones.
    """
    shape, task, active, state = start.shape, start.task, start.active, start.state
    nobody = torch.zeros_like(active)
    outcome = Outcome(*(nobody for _ in range(4)))
    trailers, uniform = trailer_slots(shape), _uniform(start, sim.horizon, seed)
    for t in range(sim.horizon):
        index = active.flatten().nonzero().squeeze(-1)
        seen = look(shape, state, task, active, road_map, start.map_index, None, sim, index)
        action = torch.zeros(active.shape, dtype=torch.long)
        action[active] = choose(driver(seen), uniform[:, t][active] if sampled else None)
        jerk, rate = kinematics.command(action, state, task.alpha, actions, sim.dt)
        where = road_map, start.map_index, sim, trailers
        after, events = step(shape, state, task, active, active, jerk, rate, *where)
        outcome = outcome.after(events)
        out_of_time = t + 1 == sim.horizon
        finished = active & (events.goal | events.unrecoverable | out_of_time)
        yield Step(state, after, active, action, finished, outcome)
        state, active = after, active & ~finished
        if not active.any():
            return


def trailer_slots(shape: VehicleShape) -> int:
    """How many slots, the first ones of every world, hold all the trailers."""
    towing = shape.articulated.any(0).nonzero()
    return int(towing.max()) + 1 if len(towing) else 0


def _uniform(start: Start, steps: int, seed: int) -> Tensor:
    """[W, steps, N] in [0, 1), a generator for every world."""
    size = steps, start.active.shape[1]
    # the generator looks at the lowest 32 bits only
    seeds = [(seed * MOST_WORLDS + number) % 2**32 for number in start.number.tolist()]
    generators = [torch.Generator().manual_seed(number) for number in seeds]
    return torch.stack([torch.rand(size, generator=generator) for generator in generators])


def policy_driver(policy: Policy) -> Driver:
    """The policy's logits, worked out for `CHUNK` agents at a time.

    The rounding of a matrix product may depend on how many rows it has. With the same number always, an
    agent's logits do not depend on who else is driven.
    """

    @torch.no_grad()
    def drive_by_policy(seen: Observation) -> Tensor:
        count, parts = len(seen), []
        for first in range(0, count, CHUNK):
            index = torch.arange(first, first + CHUNK).clamp_max(count - 1)
            part = policy.network.logits(seen.map(lambda values, index=index: values[index]))
            parts.append(part[: count - first])
        return torch.cat(parts)

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
