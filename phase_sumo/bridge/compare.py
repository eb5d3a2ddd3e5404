"""The same network, demand and seeds under several driver models, side by side."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from phase_sumo.bridge.choice import Choice
from phase_sumo.bridge.demand import sumo_model
from phase_sumo.bridge.drivers import Driver
from phase_sumo.bridge.network import read_network
from phase_sumo.bridge.options import read_scenario
from phase_sumo.bridge.processes import run_all
from phase_sumo.bridge.report import write_report
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.traffic import cross_section, measures
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.policy.checkpoint import load_policy

# measures in the order of the table: name -> (label, unit, digits)
TABLE = {
    "vehicles": ("Vehicles inserted", "", 0),
    "arrived_all": ("Vehicles arrived", "", 0),
    "removed": ("Vehicles taken out, see trips.csv", "", 0),
    "running": ("Vehicles still driving at the end", "", 0),
    "travel_time": ("Travel time¹", "s", 1),
    "mean_speed": ("Mean speed", "m/s", 2),
    "flow": ("Flow at the cross-section", "veh/h", 0),
    "collisions": ("Collisions (boxes touch)", "", 0),
    "collisions_per_1000km": ("Collisions", "/1000 veh-km", 1),
    "lane_changes_per_km": ("Lane changes", "/veh-km", 3),
    "hard_brakings_per_km": ("Hard braking, below −3 m/s²", "/veh-km", 3),
    "conflicts_per_km": ("Conflicts, TTC < 3 s", "/veh-km", 3),
    "serious_conflicts_per_km": ("Serious conflicts, TTC < 1.5 s", "/veh-km", 3),
    "median_time_headway": ("Median time headway", "s", 2),
    "mean_depart_delay": ("Insertion delay", "s", 2),
    "vehicle_km": ("Distance driven on the observed road", "veh-km", 1),
}
PHASE_TABLE = {
    "phase_vehicles": ("PHASE vehicles", "", 0),
    "phase_arrived_under_policy": ("… that the policy drove to their arrival", "", 0),
    "share_of_time_under_policy": ("Share of their time under the policy", "", 3),
    "phase_vehicle_km": ("Distance under the policy", "veh-km", 1),
    "phase_collisions": ("Collisions with a PHASE vehicle", "", 0),
    "phase_at_fault_collisions": ("… of them its fault", "", 0),
    "off_road": ("Contacts with the road edge", "", 0),
    "real_time_factor": ("Real-time factor", "×", 1),
    "policy_cpu_us_per_vehicle_step": ("Policy, CPU per vehicle and step", "µs", 0),
}


def compare(
    cfg: str | Path,
    models: Sequence[str] = ("phase", "idm"),
    *,
    out_dir: str | Path,
    seeds: int | Sequence[int] = 1,
    policy: Driver | str | Path | None = None,
    share: float | None = None,
    types: Sequence[str] | None = None,
    alpha: float | tuple[float, float] | None = None,
    explicit: Sequence[str] = (),
    deterministic: bool = False,
    roads: Literal["freeway", "all"] = "freeway",
    end: float | None = None,
    sumo_options: Sequence[str] = (),
    jobs: int = 1,
    progress: Callable[[float, str], None] | None = None,
) -> dict[str, Any]:
    """Run every model with every seed and write the comparison.

    Vehicles that SUMO drives in the PHASE run (share below 1, city roads) use the first SUMO model named, so
    that the runs differ in the PHASE vehicles only.

    Args:
        cfg: a ``.sumocfg``.
        models: ``"phase"`` and SUMO car-following models (``"idm"``, ``"krauss"``, ``"eidm"`` ...).
        out_dir: folder for ``comparison.json``, ``comparison.csv``, ``report.html`` and one folder per run.
        seeds: how many (1, 2, ...) or which.
        jobs: simulations at a time.
        progress: called with the fraction done and a line of text.
        policy, share, types, alpha, explicit, deterministic, roads, end, sumo_options: see `run_scenario`.

    Returns:
        scenario, models, seeds, section, ``runs`` (one dict per model and seed), ``summary`` (mean and std
        per model) and ``report``, the path of the HTML file.
    """
    models = list(dict.fromkeys(m.lower() for m in models))
    if not models:
        raise PhaseError("no models to compare; name some of phase, idm, krauss, eidm")
    for model in models:
        if model != "phase":
            sumo_model(model)
    numbers = list(range(1, seeds + 1)) if isinstance(seeds, int) else list(seeds)
    if not numbers:
        raise PhaseError("no seeds to run; pass at least 1")
    out = Path(out_dir)
    scenario = read_scenario(cfg, tuple(sumo_options))
    network = read_network(scenario.net, roads)
    for stale in ("comparison.json", "comparison.csv", "report.html"):
        (out / stale).unlink(missing_ok=True)
    background = next((m for m in models if m != "phase"), None)
    pairs = [(model, seed) for seed in numbers for model in models]
    tasks: list[dict[str, Any]] = [
        {
            "cfg": str(cfg),
            "policy": policy,
            "phase": model == "phase",
            "share": share,
            "explicit": tuple(explicit),
            "deterministic": deterministic,
            "types": tuple(types or ()),
            "alpha": alpha,
            "seed": seed,
            "model": background if model == "phase" else model,
            "roads": roads,
            "end": end,
            "sumo_options": tuple(sumo_options),
            "output_dir": str(out / f"{model}-seed{seed}"),
            "label": f"{model}, seed {seed}:",
        }
        for model, seed in pairs
    ]
    results = run_all(tasks, jobs, progress)
    runs = dict(zip(pairs, (Path(t["output_dir"]) for t in tasks), strict=True))
    trajectories = {pair: Trajectories.load(folder / "trajectories.npz") for pair, folder in runs.items()}
    if not any(len(t.time) for t in trajectories.values()):
        raise PhaseError(
            f"{cfg}: no vehicle drove on the observed roads; check the demand, or pass roads='all'"
        )
    section = cross_section(trajectories[pairs[-1]])
    rows = _rows(pairs, results, trajectories, section, _paired_travel_times(pairs, runs))
    comparison = {
        "scenario": str(cfg),
        "network": str(scenario.net),
        "roads": roads,
        "models": models,
        "seeds": numbers,
        "share": Choice(share, explicit=tuple(explicit)).probability,
        "types": list(types or ()),
        "alpha": list(alpha) if isinstance(alpha, tuple) else alpha,
        "policy": _policy_name(policy),
        "policy_info": _policy_info(policy) if "phase" in models else {},
        "background": background,
        "sumo_options": list(sumo_options),
        "section": {"edge": section[0], "position": section[1]},
        "runs": rows,
        "summary": {model: _summary([r for r in rows if r["model"] == model]) for model in models},
    }
    by_model = {m: [trajectories[m, s] for s in numbers] for m in models}
    write_report(out / "report.html", comparison, by_model, network)
    _write_csv(out / "comparison.csv", rows)
    comparison["report"] = str(out / "report.html")
    text = json.dumps(_without_nan(comparison), indent=1)
    (out / "comparison.json.part").write_text(text + "\n")
    (out / "comparison.json.part").replace(out / "comparison.json")
    return comparison


def _policy_name(policy: Driver | str | Path | None) -> str:
    if policy is None:
        return "shipped with phase_sumo"
    return str(policy) if isinstance(policy, str | Path) else type(policy).__name__


def _policy_info(policy: Driver | str | Path | None) -> dict[str, str]:
    """What the policy's file says about its training, one line each."""
    if policy is None or isinstance(policy, str | Path):
        policy = load_policy(policy)
    info = getattr(policy, "info", {})
    return {
        name.replace("_", " "): f"{value:,}" if isinstance(value, int) else str(value)
        for name, value in info.items()
        if isinstance(value, str | int | float)
    }


