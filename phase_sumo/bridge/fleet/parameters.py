"""Which vehicles PHASE drives and how, as SUMO equips vehicles with its devices.

Options and SUMO's generic parameters say it; those of a vehicle win over those of its vType. SUMO reserves
two names on a vehicle: ``has.phase.device`` always reads false and ``device.phase.*`` is an error, so a
vehicle marks itself with ``phase.device``.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

from phase_sumo.bridge.sumo.conventions import ShapeRow, vehicle_kind, vehicle_shape
from phase_sumo.bridge.sumo.option_names import FALSE, TRUE
from phase_sumo.errors import PhaseError
from phase_sumo.sim.dimensions import KINDS, Kind

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
        guard: keep vehicles from what is unsafe, see `sim.guard`.
    """

    share: float | None = None
    types: tuple[str, ...] = ()
    alpha: float | tuple[float, float] | None = None
    seed: int = 0
    explicit: tuple[str, ...] = ()
    deterministic: bool = False
    time_gap: float | None = None
    guard: bool = True

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


TARGET_SPEEDS = (3.0, 40.0)  # m/s
# allowed values, m; the shares of the training's dimensions (sim/dimensions.py) with room on both sides
BODY = {
    "length": (2.0, 20.0),
    "width": (1.0, 3.0),
    "wheelbase": (1.0, 12.0),
    "rear_overhang": (0.0, 6.0),
}
TRAILER = {
    "trailer_length": (5.0, 20.0),
    "trailer_width": (1.0, 3.0),
    "trailer_base": (2.0, 18.0),
    "trailer_setback": (0.0, 3.0),
}
SLACK = 0.1  # m that the vType's box may differ from ours
# every parameter of ours that a vehicle or vType may have
KEYS = (
    *("phase.device", "has.phase.device", "device.phase.probability", "phase.type", "phase.alpha"),
    *("phase.target_speed", "phase.time_gap", "phase.policy", "phase.guard", "phase.hitch"),
    *(f"phase.{name}" for name in BODY | TRAILER),
)


@dataclass(frozen=True)
class Context:
    """How PHASE is to drive a vehicle; None leaves it to the run.

    Attributes:
        alpha: longitudinal action range.
        target_speed: m/s.
        time_gap: s to the leader that the target speed leaves, 0 to take no heed of leaders.
        policy: file.
        guard: keep it from what is unsafe.
    """

    alpha: float | None
    target_speed: float | None
    time_gap: float | None
    policy: str | None
    guard: bool | None


class Parameters:
    """Generic parameters of one vehicle and its vType."""

    def __init__(self, api: Any, vehicle: str, kind: str) -> None:
        self._api, self._vehicle, self._kind = api, vehicle, kind

    def marks(self) -> Marks:
        """What decides whether PHASE drives it, see `Choice`."""
        return Marks(
            vehicle=self._flag("phase.device", self._own("phase.device")),
            type=self._flag("has.phase.device", self._types("has.phase.device")),
            share=self._number(
                "device.phase.probability", self._types("device.phase.probability"), (0.0, 1.0)
            ),
        )

    def context(self) -> Context:
        """How PHASE is to drive it."""
        return Context(
            alpha=self.number("phase.alpha", (0.1, 1.0)),
            target_speed=self.number("phase.target_speed", TARGET_SPEEDS),
            time_gap=self.number("phase.time_gap", TIME_GAPS),
            policy=self._text("phase.policy") or None,
            guard=self._flag("phase.guard", self._text("phase.guard")),
        )

    def shape(self) -> tuple[ShapeRow, Kind | None]:
        """Its geometry, and what it is to us; None for what PHASE does not drive.

        Raises:
            PhaseError: they are impossible, or differ from the box that others keep away from in SUMO.
        """
        types = self._api.vehicletype
        vclass, length = types.getVehicleClass(self._kind), float(types.getLength(self._kind))
        width, named = float(types.getWidth(self._kind)), self._text("phase.type")
        if named and named not in KINDS:
            raise self._bad("phase.type", named, f"one of {', '.join(KINDS)}")
        kind: Kind | None = next((k for k in KINDS if k == named), None) or vehicle_kind(vclass, length)
        given = {name: self.number(f"phase.{name}", bounds) for name, bounds in (BODY | TRAILER).items()}
        known = {name: value for name, value in given.items() if value is not None}
        shape = vehicle_shape(kind or "car", length, width, known)
        if named or known:
            self._check(shape, kind, known, length, width)
        return shape, kind

    def number(self, key: str, bounds: tuple[float, float]) -> float | None:
        """A number within bounds, or None."""
        return self._number(key, self._text(key), bounds)

    def _check(
        self, shape: ShapeRow, kind: Kind | None, known: dict[str, float], length: float, width: float
    ) -> None:
        if kind != "articulated_truck":
            for name in TRAILER:
                if name in known:
                    wanted = "an articulated truck: set phase.type=articulated_truck"
                    raise self._bad(f"phase.{name}", f"{known[name]:g}", wanted)
        else:
            low, high = TRAILER["trailer_length"]
            if not low <= shape.trailer_length <= high:
                raise PhaseError(
                    f"{self._who}: length {length:g} m leaves {shape.trailer_length:.2f} m for the trailer, "
                    f"allowed {low:g}..{high:g} m; correct the vType's length or phase.length"
                )
            if shape.trailer_base > shape.trailer_length - shape.trailer_setback:
                raise self._bad("phase.trailer_base", f"{shape.trailer_base:g}", "an axle under the trailer")
        if shape.wheelbase + shape.rear_overhang > shape.length:
            raise self._bad(
                "phase.wheelbase", f"{shape.wheelbase:g}", f"both axles within {shape.length:g} m"
            )
        for name, ours, sumos in (
            ("length", shape.overall_length, length),
            ("width", max(shape.width, shape.trailer_width), width),
        ):
            if abs(ours - sumos) > SLACK:
                raise PhaseError(
                    f"{self._who}: {name} {sumos:g} m for SUMO, but {ours:g} m after the phase.* parameters; "
                    f"other vehicles keep away from SUMO's box, so make both the same"
                )

    def _own(self, key: str) -> str:
        return str(self._api.vehicle.getParameter(self._vehicle, key))

    def _types(self, key: str) -> str:
        return str(self._api.vehicletype.getParameter(self._kind, key))

    def _text(self, key: str) -> str:
        return self._own(key) or self._types(key)

    def _flag(self, key: str, text: str) -> bool | None:
        if text and text.lower() not in TRUE + FALSE:
            raise self._bad(key, text, "true or false")
        return text.lower() in TRUE if text else None

    def _number(self, key: str, text: str, bounds: tuple[float, float]) -> float | None:
        if not text:
            return None
        low, high = bounds
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise self._bad(key, text, f"a number in {low:g}..{high:g}")
        return value

    @property
    def _who(self) -> str:
        return f"vehicle {self._vehicle!r} (vType {self._kind!r})"

    def _bad(self, key: str, text: str, wanted: str) -> PhaseError:
        return PhaseError(f"{self._who}: parameter {key}={text!r}, expected {wanted}")
