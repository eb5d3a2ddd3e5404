"""One step of batched worlds as pure functions of tensors: what happens, and what everybody then sees."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import Actions, RewardConfig, SimConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.events import detect
from phase_sumo.sim.geometry import materialise
from phase_sumo.sim.neighbours import gather, nearest
from phase_sumo.sim.observation import Appearance, Observation, appearance, observe
from phase_sumo.sim.reward import Multipliers, rewards
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.rolling import NextGoals
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
        goal_node: [W, N] node of each goal in the pair table.
        clock: [W] steps since the world's scenario began.
    """

    shape: VehicleShape
    state: VehicleState
    task: Task
    outcome: Outcome
    active: Tensor
    goal_node: Tensor
    clock: Tensor


@dataclass(frozen=True)
class RollingGoals:
    """For one step: table of next goals, x, y, yaw and curvature of all nodes [V, 4], and uniform [W, N]."""

    table: NextGoals
    node: Tensor
    uniform: Tensor

    def advance(
        self, reached: Tensor, goal_node: Tensor, truck: Tensor, task: Task
    ) -> tuple[Tensor, Task, Tensor]:
        """Goal nodes and tasks after agents have ``reached`` [W, N] theirs, and which of them go on."""
        following, exists = self.table.draw(goal_node, truck, self.uniform)
        goes_on = reached & exists
        x, y, yaw, _ = self.node[following].unbind(-1)
        onward = Task(x, y, yaw, task.goal_speed, task.alpha)
        return torch.where(goes_on, following, goal_node), onward.where(goes_on, task), goes_on


@dataclass
class Transition:
    """Result of one step; all [W, N] except the terms.

    Attributes:
        reward: 0 for agents that were not active.
        active: agents that acted in this step.
        terminated: reached the goal (the last one, where goals roll on) or became unrecoverable.
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
    actions: Actions,
    trailers: int,
    rolling: RollingGoals | None = None,
) -> tuple[Worlds, Transition]:
    """One step of every world, without side effects, randomness or synchronisation with a device.

    Args:
        spare: the scenario that each world begins when all its agents have finished.
        action: [W, N] int64 tokens; those of inactive agents are ignored.
        rho: scalar curriculum progress.
        trailers: only this many slots, the first ones, may have a trailer.
        rolling: gives agents at their goal the next one; without it they leave.
    """
    before, active, shape, task = worlds.state, worlds.active, worlds.shape, worlds.task
    jerk, rate = kinematics.command(action, before, task.alpha, actions, sim.dt)
    after = kinematics.advance(shape, before, jerk, rate, sim).where(active, before)
    events = detect(shape, before, after, task, active, road_map, map_index, sim, trailers)
    terms = rewards(before, after, task, events, Multipliers.at(rho, reward_config), reward_config, sim)

    clock = worlds.clock + 1
    goal_node, goes_on = worlds.goal_node, torch.zeros_like(active)
    if rolling is not None:
        goal_node, task, goes_on = rolling.advance(events.goal, goal_node, shape.truck, task)
    terminated = (events.goal & ~goes_on) | events.unrecoverable
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
        goal_node=torch.where(fresh, spare.goal_node, goal_node),
        clock=torch.where(over, 0, clock),
    )
    return following, transition


def look(
    worlds: Worlds, road_map: RoadMap, map_index: Tensor, noise: tuple[Tensor, Tensor] | None, sim: SimConfig
) -> Observation:
    """What every agent sees [W, N, ...]; rows of inactive slots mean nothing."""
    state = worlds.state
    index, mask = nearest(state.x, state.y, worlds.active, sim)
    table = materialise(*vars(appearance(worlds.shape, state)).values())
    others = Appearance(*(gather(values, index) for values in table))
    cell = road_map.cell(map_index, state.x, state.y)
    cell, view = materialise(cell, road_map.cell_view[cell])
    lane_yaw = road_map.cell_yaw[cell]
    return observe(worlds.shape, state, worlds.task, others, mask, road_map, view, lane_yaw, sim, noise)
