"""Vehicles under the guard beside others that follow a script: W worlds of an ego (slot 0) and one other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from phase_sumo.config import ActionConfig, GuardConfig, SimConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.guard import Decision, of_worlds
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.vehicles import HISTORY, VehicleShape, VehicleState, boxes
from tests.helpers.factories import car_shape, task_to, truck_shape
from tests.helpers.rollouts import pick, place

SIM, ACTIONS, GUARD = SimConfig(), ActionConfig(), GuardConfig()
Script = Callable[[int, VehicleState], tuple[Tensor, Tensor]]


@dataclass
class Course:
    """What became of the scenes: the ego touched the other [W], its states, and its decisions."""

    touched: Tensor
    states: list[VehicleState]
    decisions: list[Decision]

    def first(self, name: str) -> Tensor:
        """[W] of the first decision."""
        return getattr(self.decisions[0], name)[:, 0]

    def ever(self, name: str) -> Tensor:
        """[W] whether it was true of any decision."""
        return torch.stack([getattr(d, name)[:, 0] for d in self.decisions]).any(0)


def shapes(truck: Tensor) -> VehicleShape:
    """Cars, and tractors with trailers where ``truck`` [W, N] says so."""
    count = truck.numel()
    return truck_shape(count).where(truck.reshape(1, -1), car_shape(count)).map(lambda v: v.view(truck.shape))


def states(x: Tensor, y: Tensor, speed: Tensor, accel: Tensor | None = None, yaw: Tensor | None = None):
    """States [W, N] without hitch angle and steering, along the x axis by default."""
    none, history = torch.zeros_like(x), torch.zeros(*x.shape, HISTORY)
    accel, yaw = none if accel is None else accel, none if yaw is None else yaw
    return VehicleState(x, y, yaw, speed, accel, none, none, history, history)


def drive(
    shape: VehicleShape,
    state: VehicleState,
    script: Script,
    scores: Callable[[int, VehicleState], Tensor],
    road_map: RoadMap,
    steps: int,
) -> Course:
    """Let the ego want ``scores(step, state)`` [W, A] while the other does what ``script`` says.

    Args:
        script: (step, state) -> acceleration in m/s^2 and speed to the left of the x axis in m/s, [W].
    """
    worlds = place(shape, state, pick(task_to(count=2), lambda v: v.expand(state.x.shape)))
    map_index = torch.zeros(len(state.x), dtype=torch.long)
    touched = torch.zeros(len(state.x), dtype=torch.bool)
    course = Course(touched, [], [])
    for step in range(steps):
        every = scores(step, worlds.state).unsqueeze(1).expand(-1, 2, -1)
        decision = of_worlds(every, worlds, road_map, map_index, ACTIONS, SIM, GUARD)
        moved = kinematics.advance(shape, worlds.state, decision.jerk, decision.rate, SIM)
        other = scripted(worlds.state, *script(step, worlds.state))
        ego = torch.tensor([True, False]).expand(state.x.shape)
        after = moved.where(ego, other)
        worlds = replace(worlds, state=after)
        box = boxes(shape, after)
        mine, theirs = box[:, :, None, :, 0], box[:, None, :, :, 1]
        real = (mine[4] > 0) & (theirs[4] > 0)
        course.touched |= (boxes_overlap(mine, theirs) & real).flatten(0, 1).any(0)
        course.states.append(after)
        course.decisions.append(decision)
    return course


def scripted(state: VehicleState, accel: Tensor, aside: Tensor) -> VehicleState:
    """Slot 1 after a step at an acceleration [W], as its brakes allow, and ``aside`` [W] m/s to the left."""
    accel, aside = accel.unsqueeze(1), aside.unsqueeze(1)
    accel = torch.maximum(accel, state.accel.clamp_max(0.0) - GUARD.others_jerk * SIM.dt)
    speed = (state.speed + accel * SIM.dt).clamp_min(0.0)
    aside = torch.where(speed > 0.5, aside, 0.0)
    yaw = torch.where(speed > 0.5, torch.atan2(aside, speed), state.yaw)
    x, y = state.x + speed * SIM.dt, state.y + aside * SIM.dt
    return replace(state, x=x, y=y, yaw=yaw, speed=speed, accel=accel)


def wanting(jerk: float, rate: float, count: int) -> Tensor:
    """[W, A] scores of a policy that is sure of one action of the lattice and likes those near it."""
    along = (torch.tensor(ACTIONS.jerk) - jerk).abs()
    across = (torch.tensor(ACTIONS.steering_rate) - rate).abs()
    return -(along.unsqueeze(1) + 20.0 * across).flatten().expand(count, -1)
