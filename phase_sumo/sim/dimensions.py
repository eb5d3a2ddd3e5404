"""Vehicle types and dimensions of sampled agents: cars, rigid trucks and tractor-trailers as in the US."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from phase_sumo.arrays import FloatArray
from phase_sumo.config import ScenarioConfig
from phase_sumo.sim.vehicles import VehicleShape

Kind = Literal["car", "rigid_truck", "articulated_truck"]
KINDS: tuple[Kind, ...] = ("car", "rigid_truck", "articulated_truck")

# By kind, and of an articulated truck the tractor: shares of the body's length, and means in m
WHEELBASE: dict[Kind, float] = {"car": 0.6, "rigid_truck": 0.55, "articulated_truck": 0.75}
REAR_OVERHANG: dict[Kind, float] = {"car": 0.2, "rigid_truck": 0.27, "articulated_truck": 0.1}
MEAN_LENGTH: dict[Kind, float] = {"car": 4.9, "rigid_truck": 9.5, "articulated_truck": 7.0}
MEAN_WIDTH: dict[Kind, float] = {"car": 1.9, "rigid_truck": 2.52, "articulated_truck": 2.52}
TRACTOR = (6.0, 8.0)  # m, shortest and longest
TRAILER = (12.0, 16.2)  # m, likewise
MEAN_TRAILER, MEAN_TRAILER_WIDTH = 14.1, 2.55  # m
TRAILER_BASE = 0.8  # hitch to axle, of the trailer's length
TRAILER_SETBACK = 0.9  # m from the trailer's front to the hitch
ARTICULATED_FROM = 12.5  # m: no rigid truck is longer, by law in most countries


def split(overall: float | FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths in m of the tractor a and the trailer b of an articulated truck that measures ``overall`` L.

    From the tractor's front bumper to the trailer's rear, with the tractor's rear overhang of 0.1 a:

        (1 - 0.1) a + b - `TRAILER_SETBACK` = L

    a : b is that of the means. A tractor is never out of `TRACTOR`, and for L in 16.5 ... 22.5 m no trailer
    is out of `TRAILER`, so that the policy drives what it was trained with.
    """
    front = 1.0 - REAR_OVERHANG["articulated_truck"]
    ratio = MEAN_LENGTH["articulated_truck"] / MEAN_TRAILER
    room = np.asarray(overall, np.float64) + TRAILER_SETBACK
    tractor = np.clip(ratio * room / (1.0 + front * ratio), *TRACTOR)
    return tractor, room - front * tractor


def mean_shape(kind: Kind) -> dict[str, float]:
    """`VehicleShape` of the vehicle with a kind's mean dimensions, by name."""
    length, towing = MEAN_LENGTH[kind], kind == "articulated_truck"
    return {
        "length": length,
        "width": MEAN_WIDTH[kind],
        "wheelbase": WHEELBASE[kind] * length,
        "rear_overhang": REAR_OVERHANG[kind] * length,
        "trailer_length": MEAN_TRAILER * towing,
        "trailer_width": MEAN_TRAILER_WIDTH * towing,
        "trailer_base": TRAILER_BASE * MEAN_TRAILER * towing,
        "trailer_setback": TRAILER_SETBACK * towing,
        "truck": kind != "car",
    }


def truck_slots(slots: int, config: ScenarioConfig) -> int:
    """How many slots, the first ones of every world, trucks may take."""
    return math.ceil(config.truck_ratio * slots)


def mean_length(config: ScenarioConfig) -> float:
    """Mean length in m of the vehicles that `sample_shape` makes, trailers included."""
    front = 1.0 - REAR_OVERHANG["articulated_truck"]
    # the trailer's front lies over the tractor
    articulated = MEAN_LENGTH["articulated_truck"] * front + MEAN_TRAILER - TRAILER_SETBACK
    rigid = config.rigid_truck_ratio
    truck = rigid * MEAN_LENGTH["rigid_truck"] + (1.0 - rigid) * articulated
    return (1.0 - config.truck_ratio) * MEAN_LENGTH["car"] + config.truck_ratio * truck


def sample_shape(
    count: Tensor,
    trucks_allowed: Tensor,
    slots: int,
    config: ScenarioConfig,
    generator: torch.Generator,
) -> VehicleShape:
    """Vehicle geometry: cars, rigid trucks and tractor-trailers with US dimensions (see PAPER.md).

    The share ``truck_ratio`` of each world's agents are trucks; they have the first slots, so that whatever
    concerns trailers need not look at the others.

    Args:
        count: [B] agents of each world.
        trucks_allowed: [B] bool, there are roads for trucks.
        slots: N.
    """
    device, size = count.device, (len(count), slots)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(size, generator=generator, device=device)

    def normal(mean: float, sigma: float, low: float, high: float) -> Tensor:
        return (mean + sigma * torch.randn(size, generator=generator, device=device)).clamp(low, high)

    # rounded up or down at random, so that the share holds in the mean
    draw = torch.rand(len(count), generator=generator, device=device)
    trucks = torch.floor(config.truck_ratio * count + draw).clamp_max(truck_slots(slots, config))
    trucks = trucks * trucks_allowed
    truck = torch.arange(slots, device=device) < trucks.unsqueeze(-1)
    articulated = truck & (uniform(0.0, 1.0) >= config.rigid_truck_ratio)
    rigid = truck & ~articulated

    def by_kind(values: dict[Kind, float]) -> Tensor:
        car, single, tractor = (values[kind] for kind in KINDS)
        return torch.where(articulated, tractor, torch.where(rigid, single, car))

    length = torch.where(
        articulated, uniform(*TRACTOR), torch.where(rigid, uniform(7.0, 12.0), normal(4.9, 0.4, 3.8, 6.0))
    )
    width = torch.where(truck, uniform(2.45, 2.6), normal(1.9, 0.1, 1.65, 2.15))
    trailer_length = torch.where(articulated, uniform(*TRAILER), 0.0)
    return VehicleShape(
        length=length,
        width=width,
        wheelbase=length * by_kind(WHEELBASE),
        rear_overhang=length * by_kind(REAR_OVERHANG),
        trailer_length=trailer_length,
        trailer_width=torch.where(articulated, uniform(2.5, 2.6), 0.0),
        trailer_base=TRAILER_BASE * trailer_length,
        trailer_setback=torch.where(articulated, TRAILER_SETBACK, 0.0),
        truck=truck,
    )
