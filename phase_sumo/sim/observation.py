"""What an agent sees: itself, its 16 nearest neighbours and local road points, in its own frame.

Features are declared by name with unit and scale; a checkpoint stores this layout and refuses another.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import SimConfig
from phase_sumo.sim.geometry import materialise, stored, wrap_angle
from phase_sumo.sim.road_map import RoadKind, RoadMap
from phase_sumo.sim.vehicles import Task, TensorBatch, VehicleShape, VehicleState


@dataclass(frozen=True)
class Feature:
    """One observed number: value in ``unit`` divided by ``scale``."""

    name: str
    unit: str
    scale: float


EGO = (
    Feature("speed", "m/s", 20.0),
    Feature("length", "m", 10.0),
    Feature("width", "m", 2.0),
    Feature("trailer_length", "m", 10.0),
    Feature("trailer_width", "m", 2.0),
    Feature("hitch", "rad", 0.3),
    Feature("truck", "1", 1.0),
    Feature("goal_x", "m", 100.0),
    Feature("goal_y", "m", 10.0),
    Feature("goal_y_near", "m, clipped at the scale", 4.0),
    Feature("goal_yaw_cos", "1", 1.0),
    Feature("goal_yaw_sin", "1", 0.3),
    Feature("goal_speed_error", "m/s", 5.0),
    Feature("alpha", "1", 1.0),
    Feature("accel", "m/s^2", 4.0),
    Feature("steer", "rad", 0.1),
    Feature("yaw_rate", "rad/s", 0.1),
    Feature("lane_yaw_error", "rad", 0.2),
    *(Feature(f"accel_{k}_ago", "m/s^2", 4.0) for k in (1, 2, 3)),
    *(Feature(f"steer_{k}_ago", "rad", 0.1) for k in (1, 2, 3)),
)
CONTEXT = (
    Feature("goal_speed", "m/s", 20.0),
    Feature("alpha", "1", 1.0),
    Feature("truck", "1", 1.0),
    Feature("length", "m", 10.0),
    Feature("width", "m", 2.0),
    Feature("trailer_length", "m", 10.0),
    Feature("trailer_width", "m", 2.0),
)
PARTNER = (
    Feature("x", "m", 50.0),
    Feature("y", "m", 10.0),
    Feature("y_near", "m, clipped at the scale", 4.0),
    Feature("speed", "m/s", 20.0),
    Feature("closing_speed", "m/s", 10.0),
    Feature("yaw_cos", "1", 1.0),
    Feature("yaw_sin", "1", 0.3),
    Feature("length", "m", 10.0),
    Feature("width", "m", 2.0),
    Feature("trailer_length", "m", 10.0),
    Feature("trailer_width", "m", 2.0),
    Feature("hitch", "rad", 0.3),
)
ROAD = (
    Feature("x", "m", 50.0),
    Feature("y", "m", 10.0),
    Feature("y_near", "m, clipped at the scale", 4.0),
    Feature("yaw_cos", "1", 1.0),
    Feature("yaw_sin", "1", 0.3),
    *(Feature(kind.name.lower(), "1", 1.0) for kind in RoadKind),
)
KINDS = tuple(int(kind) for kind in RoadKind)
Heading = tuple[Tensor, ...]  # cos and sin of the observers' yaw, each [...]
LAYOUT = {"ego": EGO, "context": CONTEXT, "partner": PARTNER, "road": ROAD}


@dataclass
class Observation(TensorBatch):
    """Scaled features of agents with leading axes [...]: [W, N] worlds and slots, or [A] agents.

    Attributes:
        ego: [..., len(EGO)].
        context: [..., len(CONTEXT)] conditioning vector C_i.
        partner: [..., K, len(PARTNER)], zero where masked.
        partner_mask: [..., K] bool, True for a real neighbour.
        road: [..., R, len(ROAD)], zero where masked.
        road_mask: [..., R] bool.
    """

    ego: Tensor
    context: Tensor
    partner: Tensor
    partner_mask: Tensor
    road: Tensor
    road_mask: Tensor

    def __len__(self) -> int:
        return self.ego.shape[0]

    def rows(self, mask: Tensor) -> Observation:
        """The agents where mask [W, N] holds, as [A] rows in row-major order."""
        return self.map(lambda values: values[mask])


@dataclass
class Appearance(TensorBatch):
    """What others see of a vehicle: centre x, y of its tractor box in m, yaw, speed, dimensions, hitch."""

    x: Tensor
    y: Tensor
    yaw: Tensor
    speed: Tensor
    length: Tensor
    width: Tensor
    trailer_length: Tensor
    trailer_width: Tensor
    hitch: Tensor


def appearance(shape: VehicleShape, state: VehicleState) -> Appearance:
    """How vehicles look to others, with the same axes."""
    forward = shape.front_overhang - 0.5 * shape.length  # rear axle to the centre of the box
    return Appearance(
        x=state.x + forward * torch.cos(state.yaw),
        y=state.y + forward * torch.sin(state.yaw),
        yaw=state.yaw,
        speed=state.speed,
        length=shape.length,
        width=shape.width,
        trailer_length=shape.trailer_length,
        trailer_width=shape.trailer_width,
        hitch=state.hitch,
    )


def observe(
    shape: VehicleShape,
    state: VehicleState,
    task: Task,
    others: Appearance,
    mask: Tensor,
    road_map: RoadMap,
    view: Tensor,
    lane_yaw: Tensor,
    config: SimConfig,
    noise: tuple[Tensor, Tensor] | None = None,
) -> Observation:
    """Ego-centric observation (paper: Observation Space) of agents with any leading axes [...].

    Args:
        shape, state, task: [...] of the observing agents.
        others: [..., K] how the neighbours look.
        mask: [..., K] bool, those that are real.
        view: [...] row of `RoadMap.view` that each agent sees.
        lane_yaw: [...] direction of the lane in rad.
        noise: standard normal numbers for partners [..., 4, K] and road points [..., 2, R], scaled here to
            the Gaussian noise on both; None for none.
    """
    partner_noise, road_noise = (None, None) if noise is None else noise
    heading = materialise(torch.cos(state.yaw), torch.sin(state.yaw))
    road, road_mask = _road(state, heading, road_map.seen_in(view), config, road_noise)
    return Observation(
        ego=_ego(shape, state, heading, task, lane_yaw),
        context=_context(shape, task),
        partner=_partner(state, heading, others, mask, config, partner_noise),
        partner_mask=stored(mask),
        road=road,
        road_mask=road_mask,
    )


def _stack(features: tuple[Feature, ...], values: list[Tensor]) -> Tensor:
    """Scaled features [...] as the last axis."""
    return torch.stack([v * (1.0 / f.scale) for v, f in zip(values, features, strict=True)], -1)


def _stack_set(features: tuple[Feature, ...], values: list[Tensor], mask: Tensor) -> Tensor:
    """Scaled features [..., K] of a set as the last axis, zero where not ``mask``.

    In memory every feature's K values lie side by side, so that vector units write them at once.
    """
    scaled = [torch.where(mask, v * (1.0 / f.scale), 0.0) for v, f in zip(values, features, strict=True)]
    return torch.stack(scaled, -2).transpose(-1, -2)


def _near(y: Tensor) -> Tensor:
    """Lateral offset with the resolution spent within one lane's width."""
    return y.clamp(-4.0, 4.0)