def _rows(pairs, results, trajectories, section, travel) -> list[dict[str, Any]]:
    rows = []
    for pair, result in zip(pairs, results, strict=True):
        t = trajectories[pair]
        begin = float(t.time[0]) if len(t.time) else 0.0
        last = float(t.time[-1]) if len(t.time) else 1.0
        row = {"model": pair[0], "seed": pair[1], **measures(t, section, begin, max(last, begin + 1.0))}
        kept = {
            k: v
            for k, v in result.items()
            if not isinstance(v, dict) and k not in ("scenario", "seed", "share")
        }
        row |= kept
        accounts = result["accounts"]
        row["arrived_all"], row["running"] = accounts["arrived"], accounts["running"]
        row["removed"] = sum(count for reason, count in accounts.items() if reason.startswith("removed"))
        row["travel_time"] = travel[pair]
        row["collisions_per_1000km"] = (
            1000.0 * result["collisions"] / row["vehicle_km"] if row["vehicle_km"] else 0.0
        )
        row["accounts"] = accounts
        rows.append(row)
    return rows


def _paired_travel_times(pairs, runs: dict[tuple[str, int], Path]) -> dict[tuple[str, int], float]:
    """Mean travel time in s over the vehicles that arrived under every model with that seed.

    Without the pairing a model that lets slow vehicles starve would look fast.
    """
    times = {pair: _travel_times(folder / "trips.csv") for pair, folder in runs.items()}
    result = {}
    for model, seed in pairs:
        common = set.intersection(*(set(v) for (_, s), v in times.items() if s == seed))
        values = [times[model, seed][v] for v in common]
        result[model, seed] = sum(values) / len(values) if values else math.nan
    return result


def _travel_times(path: Path) -> dict[str, float]:
    with path.open(newline="") as file:
        trips = list(csv.DictReader(file))
    return {t["vehicle"]: float(t["arrive"]) - float(t["depart"]) for t in trips if t["arrive"] != "nan"}


def _summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean and standard deviation over the seeds of every number."""
    summary = {}
    for name in {**TABLE, **PHASE_TABLE}:
        values = np.array([float(r[name]) for r in rows if r.get(name) is not None])
        values = values[np.isfinite(values)]
        mean = float(values.mean()) if len(values) else math.nan
        summary[name] = {"mean": mean, "std": float(values.std(ddof=1)) if len(values) > 1 else 0.0}
    return summary


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    names = ["model", "seed", *TABLE, *PHASE_TABLE]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
