"""Distributions of one run as counts in fixed classes, so that runs of a model can be added up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.evaluate.following import Following, time_headways, time_to_collision
from phase_sumo.evaluate.traffic import FloatArray, jerk, steps
from phase_sumo.evaluate.trajectories import Trajectories


@dataclass(frozen=True)
class Curve:
    """A distribution that the report draws.

    Attributes:
        title, label, share: of the plot and its axes.
        edges: [E] of the classes.
        log: draw the shares on a logarithmic axis.
    """

    title: str
    label: str
    share: str
    edges: FloatArray
    log: bool = False


CURVES = {
    "speed": Curve("Speed", "speed in km/h", "share of vehicle time", np.arange(0.0, 181.0, 4.0)),
    "headway": Curve(
        "Time headway", "time headway in s", "share of following time", np.arange(0.0, 8.01, 0.25)
    ),
    "ttc": Curve(
        "Time to collision",
        "time to collision in s",
        "share of following time",
        np.arange(0.0, 10.01, 0.5),
        True,
    ),
    "acceleration": Curve(
        "Acceleration", "acceleration in m/s²", "share of vehicle time", np.arange(-9.125, 5.2, 0.25), True
    ),
    "jerk": Curve("Jerk", "jerk in m/s³", "share of vehicle time", np.arange(-15.25, 15.3, 0.5), True),
}


def curves(t: Trajectories, f: Following) -> dict[str, FloatArray]:
    """[E] counts per class of each of `CURVES`; the last element counts what lies outside all classes."""
    values = {
        "speed": 3.6 * t.speed,
        "headway": time_headways(t, f, np.inf),
        "ttc": time_to_collision(t, f),
        "acceleration": t.accel[steps(t).after],
        "jerk": jerk(t),
    }
    result = {}
    for name, curve in CURVES.items():
        count = np.histogram(values[name], curve.edges)[0]
        result[name] = np.append(count, len(values[name]) - count.sum()).astype(np.float64)
    return result
