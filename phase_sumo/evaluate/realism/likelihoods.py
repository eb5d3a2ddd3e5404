"""Distances that people can read: Wasserstein between distributions, and likelihoods after WOSAC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.evaluate.realism.quantities import Quantities

FloatArray = NDArray[np.float64]
LONGEST_TTC = 10.0  # s: longer ones, and none at all, count as this
LONGEST_HEADWAY = 10.0  # s
EVERY = 5  # samples, 0.5 s, from one that counts to the next
UNITS = {
    "speed": "m/s",
    "acceleration": "m/s²",
    "gap": "m",
    "time_headway": "s",
    "ttc": "s",
    "lateral": "m",
    "lane_change_duration": "s",
}
PSEUDOCOUNT = 0.1  # WOSAC's, added to every bin


@dataclass(frozen=True)
class Histogram:
    """Evenly spaced bins; values beyond the ends count in the outermost ones."""

    low: float
    high: float
    bins: int


# WOSAC's ranges and bins, speeds up to 45 instead of 25 m/s in bins as wide
HISTOGRAMS = {
    "speed": Histogram(0.0, 45.0, 18),
    "acceleration": Histogram(-12.0, 12.0, 11),
    "yaw_rate": Histogram(-0.628, 0.628, 11),
    "nearest": Histogram(-5.0, 40.0, 10),
    "ttc": Histogram(0.0, 5.0, 10),
    "road_edge": Histogram(-20.0, 40.0, 10),
}


def wasserstein(x: FloatArray, y: FloatArray, x_weight: FloatArray, y_weight: FloatArray) -> float:
    """1-Wasserstein distance of weighted samples: the area between their distribution functions.

    NaN where one of them has no weight.
    """
    if not (x_weight.sum() > 0 and y_weight.sum() > 0):
        return float("nan")
    values = np.concatenate((x, y))
    mass = np.concatenate((x_weight / x_weight.sum(), -y_weight / y_weight.sum()))
    order = np.argsort(values, kind="stable")
    return float((np.abs(np.cumsum(mass[order])[:-1]) * np.diff(values[order])).sum())


def samples(scene: Quantities) -> dict[str, FloatArray]:
    """Values of `UNITS` in a scene."""
    taken = {
        name: getattr(scene, name)[:, ::EVERY].ravel()
        for name in ("speed", "acceleration", "gap", "time_headway", "lateral")
    }
    taken = {name: values[np.isfinite(values)] for name, values in taken.items()}
    taken["time_headway"] = taken["time_headway"][taken["time_headway"] <= LONGEST_HEADWAY]
    ttc = scene.ttc[:, ::EVERY].ravel()
    taken["ttc"] = np.minimum(ttc[~np.isnan(ttc)], LONGEST_TTC)
    taken["lane_change_duration"] = scene.change_seconds
    return taken


def likelihoods(log: Quantities, simulated: Quantities) -> dict[str, FloatArray]:
    """[N] likelihood of each vehicle's recorded samples under the histogram of its simulated ones.

    exp(mean over samples of log p), p = (count + `PSEUDOCOUNT`) / (total + `PSEUDOCOUNT` x bins): WOSAC's
    (Montali et al. 2023) with all samples of a vehicle in one histogram, and as many rollouts as are in
    ``simulated``: one. NaN for a vehicle without samples in either. 1 is the highest.
    """
    return {
        name: np.array(
            [
                _likelihood(a, b, shape)
                for a, b in zip(getattr(log, name), getattr(simulated, name), strict=True)
            ]
        )
        for name, shape in HISTOGRAMS.items()
    }


def _likelihood(log: FloatArray, simulated: FloatArray, shape: Histogram) -> float:
    log, simulated = log[~np.isnan(log)], simulated[~np.isnan(simulated)]
    if not (len(log) and len(simulated)):
        return float("nan")
    count = np.bincount(_bin(simulated, shape), minlength=shape.bins) + PSEUDOCOUNT
    return float(np.exp(np.log(count / count.sum())[_bin(log, shape)].mean()))


def _bin(values: FloatArray, shape: Histogram) -> NDArray[np.int64]:
    share = (np.clip(values, shape.low, shape.high) - shape.low) / (shape.high - shape.low)
    return np.minimum((share * shape.bins).astype(np.int64), shape.bins - 1)


def lane_change_rate(scenes: Sequence[Quantities], weight: FloatArray) -> float:
    """Lane changes per vehicle-km over scenes that count ``weight`` [S] times each."""
    changes = np.array([scene.changes.sum() for scene in scenes], np.float64)
    km = np.array([scene.km.sum() for scene in scenes])
    return float(weight @ changes / (weight @ km)) if weight @ km > 0 else float("nan")
