"""Observations of random numbers."""

from __future__ import annotations

import torch

from phase_sumo.sim.observation import CONTEXT, EGO, PARTNER, ROAD, Observation


def observation(batch: int = 5, partners: int = 16, road: int = 32, seed: int = 0) -> Observation:
    g = torch.Generator().manual_seed(seed)
    return Observation(
        torch.randn(batch, len(EGO), generator=g),
        torch.randn(batch, len(CONTEXT), generator=g),
        torch.randn(batch, partners, len(PARTNER), generator=g),
        torch.rand(batch, partners, generator=g) < 0.7,
        torch.randn(batch, road, len(ROAD), generator=g),
        torch.rand(batch, road, generator=g) < 0.9,
    )
