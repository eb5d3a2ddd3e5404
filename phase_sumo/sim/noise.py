"""Gaussian noise for observations, cheap enough for every agent and step."""

from __future__ import annotations

import math

import torch
from torch import Tensor

ALIGNMENT = 16  # numbers: slices of the table start at multiples of it


class NoiseTable:
    """Standard normal numbers for observations: a fixed table, read from a new random place every step.

    Drawing 128 numbers per agent and step would cost more than the rest of the observation.

    Args:
        shapes: of the tensors wanted per step.
        generator: on the CPU; draws the table's seed and the places.
    """

    def __init__(
        self, shapes: tuple[tuple[int, ...], ...], generator: torch.Generator, device: torch.device | str
    ) -> None:
        self._shapes = shapes
        self._sizes = [math.ceil(math.prod(s) / ALIGNMENT) * ALIGNMENT for s in shapes]
        fixed = torch.Generator(device=device).manual_seed(0)
        self._table = torch.randn(2 * sum(self._sizes), generator=fixed, device=device)
        self._generator = generator

    def draw(self) -> list[Tensor]:
        """One tensor per shape."""
        places = (len(self._table) - sum(self._sizes)) // ALIGNMENT
        at = ALIGNMENT * int(torch.randint(places + 1, (), generator=self._generator))
        parts = self._table[at : at + sum(self._sizes)].split(self._sizes)
        return [part[: math.prod(shape)].view(shape) for part, shape in zip(parts, self._shapes, strict=True)]
