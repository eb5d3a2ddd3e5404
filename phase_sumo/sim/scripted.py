"""Vehicles that no policy drives: they stand, or follow their lane by the Intelligent Driver Model.

Training meets in them what roads are full of and self-play hardly makes: broken-down cars, tails of queues,
leaders that brake hard, and traffic that gives way to nobody who changes lanes.

IDM (Treiber, Hennecke, Helbing 2000), with v0 the cruising speed, s the gap and dv the closing speed:

    dv/dt = a (1 - (v / v0)^4 - (s* / s)^2),   s* = s0 + T v + v dv / (2 sqrt(a b)).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import ScriptConfig, SimConfig
from phase_sumo.sim.geometry import wrap_angle
from phase_sumo.sim.pairs import PairTable
from phase_sumo.sim.vehicles import TensorBatch, VehicleShape, VehicleState, boxes

HOPS = 6  # nodes, about metres, that a vehicle passes in a step at most


@dataclass
class Script(TensorBatch):
    """What scripted vehicles do, [B, N].

    Attributes:
        scripted: bool; the numbers of others mean nothing.
        node: last lane node passed.
        beyond: m driven since.
        cruise: v0 in m/s; 0 stands.
        brake_from, brake_until: s of the scenario between which the vehicle brakes to a stop.
        brake: m/s^2, how hard.
    """

    scripted: Tensor
    node: Tensor
    beyond: Tensor
    cruise: Tensor
    brake_from: Tensor
    brake_until: Tensor
    brake: Tensor

    @staticmethod
    def nobody(active: Tensor) -> Script:
        """No scripted vehicles among slots [B, N]."""
        number, still = torch.zeros(active.shape, dtype=torch.long, device=active.device), active * 0.0
        return Script(torch.zeros_like(active), number, *(still.clone() for _ in range(5)))


@dataclass
class Moved(TensorBatch):
    """The scripted vehicles of all slots [W, N] after a step; the numbers of others mean nothing.

    Attributes:
        state: their states; ``node``, ``beyond``: see `Script`.
        gone: bool, they have come to the end of the road.
    """

    state: VehicleState
    node: Tensor
    beyond: Tensor
    gone: Tensor


def move_scripted(
    shape: VehicleShape,
    state: VehicleState,
    script: Script,
    lanes: PairTable,
    active: Tensor,
    seconds: Tensor,
    slots: tuple[int, int],
    config: ScriptConfig,
    sim: SimConfig,
) -> Moved:
    """One step of the scripted vehicles of all worlds.

    Args:
        shape, state, script: [W, N]; ``active``: [W, N] bool.
        seconds: [W] of the scenario.
        slots: the first one that scripted vehicles may have, and the one behind the last.
    """
    first, end = slots

    def some(values: Tensor) -> Tensor:
        return values[:, first:end]

    def everywhere(values: Tensor) -> Tensor:
        around = (*(0, 0) * (values.dim() - 2), first, active.shape[1] - end)
        return torch.nn.functional.pad(values, around)

    box = boxes(shape, state)
    mine = shape.map(some), state.map(some), script.map(some)
    moved, node, beyond, on_road = follow_lane(*mine, lanes, box, state.speed, active, seconds, config, sim)
    return Moved(moved.map(everywhere), everywhere(node), everywhere(beyond), everywhere(~on_road))


def follow_lane(
    shape: VehicleShape,
    state: VehicleState,
    script: Script,
    lanes: PairTable,
    box: Tensor,
    speeds: Tensor,
    active: Tensor,
    seconds: Tensor,
    config: ScriptConfig,
    sim: SimConfig,
) -> tuple[VehicleState, Tensor, Tensor, Tensor]:
    """One step of the scripted vehicles among the slots [W, S]; rows of others mean nothing.

    Args:
        box, speeds: [6, 2, W, N] and [W, N] of all vehicles, of which these are some.
        active: [W, N] bool.
        seconds: [W] of the scenario.

    Returns:
        their states, nodes and metres beyond them, and whether they are still on the road, [W, S] each.
    """
    gap, leader_speed = _leader(shape, state, box, speeds, active)
    accel = _idm(state.speed, gap, leader_speed, script.cruise, config)
    now = seconds.unsqueeze(-1)
    braking = (now >= script.brake_from) & (now < script.brake_until)
    accel = torch.where(braking, torch.minimum(-script.brake, accel), accel)
    accel = torch.where(script.cruise > 0.0, accel, sim.accel_bounds[0])
    accel = accel.clamp(sim.accel_bounds[0], config.accel)
    speed = (state.speed + accel * sim.dt).clamp_min(0.0)
    node, beyond = script.node, script.beyond + speed * sim.dt
    for _ in range(HOPS):
        passes = (beyond >= lanes.hop[node]) & (lanes.onward[node] >= 0)
        beyond = torch.where(passes, beyond - lanes.hop[node], beyond)
        node = torch.where(passes, lanes.onward[node], node)
    following = torch.where(lanes.onward[node] >= 0, lanes.onward[node], node)
    share = (beyond / lanes.hop[node].clamp_min(0.1)).clamp(0.0, 1.0)
    x, y, yaw, curvature = lanes.node[node].unbind(-1)
    next_x, next_y, next_yaw, _ = lanes.node[following].unbind(-1)
    steer = torch.atan(shape.wheelbase * curvature)
    moved = VehicleState(
        # who stands keeps to where it is, beside the centre of its lane
        x=torch.where(speed > 0.0, x + share * (next_x - x), state.x),
        y=torch.where(speed > 0.0, y + share * (next_y - y), state.y),
        yaw=torch.where(speed > 0.0, yaw + share * wrap_angle(next_yaw - yaw), state.yaw),
        speed=speed,
        accel=(speed - state.speed) / sim.dt,
        steer=steer,
        hitch=torch.zeros_like(x),
        accel_history=torch.cat((state.accel.unsqueeze(-1), state.accel_history[..., :-1]), -1),
        steer_history=torch.cat((state.steer.unsqueeze(-1), state.steer_history[..., :-1]), -1),
    )
    return moved, node, beyond, torch.where(lanes.onward[node] < 0, speed, 0.0) == 0.0


def _leader(
    shape: VehicleShape, state: VehicleState, box: Tensor, speeds: Tensor, active: Tensor
) -> tuple[Tensor, Tensor]:
    """Gap in m to the nearest box ahead in the vehicle's own width, and that box's speed along the way.

    Returns:
        [W, S] each; gap inf without a leader.
    """
    cos, sin = torch.cos(state.yaw).unsqueeze(-1), torch.sin(state.yaw).unsqueeze(-1)
    x, y, other_cos, other_sin, half_length, half_width = (
        torch.cat((part[0], part[1]), -1).unsqueeze(1) for part in box
    )
    there, speed = (torch.cat((values, values), -1).unsqueeze(1) for values in (active, speeds))
    dx, dy = x - state.x.unsqueeze(-1), y - state.y.unsqueeze(-1)
    along, aside = dx * cos + dy * sin, (dy * cos - dx * sin).abs()
    turn_cos, turn_sin = (other_cos * cos + other_sin * sin), (other_sin * cos - other_cos * sin).abs()
    reach = half_length * turn_cos.abs() + half_width * turn_sin
    wide = half_length * turn_sin + half_width * turn_cos.abs() + 0.5 * shape.width.unsqueeze(-1)
    front = shape.front_overhang.unsqueeze(-1)
    # its own boxes lie at or behind its centre
    ahead = there & (along > front) & (aside < wide) & (half_length > 0)
    gap = torch.where(ahead, along - reach - front, torch.inf)
    nearest, which = gap.min(-1)
    return nearest, (speed * turn_cos).gather(-1, which.unsqueeze(-1)).squeeze(-1)


def _idm(speed: Tensor, gap: Tensor, leader: Tensor, cruise: Tensor, config: ScriptConfig) -> Tensor:
    closing = speed - torch.where(gap.isinf(), speed, leader)
    room = config.least_gap + config.time_gap * speed
    room = room + speed * closing / (2.0 * (config.accel * config.comfortable) ** 0.5)
    free = (speed / cruise.clamp_min(0.1)).pow(4)
    near = (room.clamp_min(0.0) / gap.clamp_min(0.1)).square()
    return config.accel * (1.0 - free - near)
