"""What a guarded vehicle does when it must: brake as hard as it can and run along its lane."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import GuardConfig, SimConfig
from phase_sumo.sim.geometry import wrap_angle
from phase_sumo.sim.kinematics import bounded_accel, steer_limit
from phase_sumo.sim.path import Path, Sight
from phase_sumo.sim.vehicles import TensorBatch, VehicleShape, VehicleState

PIECE = 8.5  # m
SHORTEST = 2.0  # m in which a slow vehicle turns along its path
STEPS = 80  # until everybody stands: 40 m/s with 6 m/s^2 and 0.6 s to build up
# those after which gaps are looked at; in between, they are less by a few cm at most
LOOKED_AT = (1, 2, 3, 4, 6, 8, 10, 12, 15, 18, 21, 24, 28, 32, 36, 40, 45, 50, 56, 64, 80)


@dataclass
class Motion:
    """R vehicles and where they are on their paths.

    Attributes:
        s, d: [R] m of the rear axle.
        askew: [R] rad, direction of the vehicle relative to the path.
    """

    shape: VehicleShape
    state: VehicleState
    path: Path
    s: Tensor
    d: Tensor
    askew: Tensor

    @staticmethod
    def of(shape: VehicleShape, state: VehicleState, sight: Sight) -> Motion:
        """Vehicles [R] on the lanes that they see."""
        path = Path.ahead(sight)
        s, d, yaw = path.locate(state.x, state.y)
        return Motion(shape, state, path, s, d, wrap_angle(state.yaw - yaw))

    def take(self, index: Tensor) -> Motion:
        """Rows ``index``."""
        whole = (self.shape.take(index), self.state.take(index), self.path.take(index))
        return Motion(*whole, *(v.index_select(0, index) for v in (self.s, self.d, self.askew)))


@dataclass
class Pieces(TensorBatch):
    """Vehicles cut into pieces up to `PIECE` long, whose extents along and across a bent road are close.

    Attributes:
        row: number of the vehicle.
        front, back: ends of the piece ahead of the rear axle, along tractor or trailer, in m.
        width: m.
        towed: bool, of a trailer.
    """

    row: Tensor
    front: Tensor
    back: Tensor
    width: Tensor
    towed: Tensor

    @staticmethod
    def of(shape: VehicleShape, rows: Tensor) -> Pieces:
        """Pieces of vehicles ``rows`` [R] of [M], one vehicle's side by side."""
        parts = []
        for towed, front, length, width in (
            (False, shape.front_overhang, shape.length, shape.width),
            (True, shape.trailer_setback, shape.trailer_length, shape.trailer_width),
        ):
            count = torch.ceil(length[rows] / PIECE).long()
            which = torch.repeat_interleave(torch.arange(len(rows)), count)
            order = torch.arange(len(which)) - (count.cumsum(0) - count)[which]
            row, each = rows[which], (length[rows] / count.clamp_min(1))[which]
            ahead = front[row] - order * each
            is_towed = torch.full_like(row, towed, dtype=torch.bool)
            parts.append((which, ahead, ahead - each, width[row], is_towed))
        return Pieces(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def limits(truck: Tensor, sim: SimConfig, config: GuardConfig) -> tuple[Tensor, Tensor]:
    """Hardest braking b in m/s^2 and its build-up J in m/s^3, both > 0, for each vehicle."""
    b = torch.where(truck, -sim.truck_accel_bounds[0], -sim.accel_bounds[0])
    return b, torch.where(truck, config.emergency_jerk[1], config.emergency_jerk[0])


def braking(
    shape: VehicleShape, state: VehicleState, jerk: Tensor, sim: SimConfig, config: GuardConfig
) -> tuple[Tensor, Tensor]:
    """One step with a jerk [R, J], then the hardest braking there is, in the steps of `kinematics.advance`.

    a_1 = a + j dt, a_k = max(a_(k-1) - J dt, -b), v_k = max(v_(k-1) + a_k dt, 0), x_k = x_(k-1) + v_k dt.

    Returns:
        speed in m/s after each step, [R, J, STEPS], and metres driven until those `LOOKED_AT` [R, J, T].
    """
    dt = sim.dt
    wide = shape.map(lambda v: v.unsqueeze(1))
    first = bounded_accel(state.accel.unsqueeze(1) + jerk * dt, wide, sim)
    hardest, build_up = limits(shape.truck, sim, config)
    later = torch.arange(STEPS) * dt
    accel = torch.maximum(first.unsqueeze(2) - build_up.view(-1, 1, 1) * later, -hardest.view(-1, 1, 1))
    speed = (state.speed.view(-1, 1, 1) + (accel * dt).cumsum(2)).clamp(0.0, sim.max_speed)
    return speed, _driven(speed, dt)


def braking_of_others(
    truck: Tensor, speed: Tensor, accel: Tensor, sim: SimConfig, config: GuardConfig
) -> Tensor:
    """Metres [M, T] until the steps `LOOKED_AT` that vehicles drive which brake as hard as they can.

    a_k = max(a_(k-1) - J dt, -b), a_0 being ``accel``, or 0 for who speeds up.
    """
    b = torch.where(truck, config.others_braking[1], config.others_braking[0]).unsqueeze(1)
    later = sim.dt * torch.arange(1, STEPS + 1)
    accel = torch.maximum(accel.clamp_max(0.0).unsqueeze(1) - config.others_jerk * later, -b)
    left = speed.unsqueeze(1) + (accel * sim.dt).cumsum(1)
    return _driven(left.clamp_min(0.0), sim.dt)


def _driven(speed: Tensor, dt: float) -> Tensor:
    """Metres [..., T] driven until the steps `LOOKED_AT` with speeds [..., STEPS]."""
    return (speed.cumsum(-1) * dt)[..., torch.tensor(LOOKED_AT) - 1]


def straighten(motion: Motion, sim: SimConfig, config: GuardConfig) -> Tensor:
    """Steering rate [R, 1] in rad/s with which a vehicle turns along its path."""
    curvature = motion.path.curvature_at(motion.s.unsqueeze(1))
    state = motion.state
    return _toward(
        motion.shape.wheelbase.unsqueeze(1),
        curvature,
        motion.askew.unsqueeze(1),
        state.speed.unsqueeze(1),
        state.steer.unsqueeze(1),
        sim,
        config,
    )


def _toward(
    wheelbase: Tensor,
    curvature: Tensor,
    askew: Tensor,
    speed: Tensor,
    steer: Tensor,
    sim: SimConfig,
    config: GuardConfig,
) -> Tensor:
    """Steering rate that makes the direction relative to the path decay, askew' = -askew / tau, if fast."""
    bend = curvature - askew / (config.straighten * speed).clamp_min(SHORTEST)
    wanted = torch.atan(wheelbase * bend)
    return ((wanted - steer) / sim.dt).clamp(-config.steering_rate, config.steering_rate)


def sweep(
    motion: Motion,
    pieces: Pieces,
    speed: Tensor,
    rate: Tensor,
    sim: SimConfig,
    config: GuardConfig,
) -> tuple[Tensor, Tensor]:
    """The strips of road that vehicles cover after one step with a steering rate, running along their paths.

    Args:
        pieces: [Q] of the R vehicles.
        speed: [R, T] m/s after each step.
        rate: [R, C] rad/s, of the first step.

    Returns:
        least and largest d of every piece, each [Q, C] in m.
    """
    shape, state = motion.shape.map(lambda v: v.unsqueeze(1)), motion.state
    count = max(round(config.settle / sim.dt), 1)
    speed = speed[:, :count]
    curvature = motion.path.curvature_at(motion.s.unsqueeze(1) + speed.cumsum(1) * sim.dt)
    limit = steer_limit(shape, speed, sim)
    d, askew, steer, hitch = (
        v.unsqueeze(1).expand_as(rate) for v in (motion.d, motion.askew, state.steer, state.hitch)
    )
    base = torch.where(shape.articulated, shape.trailer_base, 1.0)
    course = []
    for k in range(count):
        v, bend, most = speed[:, k : k + 1], curvature[:, k : k + 1], limit[:, k : k + 1]
        if k:
            rate = _toward(shape.wheelbase, bend, askew, v, steer, sim, config)
        steer = torch.minimum(torch.maximum(steer + rate * sim.dt, -most), most)
        yaw_rate = v * torch.tan(steer) / shape.wheelbase
        turned = (yaw_rate - v * bend) * sim.dt
        d = d + v * torch.sin(askew + 0.5 * turned) * sim.dt
        askew = askew + turned
        hitch = hitch + (yaw_rate - v / base * torch.sin(hitch)) * sim.dt
        course.append(torch.stack((d, askew, hitch)))
    d, askew, hitch = torch.stack(course, 1)[:, :, pieces.row].unbind(0)  # [T, Q, C]
    sin = torch.sin(torch.where(pieces.towed.unsqueeze(1), askew - hitch, askew))
    half_bend = 0.5 * curvature.T[:, pieces.row].unsqueeze(2)
    front, back, side = (v.unsqueeze(1) for v in (pieces.front, pieces.back, 0.5 * pieces.width))
    one, two = front * sin - half_bend * front.square(), back * sin - half_bend * back.square()
    low, high = d + torch.minimum(one, two), d + torch.maximum(one, two)
    return low.amin(0) - side, high.amax(0) + side
