"""Recorded against simulated traffic: all distances, bootstrap intervals and the floor of real data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.evaluate.realism.distances import (
    GAMMAS,
    centroid_distances,
    coverage,
    energy_distance,
    frechet,
    k_means,
    mmd,
    pair_sums,
)
from phase_sumo.evaluate.realism.quantities import UNITS, Quantities, lane_change_rate, samples, wasserstein

RESAMPLES = 200
SPLITS = 5  # halves of the real data for the floor
INTERVAL = 2.5, 97.5  # percentiles
LEAST_RECORDINGS = 10  # below which windows are resampled instead
CLUSTERS = 10
EMBEDDING = ("frechet", "energy", *(f"mmd_{gamma:g}" for gamma in GAMMAS), "precision", "recall")


@dataclass(frozen=True)
class Traffic:
    """What one model, or the log, did in S windows.

    Attributes:
        embedding: [n, D] of each trajectory.
        window: [n] number of its window.
        scenes: [S] quantities of each window.
    """

    embedding: FloatArray
    window: IntArray
    scenes: tuple[Quantities, ...]

    def only(self, kept: NDArray[np.bool_]) -> Traffic:
        """The windows where ``kept`` [S] holds, numbered anew."""
        number = np.cumsum(kept) - 1
        inside = kept[self.window]
        scenes = tuple(scene for scene, keep in zip(self.scenes, kept, strict=True) if keep)
        return Traffic(self.embedding[inside], number[self.window[inside]], scenes)

    @cached_property
    def samples(self) -> dict[str, tuple[FloatArray, IntArray]]:
        """Values of each quantity and the windows that they are from."""
        found = [samples(scene) for scene in self.scenes]
        return {
            name: (
                np.concatenate([f[name] for f in found]),
                np.repeat(np.arange(len(found)), [len(f[name]) for f in found]),
            )
            for name in UNITS
        }


class Comparison:
    """Distances between two sides; what costs much is computed once, and weighted for every resample."""

    def __init__(
        self,
        real: Traffic,
        simulated: Traffic,
        likelihood: Mapping[str, tuple[FloatArray, IntArray]] | None = None,
    ) -> None:
        """``likelihood`` has a value per vehicle and its window, by name."""
        self._real, self._simulated, self._likelihood = real, simulated, likelihood or {}
        x, y = real.embedding, simulated.embedding
        a, b = real.window, simulated.window
        n, m = self._count = len(real.scenes), len(simulated.scenes)
        self._within_x, self._within_y = pair_sums(x, x, a, a, (n, n)), pair_sums(y, y, b, b, (m, m))
        self._across = pair_sums(x, y, a, b, (n, m))
        self._coverage = coverage(x, y)

    def measured(self, x: FloatArray | None = None, y: FloatArray | None = None) -> dict[str, float]:
        """All distances by name; the windows of either side count ``x``, ``y`` [S] times, by default once."""
        real, simulated = self._real, self._simulated
        x = np.ones(self._count[0]) if x is None else x
        y = np.ones(self._count[1]) if y is None else y
        mine, theirs = x[real.window], y[simulated.window]
        pairs = self._within_x.weighted(x, x), self._within_y.weighted(y, y), self._across.weighted(x, y)
        found = {
            "frechet": frechet(real.embedding, simulated.embedding, mine, theirs),
            "energy": energy_distance(*pairs),
            **{f"mmd_{gamma:g}": float(value) for gamma, value in zip(GAMMAS, mmd(*pairs), strict=True)},
            "precision": _mean(self._coverage.precise, theirs),
            "recall": _mean(self._coverage.recalled, mine),
        }
        for name in UNITS:
            (a, a_window), (b, b_window) = real.samples[name], simulated.samples[name]
            found[f"w1_{name}"] = wasserstein(a, b, x[a_window], y[b_window])
        rates = lane_change_rate(real.scenes, x), lane_change_rate(simulated.scenes, y)
        found["lane_change_rate_difference"] = abs(rates[1] - rates[0])
        for name, (values, window) in self._likelihood.items():
            known = np.isfinite(values)
            found[f"likelihood_{name}"] = _mean(values[known], x[window[known]])
        return found

    def unbiased_mmd(self) -> dict[str, float]:
        """The unbiased estimates, which may be negative."""
        values = mmd(self._within_x, self._within_y, self._across, unbiased=True)
        return {f"mmd_{gamma:g}": float(value) for gamma, value in zip(GAMMAS, values, strict=True)}


def _mean(values: np.ndarray, weight: FloatArray) -> float:
    return float(weight @ values / weight.sum()) if weight.sum() > 0 else float("nan")


def resamples(windows: Sequence[str], seed: int) -> tuple[FloatArray, str]:
    """[`RESAMPLES`, S] how often each window counts, and what was drawn: ``"recording"`` or ``"window"``.

    Args:
        windows: [S] names of the recordings they are from. Windows of a recording are drawn together, unless
            there are fewer than `LEAST_RECORDINGS`: then windows are, and intervals leave out what differs
            from day to day and place to place.
    """
    names, recording = np.unique(np.asarray(windows), return_inverse=True)
    by_recording = len(names) >= LEAST_RECORDINGS
    blocks = recording if by_recording else np.arange(len(windows))
    count = len(names) if by_recording else len(windows)
    rng = np.random.default_rng(seed)
    drawn = rng.integers(count, size=(RESAMPLES, count))
    times = np.stack([np.bincount(row, minlength=count) for row in drawn]).astype(np.float64)
    return times[:, blocks], "recording" if by_recording else "window"


def with_intervals(
    comparison: Comparison, weights: FloatArray
) -> tuple[dict[str, dict], dict[str, np.ndarray]]:
    """Every distance with its interval, and its values in the resamples.

    Real and simulated windows are drawn together. A resample holds points twice, which makes it look farther
    away than the sample is: the spread of the resamples is put around the estimate.
    """
    estimate = comparison.measured()
    rows = [comparison.measured(weight, weight) for weight in weights]
    spread = {name: np.array([row[name] for row in rows]) for name in estimate}
    return {name: _interval(value, spread[name]) for name, value in estimate.items()}, spread


def differences(
    first: dict[str, dict],
    second: dict[str, dict],
    first_spread: dict[str, np.ndarray],
    second_spread: dict[str, np.ndarray],
) -> dict[str, dict]:
    """First less second of every distance with its interval over the same resamples."""
    return {
        name: _interval(
            first[name]["value"] - second[name]["value"], first_spread[name] - second_spread[name]
        )
        for name in first
    }


def _interval(value: float, spread: np.ndarray) -> dict:
    known = spread[np.isfinite(spread)]
    if not len(known) or not np.isfinite(value):
        return {"value": value, "low": float("nan"), "high": float("nan")}
    low, high = np.percentile(known - known.mean(), INTERVAL)
    return {"value": value, "low": float(value + low), "high": float(value + high)}


def floor(real: Traffic, seed: int) -> dict[str, float]:
    """Mean distances between random halves of the real windows: what chance and other windows alone make.

    Halves have half the points, and other initial states: rollouts that start as the log did can be closer.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(SPLITS):
        half = np.zeros(len(real.scenes), bool)
        half[rng.permutation(len(half))[: len(half) // 2]] = True
        rows.append(Comparison(real.only(half), real.only(~half)).measured())
    values = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return {name: _mean(v[np.isfinite(v)], np.ones(np.isfinite(v).sum())) for name, v in values.items()}


def cluster_distances(
    real: Traffic, models: Mapping[str, Traffic], seed: int
) -> tuple[list[float], dict[str, list[float]]]:
    """Shares of `CLUSTERS` clusters of the real trajectories, and each model's centroid distances in them."""
    count = min(CLUSTERS, len(real.embedding))
    centroids = k_means(real.embedding, count, seed)
    nearest = np.linalg.norm(real.embedding[:, None] - centroids, axis=2).argmin(1)
    shares = np.bincount(nearest, minlength=count) / len(nearest)
    return shares.tolist(), {
        name: centroid_distances(traffic.embedding, centroids).tolist() for name, traffic in models.items()
    }
