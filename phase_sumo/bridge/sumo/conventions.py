"""The only place that knows SUMO's conventions for poses and vehicle sizes.

SUMO: angle in degrees, 0 = north, clockwise; position = centre of the front bumper; one straight box of
the vType's length. Ours: yaw in rad, counter-clockwise from east; position = midpoint of the rear axle;
tractor and trailer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike

from phase_sumo.arrays import FloatArray
from phase_sumo.sim.dimensions import (
    ARTICULATED_FROM,
    REAR_OVERHANG,
    TRAILER_BASE,
    TRAILER_SETBACK,
    WHEELBASE,
    Kind,
    split,
)
from phase_sumo.sim.vehicles import VehicleShape

CAR_CLASSES = frozenset(
    [
        "passenger",
        "private",
        "emergency",
        "authority",
        "army",
        "vip",
        "hov",
        "taxi",
        "evehicle",
        "custom1",
        "custom2",
        "ignoring",
    ]
)
RIGID_CLASSES = frozenset(["truck", "delivery", "bus", "coach"])
ARTICULATED_CLASSES = frozenset(("trailer",))
DRIVEN_CLASSES = CAR_CLASSES | RIGID_CLASSES | ARTICULATED_CLASSES


class ShapeRow(NamedTuple):
    """One vehicle's `VehicleShape` values."""

    length: float
    width: float
    wheelbase: float
    rear_overhang: float
    trailer_length: float = 0.0
    trailer_width: float = 0.0
    trailer_base: float = 0.0
    trailer_setback: float = 0.0
    truck: bool = False

    @property
    def front_overhang(self) -> float:
        """Reference point to front bumper in m."""
        return self.length - self.rear_overhang

    @property
    def overall_length(self) -> float:
        """Front bumper to the last end of the straight combination in m: SUMO's vType length."""
        tail = max(self.rear_overhang, self.trailer_length - self.trailer_setback)
        return self.front_overhang + tail


def yaw_from_angle(angle: ArrayLike) -> FloatArray:
    """SUMO angle in degrees -> yaw in rad, in (-pi, pi]: yaw = 90 deg - angle."""
    yaw = np.radians(90.0 - np.asarray(angle, np.float64))
    return np.pi - np.remainder(np.pi - yaw, 2.0 * np.pi)


def angle_from_yaw(yaw: ArrayLike) -> FloatArray:
    """Yaw in rad -> SUMO angle in degrees, in [0, 360)."""
    return np.remainder(90.0 - np.degrees(np.asarray(yaw, np.float64)), 360.0)


def reference_from_front(
    x: ArrayLike, y: ArrayLike, yaw: ArrayLike, front_overhang: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Front-bumper centre -> rear-axle midpoint, both in m."""
    overhang = np.asarray(front_overhang, np.float64)
    return np.asarray(x) - overhang * np.cos(yaw), np.asarray(y) - overhang * np.sin(yaw)


def front_from_reference(
    x: ArrayLike, y: ArrayLike, yaw: ArrayLike, front_overhang: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Rear-axle midpoint -> front-bumper centre, both in m."""
    overhang = np.asarray(front_overhang)
    return np.asarray(x) + overhang * np.cos(yaw), np.asarray(y) + overhang * np.sin(yaw)


def vehicle_kind(vehicle_class: str, length: float) -> Kind | None:
    """What a vType is to us; None for those that PHASE does not drive (bicycles, trams, people ...)."""
    if vehicle_class in ARTICULATED_CLASSES:
        return "articulated_truck"
    if vehicle_class in RIGID_CLASSES:
        bends = vehicle_class == "truck" and length > ARTICULATED_FROM
        return "articulated_truck" if bends else "rigid_truck"
    return "car" if vehicle_class in CAR_CLASSES else None


def shape_from_type(vehicle_class: str, length: float, width: float) -> ShapeRow:
    """Geometry of a vType.

    A vehicle class that PHASE does not drive is treated as a car-like box: it is only looked at.
    """
    return vehicle_shape(vehicle_kind(vehicle_class, length) or "car", length, width, {})


def vehicle_shape(kind: Kind, overall: float, width: float, given: Mapping[str, float]) -> ShapeRow:
    """SUMO's box split into tractor and trailer, or with axles put in.

    Args:
        overall, width: of the box in m.
        given: dimensions of `VehicleShape` that are known, in m; the others follow from the box.
    """
    setback = given.get("trailer_setback", TRAILER_SETBACK)
    body = overall
    if kind == "articulated_truck":
        body = float(split(overall)[0])
        if "trailer_length" in given:  # the tractor is what is left
            front = overall - given["trailer_length"] + setback
            overhang = given.get("rear_overhang")
            body = front / (1.0 - REAR_OVERHANG[kind]) if overhang is None else front + overhang
    body = given.get("length", body)
    row = ShapeRow(
        length=body,
        width=given.get("width", width),
        wheelbase=given.get("wheelbase", WHEELBASE[kind] * body),
        rear_overhang=given.get("rear_overhang", REAR_OVERHANG[kind] * body),
        truck=kind != "car",
    )
    if kind != "articulated_truck":
        return row
    trailer = given.get("trailer_length", overall - row.front_overhang + setback)
    return row._replace(
        trailer_length=trailer,
        trailer_width=given.get("trailer_width", width),
        trailer_base=given.get("trailer_base", TRAILER_BASE * trailer),
        trailer_setback=setback,
    )


def shapes(rows: list[ShapeRow]) -> VehicleShape:
    """Rows -> [1, N] tensors."""
    columns = {name: torch.tensor([[getattr(r, name) for r in rows]]) for name in ShapeRow._fields}
    return VehicleShape(**{k: v.bool() if k == "truck" else v.float() for k, v in columns.items()})
