"""All traffic measures of one run by name, and what the tables say about each.

Distributions are counts in fixed classes, so that runs of a model can be added up. Emission tables come from
the simulator's own model; here they are only looked up, for every driver model alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phase_sumo.arrays import FloatArray
from phase_sumo.evaluate import surrogate_safety, traffic
from phase_sumo.evaluate.surrogate_safety import Following, time_headways, time_to_collision
from phase_sumo.evaluate.traffic import Cells, jerk, steps
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


SHORT_HEADWAY = 1.0  # s


@dataclass(frozen=True)
class Measure:
    """One row of the tables.

    Attributes:
        label, unit, digits: as printed.
        group: heading that it stands under.
        count, exposure: names of the count and of the vehicle-km behind a rate per 1000 vehicle-km; such a
            rate is pooled over the seeds and has a Poisson interval.
    """

    label: str
    unit: str
    digits: int
    group: str
    count: str = ""
    exposure: str = ""


MEASURES = {
    "vehicles": Measure("Vehicles inserted", "", 0, "Demand"),
    "arrived_all": Measure("Vehicles arrived", "", 0, "Demand"),
    "running": Measure("Vehicles still driving at the end", "", 0, "Demand"),
    "removed": Measure("Vehicles taken out, see trips.csv", "", 0, "Demand"),
    "vehicle_km": Measure("Distance on the observed road", "veh-km", 1, "Demand"),
    "mean_depart_delay": Measure("Insertion delay", "s", 2, "Demand"),
    "travel_time": Measure("Travel time¹", "s", 1, "Travel"),
    "delay_per_km": Measure("Delay against the own target speed", "s/veh-km", 2, "Travel"),
    "mean_speed": Measure("Mean speed", "m/s", 2, "Travel"),
    "flow": Measure("Flow at the cross-section", "veh/h", 0, "Flow"),
    "density": Measure("Density where vehicles are²", "veh/km/lane", 2, "Flow"),
    "high_flow": Measure("Flow, 95th percentile of cells²", "veh/h/lane", 0, "Flow"),
    "median_time_headway": Measure("Time headway, median", "s", 2, "Following"),
    "short_headways": Measure("Time headways below 1 s", "% of following time", 1, "Following"),
    "median_gap": Measure("Gap, median", "m", 1, "Following"),
    "conflicts_per_km": Measure("Conflicts, TTC < 3 s", "/veh-km", 3, "Safety"),
    "serious_conflicts_per_km": Measure("Serious conflicts, TTC < 1.5 s", "/veh-km", 3, "Safety"),
    "needed_brakings_per_km": Measure("DRAC > 3 m/s²", "/veh-km", 3, "Safety"),
    "short_pets": Measure("Following with PET < 1 s", "% of passages", 1, "Safety"),
    "short_lane_change_pets": Measure("Lane changes with PET < 1 s", "% of changes", 1, "Safety"),
    "collisions_per_1000km": Measure(
        "Collisions³", "/1000 veh-km", 1, "Safety", "collisions", "vehicle_km"
    ),
    "at_fault_per_1000km": Measure(
        "Collisions at fault³", "/1000 veh-km", 1, "Safety", "at_fault_collisions", "model_vehicle_km"
    ),
    "lane_changes_per_km": Measure("Lane changes", "/veh-km", 3, "Manoeuvres"),
    "hard_brakings_per_km": Measure("Hard braking, below −3 m/s²", "/veh-km", 3, "Manoeuvres"),
    "rms_jerk": Measure("Jerk, root mean square", "m/s³", 2, "Manoeuvres"),
    "fuel_per_km": Measure("Fuel⁴", "g/veh-km", 1, "Energy"),
    "co2_per_km": Measure("CO₂⁴", "g/veh-km", 1, "Energy"),
}  # fmt: skip


def measures(
    t: Trajectories,
    f: Following,
    cells: Cells,
    section: tuple[str, float],
    tables: Mapping[str, EmissionTable],
) -> dict[str, float]:
    """What the trajectories of one run say, by the names of `MEASURES`; NaN where nobody drove."""
    km = traffic.vehicle_km(t)
    begin, end = (float(t.time[0]), float(t.time[-1])) if len(t.time) else (0.0, 0.0)
    headways = surrogate_safety.time_headways(t, f)
    changes = np.minimum(*surrogate_safety.lane_change_pets(t))
    jerk = traffic.jerk(t)
    fuel, co2 = emitted(t, tables)

    def rate(amount: float) -> float:
        return amount / km if km else float("nan")

    return {
        "vehicle_km": km,
        "delay_per_km": rate(traffic.delay(t)),
        "mean_speed": traffic.mean_speed(t),
        "flow": traffic.flow(t, *section, begin, max(end, begin + 1.0)),
        "density": _mean(cells.density),
        "high_flow": float(np.percentile(cells.flow, 95)) if len(cells.flow) else float("nan"),
        "median_time_headway": _median(headways),
        "short_headways": 100.0 * _mean(headways < SHORT_HEADWAY),
        "median_gap": _median(surrogate_safety.moving_gaps(t, f)),
        "conflicts_per_km": rate(surrogate_safety.conflicts(t, f, surrogate_safety.CONFLICT)),
        "serious_conflicts_per_km": rate(surrogate_safety.conflicts(t, f, surrogate_safety.SERIOUS_CONFLICT)),
        "needed_brakings_per_km": rate(surrogate_safety.needed_brakings(t, f)),
        "short_pets": 100.0 * _mean(surrogate_safety.following_pets(t) < surrogate_safety.SHORT),
        "short_lane_change_pets": 100.0 * _mean(changes < surrogate_safety.SHORT),
        "lane_changes_per_km": rate(len(changes)),
        "hard_brakings_per_km": rate(traffic.hard_brakings(t)),
        "rms_jerk": float(np.sqrt(_mean(jerk**2))),
        "fuel_per_km": rate(1000.0 * fuel),
        "co2_per_km": rate(1000.0 * co2),
    }


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