def _ego(shape: VehicleShape, state: VehicleState, heading: Heading, task: Task, lane_yaw: Tensor) -> Tensor:
    cos, sin = heading
    dx, dy = task.goal_x - state.x, task.goal_y - state.y
    goal_y = dy * cos - dx * sin
    goal_yaw = task.goal_yaw - state.yaw
    values = [
        state.speed,
        shape.length,
        shape.width,
        shape.trailer_length,
        shape.trailer_width,
        state.hitch,
        shape.truck.float(),
        dx * cos + dy * sin,
        goal_y,
        _near(goal_y),
        torch.cos(goal_yaw),
        torch.sin(goal_yaw),
        task.goal_speed - state.speed,
        task.alpha,
        state.accel,
        state.steer,
        state.speed * torch.tan(state.steer) / shape.wheelbase,
        wrap_angle(state.yaw - lane_yaw),
        *state.accel_history.unbind(-1),
        *state.steer_history.unbind(-1),
    ]
    return _stack(EGO, values)


def _context(shape: VehicleShape, task: Task) -> Tensor:
    values = [
        task.goal_speed,
        task.alpha,
        shape.truck.float(),
        shape.length,
        shape.width,
        shape.trailer_length,
        shape.trailer_width,
    ]
    return _stack(CONTEXT, values)


def _noisy(value: Tensor, sigma: float, noise: Tensor | None, row: int) -> Tensor:
    return value if noise is None else value + sigma * noise[..., row, :]


def _partner(
    own: VehicleState,
    heading: Heading,
    other: Appearance,
    mask: Tensor,
    config: SimConfig,
    noise: Tensor | None,
) -> Tensor:
    """Features [..., K, len(PARTNER)] of the neighbours ``other`` [..., K] seen by ``own`` [...]."""
    cos, sin = (v.unsqueeze(-1) for v in heading)
    dx = _noisy(other.x - own.x.unsqueeze(-1), config.position_noise, noise, 0)
    dy = _noisy(other.y - own.y.unsqueeze(-1), config.position_noise, noise, 1)
    yaw = _noisy(other.yaw - own.yaw.unsqueeze(-1), config.yaw_noise, noise, 2)
    speed = _noisy(other.speed, config.speed_noise, noise, 3)
    y = dy * cos - dx * sin
    values = [
        dx * cos + dy * sin,
        y,
        _near(y),
        speed,
        own.speed.unsqueeze(-1) - speed * torch.cos(yaw),
        torch.cos(yaw),
        torch.sin(yaw),
        other.length,
        other.width,
        other.trailer_length,
        other.trailer_width,
        other.hitch,
    ]
    return _stack_set(PARTNER, values, mask)


def _road(
    state: VehicleState,
    heading: Heading,
    points: tuple[Tensor, ...],
    config: SimConfig,
    noise: Tensor | None,
) -> tuple[Tensor, Tensor]:
    point_x, point_y, tangent_x, tangent_y, kind = points
    cos, sin = (v.unsqueeze(-1) for v in heading)
    dx = _noisy(point_x - state.x.unsqueeze(-1), config.position_noise, noise, 0)
    dy = _noisy(point_y - state.y.unsqueeze(-1), config.position_noise, noise, 1)
    y = dy * cos - dx * sin
    values = [
        dx * cos + dy * sin,
        y,
        _near(y),
        tangent_x * cos + tangent_y * sin,
        tangent_y * cos - tangent_x * sin,
        *((kind == k).float() for k in KINDS),
    ]
    return _stack_set(ROAD, values, kind >= 0), stored(kind >= 0)
