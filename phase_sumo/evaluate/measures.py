"""All traffic measures of one run by name, and what the tables say about each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phase_sumo.evaluate import encroachment, following, traffic
from phase_sumo.evaluate.edie import Cells
from phase_sumo.evaluate.emissions import EmissionTable, emitted
from phase_sumo.evaluate.following import Following
from phase_sumo.evaluate.trajectories import Trajectories

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
    headways = following.time_headways(t, f)
    changes = np.minimum(*encroachment.lane_change_pets(t))
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
        "median_gap": _median(following.moving_gaps(t, f)),
        "conflicts_per_km": rate(following.conflicts(t, f, following.CONFLICT)),
        "serious_conflicts_per_km": rate(following.conflicts(t, f, following.SERIOUS_CONFLICT)),
        "needed_brakings_per_km": rate(following.needed_brakings(t, f)),
        "short_pets": 100.0 * _mean(encroachment.following_pets(t) < encroachment.SHORT),
        "short_lane_change_pets": 100.0 * _mean(changes < encroachment.SHORT),
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
