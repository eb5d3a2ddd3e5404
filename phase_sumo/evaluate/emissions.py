"""Fuel and CO2 from speed and acceleration by tables of an emission model.

The tables come from the simulator's own model; here they are only looked up, for every driver model alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phase_sumo.evaluate.traffic import FloatArray, steps
from phase_sumo.evaluate.trajectories import Trajectories


@dataclass(frozen=True)
class EmissionTable:
    """What one emission class gives off per second.

    Attributes:
        speed: [A] m/s, evenly spaced; accel: [B] m/s^2, evenly spaced.
        fuel, co2: [A, B] mg/s.
    """

    speed: FloatArray
    accel: FloatArray
    fuel: FloatArray
    co2: FloatArray

    def rate(self, values: FloatArray, speed: FloatArray, accel: FloatArray) -> FloatArray:
        """``values`` between the table's points, bilinear; clamped to its borders."""
        i, u = _place(self.speed, speed)
        j, w = _place(self.accel, accel)
        low = (1 - w) * values[i, j] + w * values[i, j + 1]
        high = (1 - w) * values[i + 1, j] + w * values[i + 1, j + 1]
        return (1 - u) * low + u * high


def _place(axis: FloatArray, at: FloatArray) -> tuple[np.ndarray, FloatArray]:
    x = np.clip((at - axis[0]) / (axis[1] - axis[0]), 0.0, len(axis) - 1.0)
    i = np.minimum(x.astype(np.int64), len(axis) - 2)
    return i, x - i


def emitted(t: Trajectories, tables: Mapping[str, EmissionTable]) -> tuple[float, float]:
    """Fuel and CO2 of all vehicles in kg: sum of rate(v, a) dt over the samples; NaN if a class has no table.

    v and a are those at the end of each step, as in SUMO's emission device, a over the simulator's own step.
    """
    s = steps(t)
    number = {name: k for k, name in enumerate(sorted(set(t.emission_classes)))}
    of_vehicle = np.array([number[name] for name in t.emission_classes], np.int64)
    kind = of_vehicle[t.vehicle[s.after]] if len(of_vehicle) else np.zeros(0, np.int64)
    fuel = co2 = 0.0
    for name, k in number.items():
        rows = s.after[kind == k]
        if not len(rows):
            continue
        if name not in tables:
            return float("nan"), float("nan")
        table, seconds = tables[name], s.seconds[kind == k]
        fuel += float((table.rate(table.fuel, t.speed[rows], t.accel[rows]) * seconds).sum())
        co2 += float((table.rate(table.co2, t.speed[rows], t.accel[rows]) * seconds).sum())
    return fuel / 1e6, co2 / 1e6
