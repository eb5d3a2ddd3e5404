"""Many polylines at once as flat arrays: arc lengths and resampling without a Python loop per line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.near import ranges

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Polylines:
    """L lines one behind the other.

    Attributes:
        points: [P, 2] m.
        counts: [L] points of each line, at least 2.
        s: [P] rising metres; within a line its arc length, from one line to the next 1 m.
    """

    points: FloatArray
    counts: IntArray
    s: FloatArray

    @staticmethod
    def of(lines: Sequence[np.ndarray]) -> Polylines:
        points = np.concatenate([np.zeros((0, 2)), *lines])
        counts = np.array([len(line) for line in lines], np.int64)
        step = np.hypot(*np.diff(points, axis=0, prepend=0.0).T)
        step[np.cumsum(counts) - counts] = 1.0
        return Polylines(points, counts, np.cumsum(step))

    @property
    def first(self) -> IntArray:
        """[L] index of each line's first point."""
        return np.cumsum(self.counts) - self.counts

    @property
    def length(self) -> FloatArray:
        """[L] m."""
        return self.s[self.first + self.counts - 1] - self.s[self.first]

    def samples(self, spacing: float) -> Samples:
        """Evenly spaced points on every line about ``spacing`` m apart, both ends included."""
        pieces = np.maximum(np.rint(self.length / spacing), 1).astype(np.int64)
        counts = pieces + 1
        share = ranges(counts) / np.repeat(pieces, counts)
        s = np.repeat(self.s[self.first], counts) + share * np.repeat(self.length, counts)
        segment = np.searchsorted(self.s, s, side="right") - 1
        segment = np.minimum(segment, np.repeat(self.first + self.counts - 2, counts))
        return Samples(counts, s, segment)

    def at(self, samples: Samples, values: FloatArray | None = None) -> FloatArray:
        """[N, ...] the points (or other ``values`` [P, ...] given at them), interpolated."""
        values = self.points if values is None else values
        a, b = self.s[samples.segment], self.s[samples.segment + 1]
        share = ((samples.s - a) / np.maximum(b - a, 1e-9)).reshape(-1, *(1,) * (values.ndim - 1))
        return values[samples.segment] + share * (values[samples.segment + 1] - values[samples.segment])

    def direction(self, samples: Samples) -> FloatArray:
        """[N, 2] unit direction of the segment each sample lies on."""
        delta = self.points[samples.segment + 1] - self.points[samples.segment]
        return delta / np.maximum(np.hypot(*delta.T), 1e-9)[:, None]


@dataclass(frozen=True)
class Samples:
    """Places on polylines: ``counts`` [L] per line, ``s`` [N] in m, ``segment`` [N] the point before."""

    counts: IntArray
    s: FloatArray
    segment: IntArray
