"""Vehicles placed by hand, one world of N."""

from __future__ import annotations

import torch
from torch import Tensor

from phase_sumo.sim.vehicles import HISTORY, Task, VehicleShape, VehicleState

Values = float | list[float]


def column(values: Values, count: int) -> Tensor:
    """[1, count] tensor of one value or of one value per vehicle."""
    return torch.as_tensor(values, dtype=torch.float32).expand(count).clone().unsqueeze(0)


def car_shape(count: int = 1) -> VehicleShape:
    sizes = (4.8, 1.9, 2.88, 0.96, 0.0, 0.0, 0.0, 0.0)
    truck = torch.zeros(1, count, dtype=torch.bool)
    return VehicleShape(*(column(s, count) for s in sizes), truck=truck)


def truck_shape(count: int = 1) -> VehicleShape:
    sizes = (7.0, 2.55, 5.25, 0.7, 16.0, 2.6, 12.8, 0.9)
    truck = torch.ones(1, count, dtype=torch.bool)
    return VehicleShape(*(column(s, count) for s in sizes), truck=truck)


def vehicle_state(
    x: Values = 0.0,
    y: Values = 0.0,
    yaw: Values = 0.0,
    speed: Values = 0.0,
    steer: Values = 0.0,
    hitch: Values = 0.0,
    count: int = 1,
) -> VehicleState:
    history = torch.zeros(1, count, HISTORY)
    return VehicleState(
        x=column(x, count),
        y=column(y, count),
        yaw=column(yaw, count),
        speed=column(speed, count),
        accel=column(0.0, count),
        steer=column(steer, count),
        hitch=column(hitch, count),
        accel_history=history.clone(),
        steer_history=history.clone(),
    )


def task_to(
    goal_x: Values = 100.0,
    goal_y: Values = 0.0,
    goal_yaw: Values = 0.0,
    goal_speed: Values = 20.0,
    alpha: Values = 1.0,
    count: int = 1,
) -> Task:
    return Task(*(column(v, count) for v in (goal_x, goal_y, goal_yaw, goal_speed, alpha)))
