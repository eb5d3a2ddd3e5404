"""Vehicle types and dimensions of sampled agents: cars, rigid trucks and tractor-trailers as in the US."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from phase_sumo.config import ScenarioConfig
from phase_sumo.sim.vehicles import VehicleShape


def truck_slots(slots: int, config: ScenarioConfig) -> int:
    """How many slots, the first ones of every world, trucks may take."""
    return math.ceil(config.truck_ratio * slots)


def mean_length(config: ScenarioConfig) -> float:
    """Mean length in m of the vehicles that `sample_shape` makes, trailers included."""
    articulated = 7.0 * 0.9 + 14.1 - 0.9  # the trailer's front lies over the tractor
    truck = config.rigid_truck_ratio * 9.5 + (1.0 - config.rigid_truck_ratio) * articulated
    return (1.0 - config.truck_ratio) * 4.9 + config.truck_ratio * truck


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
    length = torch.where(
        articulated, uniform(6.0, 8.0), torch.where(rigid, uniform(7.0, 12.0), normal(4.9, 0.4, 3.8, 6.0))
    )
    width = torch.where(truck, uniform(2.45, 2.6), normal(1.9, 0.1, 1.65, 2.15))
    trailer_length = torch.where(articulated, uniform(12.0, 16.2), 0.0)
    return VehicleShape(
        length=length,
        width=width,
        wheelbase=length * torch.where(articulated, 0.75, torch.where(rigid, 0.55, 0.6)),
        rear_overhang=length * torch.where(articulated, 0.1, torch.where(rigid, 0.27, 0.2)),
        trailer_length=trailer_length,
        trailer_width=torch.where(articulated, uniform(2.5, 2.6), 0.0),
        trailer_base=0.8 * trailer_length,
        trailer_setback=torch.where(articulated, 0.9, 0.0),
        truck=truck,
    )
