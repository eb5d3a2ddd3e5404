"""What an agent sees: itself, its 16 nearest neighbours and local road points, in its own frame.

Features are declared by name with unit and scale; a checkpoint stores this layout and refuses another.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import SimConfig
from phase_sumo.sim.geometry import wrap_angle
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
LAYOUT = {"ego": EGO, "context": CONTEXT, "partner": PARTNER, "road": ROAD}


@dataclass
class Observation(TensorBatch):
    """Scaled features of A observing agents.

    Attributes:
        ego: [A, len(EGO)].
        context: [A, len(CONTEXT)] conditioning vector C_i.
        partner: [A, K, len(PARTNER)], zero where masked.
        partner_mask: [A, K] bool, True for a real neighbour.
        road: [A, R, len(ROAD)], zero where masked.
        road_mask: [A, R] bool.
    """

    ego: Tensor
    context: Tensor
    partner: Tensor
    partner_mask: Tensor
    road: Tensor
    road_mask: Tensor

    def __len__(self) -> int:
        return self.ego.shape[0]


def nearest(xy: Tensor, active: Tensor, config: SimConfig) -> tuple[Tensor, Tensor]:
    """The nearest active others of each agent, nearest first.

    Args:
        xy: [W, N, 2] m.
        active: [W, N] bool.

    Returns:
        index [W, N, K] int64 and mask [W, N, K] bool (False beyond the range or where there is none).
    """
    worlds, slots = active.shape
    offset = xy.unsqueeze(2) - xy.unsqueeze(1)
    squared = offset.square().sum(-1)
    squared = squared.masked_fill(~active.unsqueeze(1), torch.inf)
    squared.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    count = min(config.neighbours, slots)
    value, index = squared.topk(count, dim=-1, largest=False)
    mask = value < config.neighbour_range**2
    missing = config.neighbours - count
    if missing:
        index = torch.cat((index, index.new_zeros(worlds, slots, missing)), -1)
        mask = torch.cat((mask, mask.new_zeros(worlds, slots, missing)), -1)
    return index, mask & active.unsqueeze(-1)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """values[w, index[w, n, k]] for values [W, N] and index [W, N, K]."""
    worlds, slots, count = index.shape
    return values.gather(1, index.reshape(worlds, slots * count)).view(worlds, slots, count)


def observe(
    shape: VehicleShape,
    state: VehicleState,
    task: Task,
    observers: Tensor,
    neighbours: tuple[Tensor, Tensor],
    road_map: RoadMap,
    map_index: Tensor,
    config: SimConfig,
    generator: torch.Generator | None = None,
) -> Observation:
    """Ego-centric observation of the observing agents (paper: Observation Space).

    Args:
        observers: [W, N] bool, A of them; the rows of the result are in their row-major order.
        neighbours: index and mask [W, N, K] of `nearest` on the same positions.
        map_index: [W] map of each world.
        generator: draws the Gaussian noise on partner and road features; None for none.
    """
    world, slot = observers.nonzero(as_tuple=True)
    index, mask = neighbours[0][world, slot], neighbours[1][world, slot]

    def own(values: Tensor) -> Tensor:
        return values[world, slot]

    def others(values: Tensor) -> Tensor:
        return values[world.unsqueeze(-1), index]

    own_shape, own_state, own_task = shape.map(own), state.map(own), task.map(own)
    cell = road_map.cell(map_index[world], own_state.xy)
    partner = _partner(own_state, shape.map(others), state.map(others), config, generator)
    road, road_mask = _road(own_state, road_map, cell, config, generator)
    return Observation(
        ego=_ego(own_shape, own_state, own_task, road_map.cell_yaw[cell]),
        context=_context(own_shape, own_task),
        partner=partner * mask.unsqueeze(-1),
        partner_mask=mask,
        road=road * road_mask.unsqueeze(-1),
        road_mask=road_mask,
    )


def _stack(features: tuple[Feature, ...], values: list[Tensor]) -> Tensor:
    return torch.stack([v / f.scale for v, f in zip(values, features, strict=True)], -1)


def _near(y: Tensor) -> Tensor:
    """Lateral offset with the resolution spent within one lane's width."""
    return y.clamp(-4.0, 4.0)


def _ego(shape: VehicleShape, state: VehicleState, task: Task, lane_yaw: Tensor) -> Tensor:
    cos, sin = torch.cos(state.yaw), torch.sin(state.yaw)
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


def _noise(like: Tensor, sigma: float, generator: torch.Generator | None) -> Tensor | float:
    if generator is None:
        return 0.0
    return sigma * torch.randn(like.shape, generator=generator, device=like.device)


def _partner(
    own: VehicleState,
    shape: VehicleShape,
    state: VehicleState,
    config: SimConfig,
    generator: torch.Generator | None,
) -> Tensor:
    """Features [A, K, len(PARTNER)] of the neighbours ``shape``, ``state`` [A, K] seen by ``own`` [A]."""
    forward = shape.front_overhang - 0.5 * shape.length  # rear axle to the centre of the box
    cos, sin = torch.cos(own.yaw).unsqueeze(-1), torch.sin(own.yaw).unsqueeze(-1)
    dx = state.x + forward * torch.cos(state.yaw) - own.x.unsqueeze(-1)
    dx = dx + _noise(dx, config.position_noise, generator)
    dy = state.y + forward * torch.sin(state.yaw) - own.y.unsqueeze(-1)
    dy = dy + _noise(dy, config.position_noise, generator)
    yaw = state.yaw - own.yaw.unsqueeze(-1)
    yaw = yaw + _noise(yaw, config.yaw_noise, generator)
    speed = state.speed + _noise(state.speed, config.speed_noise, generator)
    y = dy * cos - dx * sin
    values = [
        dx * cos + dy * sin,
        y,
        _near(y),
        speed,
        own.speed.unsqueeze(-1) - speed * torch.cos(yaw),
        torch.cos(yaw),
        torch.sin(yaw),
        shape.length,
        shape.width,
        shape.trailer_length,
        shape.trailer_width,
        state.hitch,
    ]
    return _stack(PARTNER, values)


def _road(
    state: VehicleState,
    road_map: RoadMap,
    cell: Tensor,
    config: SimConfig,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    index = road_map.cell_points[cell]
    kind = road_map.point_kind[index]
    point, tangent = road_map.point_xy[index], road_map.point_dir[index]
    cos, sin = torch.cos(state.yaw).unsqueeze(-1), torch.sin(state.yaw).unsqueeze(-1)
    dx = point[..., 0] - state.x.unsqueeze(-1)
    dx = dx + _noise(dx, config.position_noise, generator)
    dy = point[..., 1] - state.y.unsqueeze(-1)
    dy = dy + _noise(dy, config.position_noise, generator)
    y = dy * cos - dx * sin
    values = [
        dx * cos + dy * sin,
        y,
        _near(y),
        tangent[..., 0] * cos + tangent[..., 1] * sin,
        tangent[..., 1] * cos - tangent[..., 0] * sin,
        *((kind == k).float() for k in RoadKind),
    ]
    return _stack(ROAD, values), kind >= 0
