"""Which vehicles PHASE drives, and their conditioning context."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from phase_sumo.errors import PhaseError

ALPHA_BOUNDS = (0.3, 1.0)  # drawn from when nobody says otherwise: below 0.3 a vehicle can hardly keep up


@dataclass(frozen=True)
class Choice:
    """Decides per vehicle id, so that the order of insertion and other vehicles do not matter.

    Attributes:
        share: probability that a vehicle is driven by PHASE.
        types: vTypes to choose from; empty for all.
        alpha: fixed longitudinal action range, or bounds of a uniform draw; None draws from 0.3..1.
        seed: of the draws.
    """

    share: float = 1.0
    types: tuple[str, ...] = ()
    alpha: float | tuple[float, float] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        low, high = self.alpha_bounds
        if not 0.1 <= low <= high <= 1.0:
            raise PhaseError(f"alpha {low:g}..{high:g} is not within 0.1..1")

    @property
    def alpha_bounds(self) -> tuple[float, float]:
        if self.alpha is None:
            return ALPHA_BOUNDS
        if isinstance(self.alpha, tuple):
            return self.alpha
        return self.alpha, self.alpha

    def chosen(self, vehicle: str, kind: str) -> bool:
        """Whether PHASE drives the vehicle."""
        if self.types and kind not in self.types:
            return False
        return self._uniform(vehicle, "share") < self.share

    def alpha_of(self, vehicle: str) -> float:
        """The vehicle's longitudinal action range."""
        low, high = self.alpha_bounds
        return low + (high - low) * self._uniform(vehicle, "alpha")

    def _uniform(self, vehicle: str, what: str) -> float:
        digest = hashlib.blake2b(f"{self.seed}:{what}:{vehicle}".encode(), digest_size=8).digest()
        return int.from_bytes(digest) / 2.0**64
