"""What a vehicle or its vType says about PHASE in SUMO's generic parameters; the vehicle's own win.

SUMO reserves two names on a vehicle: ``has.phase.device`` always reads false and ``device.phase.*`` is an
error, so a vehicle marks itself with ``phase.device``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from phase_sumo.bridge.fleet.choice import TIME_GAPS, Marks
from phase_sumo.bridge.sumo.conventions import Kind, ShapeRow, vehicle_kind, vehicle_shape
from phase_sumo.errors import PhaseError

TARGET_SPEEDS = (3.0, 40.0)  # m/s
KINDS: dict[str, Kind] = {"car": "car", "rigid_truck": "rigid", "articulated_truck": "articulated"}
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
TRUE, FALSE = ("1", "yes", "true", "on", "x", "t"), ("0", "no", "false", "off", "-", "f")  # SUMO's


@dataclass(frozen=True)
class Context:
    """How PHASE is to drive a vehicle; None leaves it to the run.

    Attributes:
        alpha: longitudinal action range.
        target_speed: m/s.
        time_gap: s to the leader that the target speed leaves, 0 to take no heed of leaders.
        policy: file.
    """

    alpha: float | None
    target_speed: float | None
    time_gap: float | None
    policy: str | None


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
        kind = KINDS[named] if named else vehicle_kind(vclass, length)
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
        if kind != "articulated":
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
