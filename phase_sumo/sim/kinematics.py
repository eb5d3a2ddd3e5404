"""Bicycle model driven by jerk and steering rate, with the hitch angle of a trailer."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from phase_sumo.config import Actions, DirectActionConfig, SimConfig
from phase_sumo.sim.vehicles import VehicleShape, VehicleState


def command(
    action: Tensor, state: VehicleState, alpha: Tensor, actions: Actions, dt: float
) -> tuple[Tensor, Tensor]:
    """Continuous command of a discrete action (paper: Action Space).

    The token a counts row-major over the lattice's axes, A and B with n values. On ours they are jerk and
    steering rate, and alpha scales the longitudinal one: j = alpha A[a // n], d(steer)/dt = B[a % n].

    The baseline's are acceleration and steering angle: the jerk and the rate that arrive there within this
    step, j = (A[a // n] - accel) / dt and d(steer)/dt = (B[a % n] - steer) / dt. It knows no alpha.

    Args:
        action: [W, N] int64 tokens.
        alpha: [W, N] longitudinal action range.
        dt: length of the step in s.

    Returns:
        jerk in m/s^3 and steering rate in rad/s, both [W, N].
    """
    longitudinal, lateral = (torch.tensor(axis, device=action.device) for axis in actions.axes)
    columns = lateral.shape[0]
    along = longitudinal[torch.div(action, columns, rounding_mode="floor")]
    across = lateral[action % columns]
    if isinstance(actions, DirectActionConfig):
        return (along - state.accel) / dt, (across - state.steer) / dt
    return alpha * along, across


def lattice(state: VehicleState, alpha: Tensor, actions: Actions, dt: float) -> tuple[Tensor, Tensor]:
    """Jerks [R, J] and steering rates [R, C] of all actions of R vehicles; see `command`."""
    jerks, rates = (torch.tensor(axis, device=alpha.device) for axis in actions.axes)
    token = torch.arange(len(jerks), device=alpha.device) * len(rates)
    along, _ = command(token, state.map(lambda v: v.unsqueeze(1)), alpha.unsqueeze(1), actions, dt)
    token = torch.arange(len(rates), device=alpha.device)
    _, across = command(token, state.map(lambda v: v.unsqueeze(1)), alpha.unsqueeze(1), actions, dt)
    return along, across.expand(len(alpha), -1)


def steer_limit(shape: VehicleShape, speed: Tensor, config: SimConfig) -> Tensor:
    """Largest steering angle in rad at a speed: the wheel's stop, or the grip, v^2 tan(d) / L <= a_lat."""
    grip = torch.where(shape.truck, config.truck_lateral_accel, config.lateral_accel)
    return torch.atan(grip * shape.wheelbase / speed.square().clamp_min(0.1)).clamp_max(config.max_steer)


def bounded_accel(accel: Tensor, shape: VehicleShape, config: SimConfig) -> Tensor:
    """[W, N] m/s^2 within what each vehicle can do."""
    low = torch.where(shape.truck, config.truck_accel_bounds[0], config.accel_bounds[0])
    high = torch.where(shape.truck, config.truck_accel_bounds[1], config.accel_bounds[1])
    return torch.minimum(torch.maximum(accel, low), high)


def advance(
    shape: VehicleShape, state: VehicleState, jerk: Tensor, steering_rate: Tensor, config: SimConfig
) -> VehicleState:
    """One step of the kinematic bicycle with a trailer (paper: Kinematic Model, Eq. hitch_angle_update).

    Semi-implicit Euler: v' = v + a' dt and x' = x + v' dt, so that the speed and acceleration that SUMO
    derives from positions equal the model's. The yaw at mid-step makes the path second order. With
    l the trailer base, yaw_rate = v' tan(d') / wheelbase and

        hitch' = clip(hitch + (yaw_rate - v' / l sin hitch) dt, -pi/2, pi/2).

    Args:
        jerk: [W, N] m/s^3, already scaled by alpha.
        steering_rate: [W, N] rad/s.

    Returns:
        A new state; the inputs are left alone.
    """
    dt = config.dt
    wanted = bounded_accel(state.accel + jerk * dt, shape, config)
    free = state.speed + wanted * dt
    speed = free.clamp(0.0, config.max_speed)
    # what the clamps on speed leave of it: a standing vehicle does not store up deceleration
    accel = torch.where(speed == free, wanted, (speed - state.speed) / dt)
    limit = steer_limit(shape, speed, config)
    steer = torch.minimum(torch.maximum(state.steer + steering_rate * dt, -limit), limit)
    yaw_rate = speed * torch.tan(steer) / shape.wheelbase
    middle = state.yaw + 0.5 * yaw_rate * dt
    base = torch.where(shape.articulated, shape.trailer_base, 1.0)
    hitch = state.hitch + (yaw_rate - speed / base * torch.sin(state.hitch)) * dt
    hitch = torch.where(shape.articulated, hitch.clamp(-math.pi / 2, math.pi / 2), 0.0)
    return VehicleState(
        x=state.x + speed * torch.cos(middle) * dt,
        y=state.y + speed * torch.sin(middle) * dt,
        yaw=state.yaw + yaw_rate * dt,
        speed=speed,
        accel=accel,
        steer=steer,
        hitch=hitch,
        accel_history=torch.cat((state.accel.unsqueeze(-1), state.accel_history[..., :-1]), -1),
        steer_history=torch.cat((state.steer.unsqueeze(-1), state.steer_history[..., :-1]), -1),
    )
