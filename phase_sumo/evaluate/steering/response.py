"""Response curves: how an outcome follows one part of the context, all else equal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from phase_sumo.arrays import FloatArray
from phase_sumo.evaluate.statistics import Estimate, bootstrap_mean
from phase_sumo.evaluate.steering.egos import Ego
from phase_sumo.evaluate.steering.outcomes import Context, Outcome, Stage
from phase_sumo.sim.dimensions import KINDS

LEVELS: dict[str, tuple[Any, ...]] = {
    "alpha": (0.1, 0.3, 0.5, 0.7, 1.0),
    "speed": (0.7, 0.85, 1.0, 1.15, 1.3),
    "kind": KINDS,
    "lane": (-1, 0, 1),
}
# what should follow it, and whether upwards (1) or downwards (-1)
CURVES: tuple[tuple[str, str, int], ...] = (
    ("alpha", "rms_accel", 1),
    ("alpha", "most_accel", 1),
    ("alpha", "mean_speed", 1),
    ("alpha", "distance", 1),
    ("speed", "final_speed", 1),
    ("speed", "mean_speed", 1),
    ("speed", "distance", 1),
    ("kind", "most_accel", -1),
    ("kind", "mean_speed", -1),
    ("kind", "distance", -1),
    ("lane", "aside", 1),
)


@dataclass(frozen=True)
class ResponseCurve:
    """One outcome at every level of one part of the context.

    Attributes:
        part, outcome: names in `Context` and `Outcome`.
        sign: 1 if it should rise, -1 if it should fall.
        levels: L of them.
        values: [W, L], NaN where the ego of a world does not have that choice.
    """

    part: str
    outcome: str
    sign: int
    levels: tuple[Any, ...]
    values: FloatArray

    def at_levels(self) -> list[Estimate]:
        """Mean over worlds at each level."""
        return [bootstrap_mean(column) for column in self.values.T]

    def tau(self) -> Estimate:
        """Kendall's tau-a of outcome against level, times the expected sign, mean over worlds."""
        return bootstrap_mean([self.sign * kendall_tau(row[np.isfinite(row)]) for row in self.values])

    def monotone(self) -> Estimate:
        """Share of the worlds in which no step goes the wrong way."""
        steps = [np.diff(row[np.isfinite(row)]) * self.sign for row in self.values]
        return bootstrap_mean([float((step >= 0.0).all()) for step in steps])


@dataclass(frozen=True)
class Manoeuvre:
    """Something that can be asked for.

    Attributes:
        name: as asked.
        context, opposite: what asks for it, and what asks for something else.
        possible: whether the ego's surroundings allow it.
        happened: in an outcome.
    """

    name: str
    context: Context
    opposite: Context
    possible: Callable[[Ego], bool]
    happened: Callable[[Outcome], bool]


ASIDE = 1.83  # m, half a lane
FAST, SLOW = Context(alpha=1.0, speed=1.35), Context(alpha=1.0, speed=0.7)
STAY, LEFT, RIGHT = (Context(lane=lane) for lane in (0, 1, -1))
MANOEUVRES = (
    Manoeuvre("overtake", FAST, SLOW, lambda ego: ego.ahead >= 0, lambda o: o.passed_ahead),
    Manoeuvre("be overtaken", SLOW, FAST, lambda ego: ego.behind >= 0, lambda o: o.passed_by_behind),
    Manoeuvre("keep lane", STAY, LEFT, lambda ego: 1 in ego.goals, lambda o: abs(o.farthest) < ASIDE),
    Manoeuvre("change left", LEFT, STAY, lambda ego: 1 in ego.goals, lambda o: o.aside > ASIDE),
    Manoeuvre("change right", RIGHT, STAY, lambda ego: -1 in ego.goals, lambda o: o.aside < -ASIDE),
)


@dataclass(frozen=True)
class Steering:
    """All that was measured.

    Attributes:
        curves: see `CURVES`.
        asked: per manoeuvre how often it happened when asked for, when the opposite was, and how often the
            ego then touched somebody.
    """

    curves: list[ResponseCurve]
    asked: dict[str, dict[str, Estimate]]

    def to_json(self) -> dict[str, Any]:
        return {
            "curves": [
                {
                    "context": curve.part,
                    "outcome": curve.outcome,
                    "levels": list(curve.levels),
                    "values": [asdict(value) for value in curve.at_levels()],
                    "tau": asdict(curve.tau()),
                    "monotone_share": asdict(curve.monotone()),
                }
                for curve in self.curves
            ],
            "asked": {
                name: {key: asdict(value) for key, value in row.items()} for name, row in self.asked.items()
            },
        }


def measure_steering(stage: Stage, progress: Callable[[float], None] | None = None) -> Steering:
    """Drive the worlds under every level of every part of the context, and under every manoeuvre's."""
    memory = _Memory(stage, progress)
    base = Context()
    curves = []
    for part, outcome, sign in CURVES:
        levels = LEVELS[part]
        columns = [memory.outcomes(replace(base, **{part: level})) for level in levels]
        values = np.array([[getattr(o, outcome) for o in column] for column in columns]).T
        if part == "lane":
            there = [[level in ego.goals for level in levels] for ego in stage.egos]
            values = np.where(there, values, np.nan)
        curves.append(ResponseCurve(part, outcome, sign, levels, values))
    asked = {}
    for m in MANOEUVRES:
        rows = [k for k, ego in enumerate(stage.egos) if m.possible(ego)]
        wanted, other = memory.outcomes(m.context), memory.outcomes(m.opposite)
        asked[m.name] = {
            "asked": bootstrap_mean([float(m.happened(wanted[k])) for k in rows]),
            "opposite": bootstrap_mean([float(m.happened(other[k])) for k in rows]),
            "collision": bootstrap_mean([float(wanted[k].collision) for k in rows]),
        }
    return Steering(curves, asked)


class _Memory:
    """Drives the worlds once per context."""

    def __init__(self, stage: Stage, progress: Callable[[float], None] | None) -> None:
        self._stage, self._progress = stage, progress
        self._known: dict[Context, list[Outcome]] = {}
        wanted = {replace(Context(), **{part: level}) for part, levels in LEVELS.items() for level in levels}
        self._total = len(wanted | {c for m in MANOEUVRES for c in (m.context, m.opposite)})

    def outcomes(self, context: Context) -> list[Outcome]:
        if context not in self._known:
            self._known[context] = self._stage.outcomes([context] * len(self._stage.egos))
            if self._progress is not None:
                self._progress(len(self._known) / self._total)
        return self._known[context]


def kendall_tau(values: Sequence[float] | FloatArray) -> float:
    """tau-a of values against their order: (rising - falling pairs) / all pairs (Kendall 1938).

    A tie counts for neither, so an outcome that does not respond has 0.
    """
    y = np.asarray(values, np.float64)
    i, j = np.triu_indices(len(y), 1)
    return float(np.sign(y[j] - y[i]).mean()) if len(i) else float("nan")
