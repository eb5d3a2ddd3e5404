"""Vehicle geometry and state; axes are W worlds x N agent slots.

The reference point of a vehicle is the midpoint of its rear axle, with the hitch on it. Yaw is in rad,
counter-clockwise from east. The hitch angle is tractor yaw minus trailer yaw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TypeVar

import torch
from torch import Tensor

B = TypeVar("B", bound="TensorBatch")

HISTORY = 3  # past accelerations and steering angles in the observation


@dataclass
class TensorBatch:
    """Base of the dataclasses of tensors that share leading axes."""

    def map(self: B, function: Callable[[Tensor], Tensor]) -> B:
        return type(self)(**{f.name: function(getattr(self, f.name)) for f in fields(self)})

    def take(self: B, index: Tensor) -> B:
        """Rows ``index`` [n] of the first axis."""
        return self.map(lambda values: values.index_select(0, index))

    def where(self: B, mask: Tensor, other: B) -> B:
        """``self`` where mask [W, N] holds, ``other`` elsewhere."""

        def choose(mine: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(mask.view(*mask.shape, *(1,) * (mine.dim() - mask.dim())), mine, theirs)

        return type(self)(
            **{f.name: choose(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)}
        )


@dataclass
class VehicleShape(TensorBatch):
    """Constant geometry of each vehicle, all [W, N].

    Attributes:
        length, width: of the car, rigid truck or tractor, in m.
        wheelbase: m.
        rear_overhang: rear axle to rear bumper, in m.
        trailer_length, trailer_width: of the trailer box in m; 0 without a trailer.
        trailer_base: hitch to trailer axle in m (l_trailer of the hitch equation); 0 without a trailer.
        trailer_setback: trailer front to hitch in m; 0 without a trailer.
        truck: bool, rigid or articulated truck.
    """

    length: Tensor
    width: Tensor
    wheelbase: Tensor
    rear_overhang: Tensor
    trailer_length: Tensor
    trailer_width: Tensor
    trailer_base: Tensor
    trailer_setback: Tensor
    truck: Tensor

    @property
    def articulated(self) -> Tensor:
        return self.trailer_length > 0

    @property
    def front_overhang(self) -> Tensor:
        """Reference point to front bumper in m."""
        return self.length - self.rear_overhang

    @property
    def rear_reach(self) -> Tensor:
        """Reference point to the rear end of the vehicle, trailer included, in m."""
        return torch.maximum(self.rear_overhang, self.trailer_length - self.trailer_setback)

    @property
    def reach(self) -> Tensor:
        """No part of the vehicle is farther than this from its reference point, in m."""
        half_width = 0.5 * torch.maximum(self.width, self.trailer_width)
        return torch.maximum(self.front_overhang, self.rear_reach) + half_width


@dataclass
class VehicleState(TensorBatch):
    """Motion state, [W, N] except the histories.

    Attributes:
        x, y: rear-axle midpoint in m.
        yaw: rad.
        speed: rear-axle speed in m/s, >= 0.
        accel: m/s^2.
        steer: front-wheel angle in rad.
        hitch: tractor yaw minus trailer yaw in rad; 0 without a trailer.
        accel_history, steer_history: [W, N, 3] values one, two and three steps ago.
    """

    x: Tensor
    y: Tensor
    yaw: Tensor
    speed: Tensor
    accel: Tensor
    steer: Tensor
    hitch: Tensor
    accel_history: Tensor
    steer_history: Tensor

    @property
    def xy(self) -> Tensor:
        return torch.stack((self.x, self.y), -1)


@dataclass
class Task(TensorBatch):
    """Goal and conditioning context of each agent, all [W, N].

    Attributes:
        goal_x, goal_y: m.
        goal_yaw: lane direction at the goal in rad.
        goal_speed: target speed v_goal in m/s.
        alpha: longitudinal action range in [0.1, 1].
    """

    goal_x: Tensor
    goal_y: Tensor
    goal_yaw: Tensor
    goal_speed: Tensor
    alpha: Tensor


def boxes(shape: VehicleShape, state: VehicleState) -> Tensor:
    """Oriented boxes of tractor and trailer.

    Returns:
        [6, 2, W, N]: centre x, y, cos yaw, sin yaw, half length, half width; the second axis is tractor,
        trailer. Vehicles without a trailer have half extents 0 there, at their reference point.
    """
    yaw = torch.stack((state.yaw, state.yaw - state.hitch))
    length = torch.stack((shape.length, shape.trailer_length))
    width = torch.stack((shape.width, shape.trailer_width))
    ahead = torch.stack((shape.front_overhang, shape.trailer_setback)) - 0.5 * length
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    return torch.stack((state.x + ahead * cos, state.y + ahead * sin, cos, sin, 0.5 * length, 0.5 * width))
