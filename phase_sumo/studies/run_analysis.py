"""One run's folder turned into measures, distributions and collisions."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.event_log import read_events
from phase_sumo.bridge.sumo.emission_tables import emission_tables
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.measures import MEASURES, Measure, curves, measures
from phase_sumo.evaluate.surrogate_safety import following
from phase_sumo.evaluate.traffic import (
    Cells,
    Corridor,
    cross_section,
    edie_cells,
    find_corridor,
    speed_profile,
)
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.studies.driver_models import Model


def read_collisions(path: Path) -> list[dict[str, Any]]:
    """The fields of `Event` of every collision."""
    return [asdict(event) for event in read_events(path) if event.kind == "collision"]


def at_fault(collision: dict[str, Any], phase: bool) -> bool:
    """Whether a vehicle under PHASE (or, with ``phase`` False, under SUMO) is to blame."""
    return (collision["fault"] and collision["phase"] == phase) or (
        collision["other_fault"] and collision["other_phase"] == phase
    )


PHASE_MEASURES = {
    "phase_vehicles": Measure("PHASE vehicles", "", 0, "PHASE vehicles"),
    "phase_arrived_under_policy": Measure("… driven to their arrival by the policy", "", 0, "PHASE vehicles"),
    "share_of_time_under_policy": Measure("Share of their time under the policy", "", 3, "PHASE vehicles"),
    "share_of_freeway_time_under_policy": Measure("… of that on freeways", "", 3, "PHASE vehicles"),
    "phase_vehicle_km": Measure("Distance under the policy", "veh-km", 1, "PHASE vehicles"),
    "phase_collisions": Measure("Collisions with a PHASE vehicle", "", 0, "PHASE vehicles"),
    "phase_at_fault_collisions": Measure("… of them its fault", "", 0, "PHASE vehicles"),
    "collisions_after_hand_back": Measure(
        "Collisions of others, 10 s after the policy gave one back", "", 0, "PHASE vehicles"
    ),
    "off_road": Measure("Contacts with the road edge", "", 0, "PHASE vehicles"),
    "guard_share_of_decisions": Measure("Share of decisions that the guard changed", "", 4, "PHASE vehicles"),
    "guard_leader": Measure("… decisions, because of a leader", "", 0, "PHASE vehicles"),
    "guard_standing": Measure("… of one that stands", "", 0, "PHASE vehicles"),
    "guard_beside": Measure("… of somebody beside", "", 0, "PHASE vehicles"),
    "guard_road_edge": Measure("… of the road's edge or a curve", "", 0, "PHASE vehicles"),
    "guard_unsafe": Measure("… in which nothing was safe", "", 0, "PHASE vehicles"),
    "guard_seconds": Measure("… their time", "s", 1, "PHASE vehicles"),
    "guard_jerk": Measure("… their jerk beside what was wanted", "m/s²", 1, "PHASE vehicles"),
    "real_time_factor": Measure("Real-time factor of the run", "×", 1, "PHASE vehicles"),
    "policy_cpu_us_per_vehicle_step": Measure(
        "Policy, CPU per vehicle and step", "µs", 0, "PHASE vehicles"
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Places:
    """Where all runs are measured alike.

    Attributes:
        section: edge and position in m at which flow is counted.
        corridor: the busiest way through the network.
    """

    section: tuple[str, float]
    corridor: Corridor


@dataclass(frozen=True)
class Analysis:
    """What the report needs of one run, without its trajectories.

    Attributes:
        row: measures by name, accounts, model and seed.
        curves: counts per distribution.
        cells: of the fundamental diagram.
        profile: [N] mean speed in m/s along the corridor, at [N] m.
        collisions: see `read_collisions`.
        travel_times: s by vehicle that arrived.
    """

    row: dict[str, Any]
    curves: dict[str, np.ndarray]
    cells: Cells
    profile: tuple[np.ndarray, np.ndarray]
    collisions: list[dict[str, Any]]
    travel_times: dict[str, float]


def choose_places(folders: list[Path]) -> Places:
    """From the first of the runs in which somebody drove on the observed roads.

    Raises:
        PhaseError: nobody did in any.
    """
    for folder in folders:
        t = load(folder)
        if len(t.time):
            return Places(cross_section(t), find_corridor(t))
    raise PhaseError("no vehicle drove on the observed roads; check the demand, or pass roads='all'")


def load(folder: Path) -> Trajectories:
    """The trajectories of a run."""
    return Trajectories.load(folder / "trajectories.npz")


def analyse(folder: Path, model: Model, seed: int, places: Places) -> Analysis:
    """Read and measure one run."""
    t = load(folder)
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    f, cells = following(t), edie_cells(t)
    collisions = read_collisions(folder / "events.csv")
    row: dict[str, Any] = {"model": model.name, "seed": seed}
    row |= {k: v for k, v in result.items() if not isinstance(v, dict) and k not in ("seed", "share")}
    row |= measures(t, f, cells, places.section, emission_tables(t.emission_classes))
    accounts = result["accounts"]
    row["arrived_all"], row["running"] = accounts["arrived"], accounts["running"]
    row["removed"] = sum(count for reason, count in accounts.items() if reason.startswith("removed"))
    row["model_vehicle_km"] = result["phase_vehicle_km"] if model.phase else row["vehicle_km"]
    row["at_fault_collisions"] = sum(at_fault(c, model.phase) for c in collisions)
    for name in ("collisions_per_1000km", "at_fault_per_1000km"):
        measure = MEASURES[name]
        km = row[measure.exposure]
        row[name] = 1000.0 * row[measure.count] / km if km else None
    row["accounts"] = accounts
    return Analysis(
        row=row,
        curves=curves(t, f),
        cells=cells,
        profile=speed_profile(t, places.corridor),
        collisions=collisions,
        travel_times=_travel_times(folder / "trips.csv"),
    )


def pair_travel_times(runs: Mapping[tuple[str, int], Analysis]) -> None:
    """Set each run's mean travel time in s, over the vehicles that arrived under every model with its seed.

    Without the pairing a model that lets slow vehicles starve would look fast.
    """
    for (_, seed), run in runs.items():
        alike = [set(r.travel_times) for (_, s), r in runs.items() if s == seed]
        values = [run.travel_times[v] for v in sorted(set.intersection(*alike))]
        run.row["travel_time"] = sum(values) / len(values) if values else None
        run.row["travel_time_vehicles"] = len(values)


def _travel_times(path: Path) -> dict[str, float]:
    with path.open(newline="", encoding="utf-8") as file:
        trips = list(csv.DictReader(file))
    return {
        t["vehicle"]: float(t["arrive"]) - float(t["depart"]) for t in trips if t["arrive"] not in ("", "nan")
    }
