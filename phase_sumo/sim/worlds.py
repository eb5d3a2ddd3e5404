"""One step of batched worlds as pure functions of tensors: what happens, and what everybody then sees."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import ActionConfig, RewardConfig, SimConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.events import detect
from phase_sumo.sim.neighbours import gather, nearest
from phase_sumo.sim.observation import Observation, appearance, observe
from phase_sumo.sim.reward import Multipliers, rewards
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.scenario import Scenario
from phase_sumo.sim.vehicles import Task, TensorBatch, VehicleShape, VehicleState


@dataclass
class Outcome(TensorBatch):
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
class Worlds:
    """Everything that a step changes.

    Attributes:
        shape, state, task, outcome: of the agents, [W, N].
        active: [W, N] bool, slots with an agent that has not finished.
        clock: [W] steps since the world's scenario began.
    """

    shape: VehicleShape
    state: VehicleState
    task: Task
    outcome: Outcome
    active: Tensor
    clock: Tensor


@dataclass
class Transition:
    """Result of one step; all [W, N] except the terms.

    Attributes:
        reward: 0 for agents that were not active.
        active: agents that acted in this step.
        terminated: reached the goal or became unrecoverable.
        truncated: ran out of time.
        finished: terminated or truncated, with ``outcome`` final.
        over: [W] bool, worlds that began a new scenario after the step.
        terms: mean of every reward term over the active agents, a scalar tensor each.
    """

    reward: Tensor
    active: Tensor
    terminated: Tensor
    truncated: Tensor
    finished: Tensor
    outcome: Outcome
    over: Tensor
    terms: dict[str, Tensor]


def advance(
    worlds: Worlds,
    spare: Scenario,
    action: Tensor,
    rho: Tensor,
    road_map: RoadMap,
    map_index: Tensor,
    sim: SimConfig,
    reward_config: RewardConfig,
    actions: ActionConfig,
    trailers: int,
) -> tuple[Worlds, Transition]:
    """One step of every world, without side effects, randomness or synchronisation with a device.

    Args:
        spare: the scenario that each world begins when all its agents have finished.
        action: [W, N] int64 tokens; those of inactive agents are ignored.
        rho: scalar curriculum progress.
        trailers: only this many slots, the first ones, may have a trailer.
    """
    before, active, shape, task = worlds.state, worlds.active, worlds.shape, worlds.task
    jerk, rate = kinematics.command(action, task.alpha, actions)
    after = kinematics.advance(shape, before, jerk, rate, sim).where(active, before)
    events = detect(shape, before, after, task, active, road_map, map_index, sim, trailers)
    terms = rewards(before, after, task, events, Multipliers.at(rho, reward_config), reward_config, sim)

    clock = worlds.clock + 1
    terminated = events.goal | events.unrecoverable
    truncated = active & ~terminated & (clock >= sim.horizon).unsqueeze(-1)
    finished = terminated | truncated
    outcome = Outcome(
        worlds.outcome.goal | events.goal,
        worlds.outcome.collision | events.collision,
        worlds.outcome.at_fault | events.at_fault,
        worlds.outcome.road_edge | events.road_edge,
    )
    left = active & ~finished
    over = ~left.any(-1)
    fresh = over.unsqueeze(-1)
    count = active.sum().clamp_min(1)
    transition = Transition(
        reward=torch.where(active, sum(terms.values(), torch.zeros_like(after.x)), 0.0),
        active=active,
        terminated=terminated,
        truncated=truncated,
        finished=finished,
        outcome=outcome,
        over=over,
        terms={name: (term * active).sum() / count for name, term in terms.items()},
    )
    following = Worlds(
        shape=spare.shape.where(fresh, shape),
        state=spare.state.where(fresh, after),
        task=spare.task.where(fresh, task),
        outcome=outcome.map(lambda happened: happened & ~fresh),
        active=torch.where(fresh, spare.active, left),
        clock=torch.where(over, 0, clock),
    )
    return following, transition


def look(
    worlds: Worlds, road_map: RoadMap, map_index: Tensor, noise: tuple[Tensor, Tensor] | None, sim: SimConfig
) -> Observation:
    """What every agent sees [W, N, ...]; rows of inactive slots mean nothing."""
    state = worlds.state
    index, mask = nearest(state.x, state.y, worlds.active, sim)
    others = appearance(worlds.shape, state).map(lambda values: gather(values, index))
    cell = road_map.cell(map_index, state.x, state.y)
    return observe(worlds.shape, state, worlds.task, others, mask, road_map, cell, sim, noise)
