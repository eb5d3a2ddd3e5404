"""Which vehicles PHASE drives, as SUMO equips vehicles with its devices, and their action range and gap."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from phase_sumo.errors import PhaseError

ALPHA_BOUNDS = (0.3, 1.0)  # drawn from when nobody says otherwise: below 0.3 a vehicle can hardly keep up
TIME_GAPS = (0.0, 5.0)  # s, allowed
RESOLUTION = 1000  # of a deterministic share, SUMO's


@dataclass(frozen=True)
class Marks:
    """What a vehicle and its vType say themselves; None where they say nothing.

    Attributes:
        vehicle: the vehicle's ``phase.device``.
        type: the vType's ``has.phase.device``.
        share: the vType's ``device.phase.probability``.
    """

    vehicle: bool | None = None
    type: bool | None = None
    share: float | None = None


@dataclass(frozen=True)
class Choice:
    """Decides per vehicle id, so that the order of insertion and other vehicles do not matter.

    Attributes:
        share: probability that a vehicle is driven by PHASE; None is 1, or 0 when ``explicit`` names some.
        types: vTypes that the share is taken of; empty for all.
        alpha: fixed longitudinal action range, or bounds of a uniform draw; None draws from 0.3..1.
        seed: of the draws.
        explicit: ids that PHASE drives whatever else is said.
        deterministic: meet the share exactly by counting vehicles instead of drawing.
        time_gap: s to the leader that target speeds leave, 0 to take no heed of leaders; None is each
            vType's tau.
    """

    share: float | None = None
    types: tuple[str, ...] = ()
    alpha: float | tuple[float, float] | None = None
    seed: int = 0
    explicit: tuple[str, ...] = ()
    deterministic: bool = False
    time_gap: float | None = None

    def __post_init__(self) -> None:
        low, high = self.alpha_bounds
        if not 0.1 <= low <= high <= 1.0:
            raise PhaseError(f"alpha {low:g}..{high:g} is not within 0.1..1")
        if self.time_gap is not None and not TIME_GAPS[0] <= self.time_gap <= TIME_GAPS[1]:
            raise PhaseError(f"time gap {self.time_gap:g} s is not within {TIME_GAPS[0]:g}..{TIME_GAPS[1]:g}")
        if not 0.0 <= self.probability <= 1.0:
            raise PhaseError(f"share {self.probability:g} is not between 0 and 1")

    @property
    def probability(self) -> float:
        """The share in force for vehicles of which nothing else is said."""
        if self.share is None:
            return 0.0 if self.explicit else 1.0
        return self.share

    @property
    def alpha_bounds(self) -> tuple[float, float]:
        if self.alpha is None:
            return ALPHA_BOUNDS
        if isinstance(self.alpha, tuple):
            return self.alpha
        return self.alpha, self.alpha

    def certain(self, vehicle: str, marks: Marks) -> bool | None:
        """What is said of this one vehicle: explicit ids, then its own mark, then its vType's; or None."""
        if vehicle in self.explicit:
            return True
        return marks.type if marks.vehicle is None else marks.vehicle

    def drawn(self, vehicle: str, kind: str, number: int = 0, share: float | None = None) -> bool:
        """Whether a vehicle of which nothing certain is said belongs to the share.

        Args:
            kind: its vType.
            number: how many vehicles were asked about before, for a deterministic share.
            share: its vType's own; always drawn, as SUMO does.
        """
        if self.types and kind not in self.types:
            return False
        if self.deterministic and share is None:
            fraction = round(self.probability * RESOLUTION)
            return number % RESOLUTION * fraction % RESOLUTION < fraction
        return self._uniform(vehicle, "share") < (self.probability if share is None else share)

    def alpha_of(self, vehicle: str) -> float:
        """The vehicle's longitudinal action range."""
        low, high = self.alpha_bounds
        return low + (high - low) * self._uniform(vehicle, "alpha")

    def _uniform(self, vehicle: str, what: str) -> float:
        digest = hashlib.blake2b(f"{self.seed}:{what}:{vehicle}".encode(), digest_size=8).digest()
        return int.from_bytes(digest) / 2.0**64
