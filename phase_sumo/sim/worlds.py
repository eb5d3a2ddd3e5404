"""Batched worlds through time, as pure functions of tensors: steps, rewards, ends, new scenarios."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from phase_sumo.config import TaskConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.events import Outcome
from phase_sumo.sim.pairs import PairTable
from phase_sumo.sim.reward import Multipliers, rewards
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.scenario import Scenario, of_trucks
from phase_sumo.sim.scripted import Moved, Script
from phase_sumo.sim.step import step
from phase_sumo.sim.vehicles import Task, VehicleShape, VehicleState


@dataclass
class Worlds:
    """Everything that a step changes.

    Attributes:
        shape, state, task, outcome: of the agents, [W, N].
        active: [W, N] bool, slots with an agent that has not finished.
        goal_node: [W, N] node of each goal in the pair table.
        clock: [W] steps since the world's scenario began.
        script: of the vehicles that no policy drives, [W, N].
        desired_speed: [W, N] m/s that target speeds return to where goals roll on.
        rolling: [W] bool, agents at their goal get the next one.
        kind: [W] what there is besides agents, see `scenario`.
    """

    shape: VehicleShape
    state: VehicleState
    task: Task
    outcome: Outcome
    active: Tensor
    goal_node: Tensor
    clock: Tensor
    script: Script
    desired_speed: Tensor
    rolling: Tensor
    kind: Tensor

    @property
    def controlled(self) -> Tensor:
        """[W, N] bool, the agents: active and not scripted."""
        return self.active & ~self.script.scripted

    @staticmethod
    def begin(scenario: Scenario, clock: Tensor) -> Worlds:
        """Worlds that have just begun, or are taken to be at some ``clock`` [W]."""
        outcome = Outcome(*(torch.zeros_like(scenario.active) for _ in range(4)))
        return Worlds(
            scenario.shape,
            scenario.state,
            scenario.task,
            outcome,
            scenario.active,
            scenario.goal_node,
            clock,
            scenario.script,
            scenario.desired_speed,
            scenario.rolling,
            scenario.kind,
        )


@dataclass(frozen=True)
class Beyond:
    """What worlds need for a step that have rolling goals or scripted vehicles; others do without.

    Attributes:
        pairs: start-goal pairs by node.
        uniform: [W, N] random numbers of this step in [0, 1).
        horizon: steps of a world whose goals roll on.
        scripted: where the scripted vehicles are after the step.
    """

    pairs: PairTable
    uniform: Tensor
    horizon: int
    scripted: Moved


@dataclass
class Transition:
    """Result of one step; all [W, N] except the terms.

    Attributes:
        reward: 0 for agents that were not active.
        active: agents that acted in this step.
        terminated: reached the goal (the last one, where goals roll on), became unrecoverable, or had a
            contact that ends the episode.
        truncated: ran out of time.
        finished: terminated or truncated, with ``outcome`` final.
        over: [W] bool, worlds that began a new scenario after the step.
        after: states before those new scenarios.
        terms: mean of every reward term over the active agents, a scalar tensor each.
    """

    reward: Tensor
    active: Tensor
    terminated: Tensor
    truncated: Tensor
    finished: Tensor
    outcome: Outcome
    over: Tensor
    after: VehicleState
    terms: dict[str, Tensor]


def advance(
    worlds: Worlds,
    spare: Scenario,
    action: Tensor,
    rho: Tensor,
    road_map: RoadMap,
    map_index: Tensor,
    config: TaskConfig,
    trailers: int,
    beyond: Beyond | None = None,
    commands: tuple[Tensor, Tensor] | None = None,
) -> tuple[Worlds, Transition]:
    """One step of every world, without side effects, randomness or synchronisation with a device.

    Args:
        spare: the scenario that each world begins when all its agents have finished.
        action: [W, N] int64 tokens; those of inactive agents are ignored.
        rho: scalar curriculum progress.
        trailers: only this many slots, the first ones, may have a trailer.
        beyond: for worlds with rolling goals or scripted vehicles.
        commands: jerk and steering rate [W, N] instead of those of ``action``.
    """
    sim, before, agents = config.sim, worlds.state, worlds.controlled
    shape, task = worlds.shape, worlds.task
    jerk, rate = commands or kinematics.command(action, before, task.alpha, config.actions, sim.dt)
    script, there, by_script = worlds.script, worlds.active, None
    if beyond is not None:
        moved = beyond.scripted
        by_script = there & script.scripted, moved.state
        script, there = replace(script, node=moved.node, beyond=moved.beyond), there & ~moved.gone
    after, events = step(
        shape, before, task, agents, there, jerk, rate, road_map, map_index, sim, trailers, by_script
    )
    terms = rewards(before, after, task, events, Multipliers.at(rho, config.reward), config.reward, sim)

    clock = worlds.clock + 1
    horizon, goal_node, goes_on = sim.horizon, worlds.goal_node, torch.zeros_like(agents)
    if beyond is not None:
        goal_node, task, goes_on = _next_goals(worlds, events.goal & agents, beyond)
        horizon = torch.where(worlds.rolling, beyond.horizon, sim.horizon)
    ended = (events.goal & ~goes_on) | events.unrecoverable
    if config.reward.contacts_end:
        ended = ended | events.at_fault | events.road_edge
    terminated = agents & ended
    truncated = agents & ~terminated & (clock >= horizon).unsqueeze(-1)
    finished = terminated | truncated
    outcome = worlds.outcome.after(events)
    left = there & ~finished
    over = ~(left & agents).any(-1)
    fresh = over.unsqueeze(-1)
    count = agents.sum().clamp_min(1)
    transition = Transition(
        reward=torch.where(agents, sum(terms.values(), torch.zeros_like(after.x)), 0.0),
        active=agents,
        terminated=terminated,
        truncated=truncated,
        finished=finished,
        outcome=outcome,
        over=over,
        after=after,
        terms={name: (term * agents).sum() / count for name, term in terms.items()},
    )
    following = Worlds(
        shape=spare.shape.where(fresh, shape),
        state=spare.state.where(fresh, after),
        task=spare.task.where(fresh, task),
        outcome=outcome.map(lambda happened: happened & ~fresh),
        active=torch.where(fresh, spare.active, left),
        goal_node=torch.where(fresh, spare.goal_node, goal_node),
        clock=torch.where(over, 0, clock),
        script=spare.script.where(fresh, script),
        desired_speed=torch.where(fresh, spare.desired_speed, worlds.desired_speed),
        rolling=torch.where(over, spare.rolling, worlds.rolling),
        kind=torch.where(over, spare.kind, worlds.kind),
    )
    return following, transition


def _next_goals(worlds: Worlds, reached: Tensor, beyond: Beyond) -> tuple[Tensor, Task, Tensor]:
    """Goal nodes and tasks after agents have ``reached`` [W, N] theirs, and which of them go on."""
    pairs, truck = beyond.pairs, worlds.shape.truck
    kind = (beyond.uniform * 2.0).long()  # same lane or lane change, half and half
    uniform = beyond.uniform * 2.0 - kind
    pair, exists = pairs.onward_from(worlds.goal_node, kind, truck, uniform)
    goes_on = reached & exists & worlds.rolling.unsqueeze(-1)
    following = torch.where(goes_on, pairs.goal[pair], worlds.goal_node)
    x, y, yaw, _ = pairs.node[following].unbind(-1)
    speed = torch.minimum(worlds.desired_speed, of_trucks(truck) * pairs.goal_speed[pair])
    onward = Task(x, y, yaw, speed, worlds.task.alpha)
    return following, onward.where(goes_on, worlds.task), goes_on
