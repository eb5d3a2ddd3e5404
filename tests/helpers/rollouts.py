"""Worlds placed by hand, driven through `worlds.advance`: for golden, invariance and scale tests."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from phase_sumo.config import ActionConfig, RewardConfig, SimConfig, TaskConfig
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.scenario import Scenario
from phase_sumo.sim.scripted import Script
from phase_sumo.sim.vehicles import Task, VehicleShape, VehicleState
from phase_sumo.sim.worlds import Transition, Worlds, advance

ACTIONS = ActionConfig()


def token(jerk: float, rate: float) -> int:
    """The action of a jerk in m/s^3 and a steering rate in rad/s that are on the lattice."""
    return ACTIONS.jerk.index(jerk) * len(ACTIONS.steering_rate) + ACTIONS.steering_rate.index(rate)


def place(shape: VehicleShape, state: VehicleState, task: Task, active: Tensor | None = None) -> Worlds:
    """Worlds at the beginning of a scenario; all slots active by default."""
    active = torch.ones_like(state.x, dtype=torch.bool) if active is None else active
    return Worlds.begin(scenario_of(shape, state, task, active), torch.zeros(len(active), dtype=torch.long))


def scenario_of(shape: VehicleShape, state: VehicleState, task: Task, active: Tensor) -> Scenario:
    """A scenario of these agents alone."""
    number = torch.zeros(len(active), dtype=torch.long)
    nowhere, script = torch.zeros(active.shape, dtype=torch.long), Script.nobody(active)
    return Scenario(shape, state, task, active, nowhere, script, task.goal_speed, number.bool(), number)


def drive(
    worlds: Worlds,
    road_map: RoadMap,
    actions: Tensor,
    map_index: Tensor | None = None,
    rho: float = 0.5,
    sim: SimConfig | None = None,
    reward: RewardConfig | None = None,
    trailers: int | None = None,
) -> list[tuple[Worlds, Transition]]:
    """The worlds after every step, and what the step returned; worlds that are over begin again as given.

    Args:
        actions: [T, W, N] tokens.
        map_index: [W]; the first map by default.
        trailers: slots that may have a trailer; all by default.
    """
    begin = scenario_of(worlds.shape, worlds.state, worlds.task, worlds.active)
    count, slots = worlds.active.shape
    map_index = torch.zeros(count, dtype=torch.long) if map_index is None else map_index
    course = []
    for action in actions:
        worlds, transition = advance(
            worlds,
            begin,
            action,
            torch.tensor(rho),
            road_map,
            map_index,
            TaskConfig(sim or SimConfig(), ACTIONS, reward or RewardConfig()),
            slots if trailers is None else trailers,
        )
        course.append((worlds, transition))
    return course


def pick(batch: Any, select: Any) -> Any:
    """``select`` applied to every tensor of nested dataclasses and dicts."""
    if isinstance(batch, Tensor):
        return select(batch)
    return type(batch)(**{f.name: pick(getattr(batch, f.name), select) for f in fields(batch)})
