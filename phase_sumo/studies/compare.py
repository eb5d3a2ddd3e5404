"""The same network, demand and seeds under several driver models, side by side."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phase_sumo.atomic_files import write_whole
from phase_sumo.bridge.check import check_scenario
from phase_sumo.bridge.drive_options import DriveOptions
from phase_sumo.bridge.fleet.drivers import Driver
from phase_sumo.bridge.sumo.options import read_scenario
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.measures import MEASURES
from phase_sumo.evaluate.statistics import CONFIDENCE, summarise
from phase_sumo.evaluate.traffic import Corridor
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.studies.driver_models import parse_models
from phase_sumo.studies.processes import run_all
from phase_sumo.studies.run_analysis import (
    PHASE_MEASURES,
    Analysis,
    analyse,
    choose_places,
    load,
    pair_travel_times,
)

# (path, comparison, runs by model, first trajectories by model, network, corridor), see `write_report`
WriteReport = Callable[
    [
        Path,
        dict[str, Any],
        Mapping[str, Sequence[Analysis]],
        Mapping[str, Trajectories],
        LaneNetwork,
        Corridor,
    ],
    None,
]
OUTPUTS = ("comparison.json", "comparison.csv", "summary.csv", "report.html")
ALL_MEASURES = MEASURES | PHASE_MEASURES


def compare(
    cfg: str | Path | None,
    models: Sequence[str] = ("phase", "idm"),
    *,
    out_dir: str | Path,
    seeds: int | Sequence[int] = 1,
    options: DriveOptions | None = None,
    jobs: int | None = None,
    write_report: WriteReport | None = None,
    progress: Callable[[float, str], None] | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Run every model with every seed and write the comparison.

    Args:
        cfg: a ``.sumocfg``.
        models: ``"phase"``, ``"phase:0.3"`` (30 % PHASE) and SUMO car-following models (``"idm"``,
            ``"krauss"``, ``"eidm"`` ...), see `parse_models`. Differences are to the first SUMO model.
        out_dir: folder for ``comparison.json``, ``comparison.csv`` (one row per run), ``summary.csv`` (one
            per model and measure), ``report.html`` and one folder per run.
        seeds: how many (1, 2, ...) or which.
        options: see `DriveOptions`; its share is that of plain ``"phase"``, its model and seed do not count.
        jobs: simulations at a time; None for as many as there are cores.
        write_report: writes ``report.html``; None for no page.
        progress: called with the fraction done and a line of text.
        changes: single options, e.g. ``end=600.0``.

    Returns:
        scenario, models, seeds, reference, section, ``runs`` (one dict per model and seed), ``summary`` (per
        model and measure, see `summarise`), ``collisions`` and ``report``, the path of the page, if
        one is written.
    """
    drive = (options or DriveOptions()).changed(changes)
    chosen = parse_models(models, drive.share)
    numbers = list(range(1, seeds + 1)) if isinstance(seeds, int) else list(dict.fromkeys(seeds))
    if not numbers:
        raise PhaseError("no seeds to run; pass at least 1")
    if jobs is not None and jobs < 1:
        raise PhaseError(f"jobs {jobs} is less than 1; leave it out for one per core")
    out = Path(out_dir)
    scenario = read_scenario(cfg, tuple(drive.sumo_options))
    network = drive.network(scenario.net)
    check = check_scenario(cfg, replace(drive, seed=numbers[0]), network)
    network = network.moved(*network.origin)  # as the vehicles' positions
    for stale in OUTPUTS:
        (out / stale).unlink(missing_ok=True)
    pairs = [(model, seed) for seed in numbers for model in chosen]
    folders = [out / f"{model.folder}-seed{seed}" for model, seed in pairs]
    run_all(
        [
            {
                "cfg": cfg,
                "options": replace(drive, phase=model.phase, share=model.share, model=model.sumo, seed=seed),
                "output_dir": str(folder),
                "label": f"{model.name}, seed {seed}:",
            }
            for (model, seed), folder in zip(pairs, folders, strict=True)
        ],
        jobs or len(os.sched_getaffinity(0)),
        progress,
    )
    places = choose_places(folders[: len(chosen)][::-1])  # of the first seed
    runs = {
        (model.name, seed): analyse(folder, model, seed, places)
        for (model, seed), folder in zip(pairs, folders, strict=True)
    }
    pair_travel_times(runs)
    by_model = {model.name: [runs[model.name, seed] for seed in numbers] for model in chosen}
    rows = {name: [run.row for run in of_model] for name, of_model in by_model.items()}
    reference = chosen[0].sumo
    comparison = {
        "scenario": scenario.name,
        "network": str(scenario.net),
        "roads": drive.roads,
        "models": [model.name for model in chosen],
        "seeds": numbers,
        "share": drive.choice(0).probability,
        "types": list(drive.types or ()),
        "alpha": list(drive.alpha) if isinstance(drive.alpha, tuple) else drive.alpha,
        "time_gap": drive.time_gap,
        "guard": drive.guard,
        "policy": _policy_name(drive.policy),
        "policy_info": _policy_info(drive.policy) if any(model.phase for model in chosen) else {},
        "background": reference,
        "reference": reference,
        "confidence": CONFIDENCE,
        "sumo_options": list(drive.sumo_options),
        "section": {"edge": places.section[0], "position": places.section[1]},
        "check": check.to_json(),
        "runs": [run.row for run in runs.values()],
        "summary": {
            name: summarise(
                of_model, rows[reference] if reference and name != reference else None, ALL_MEASURES
            )
            for name, of_model in rows.items()
        },
        "collisions": [
            {"model": name, "seed": seed, **c} for (name, seed), run in runs.items() for c in run.collisions
        ],
    }
    if write_report:
        first = {model.name: load(folder) for model, folder in zip(chosen, folders, strict=False)}
        write_report(out / "report.html", comparison, by_model, first, network, places.corridor)
    _write_runs(out / "comparison.csv", comparison["runs"])
    _write_summary(out / "summary.csv", comparison["summary"])
    if write_report:
        comparison["report"] = str(out / "report.html")
    text = json.dumps(_without_nan(comparison), indent=1)
    write_whole(out / "comparison.json", (text + "\n").encode())
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


def _write_runs(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    counts = [name for m in MEASURES.values() if m.count for name in (m.count, m.exposure)]
    names = ["model", "seed", *dict.fromkeys([*ALL_MEASURES, *counts])]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(row.get(name)) for name in names} for row in rows)


def _write_summary(path: Path, summary: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    """One line per model and measure; empty cells where there is no interval or no difference."""
    names = ("mean", "low", "high", "n")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        head = ("model", "measure", "unit", *names, "interval", *(f"difference_{n}" for n in names))
        writer.writerow(head)
        for model, measures in summary.items():
            for name, value in measures.items():
                difference = value["difference"] or {}
                cells = [value[n] for n in names] + [value["interval"]] + [difference.get(n) for n in names]
                writer.writerow([model, name, ALL_MEASURES[name].unit, *map(_cell, cells)])


def _cell(value: Any) -> Any:
    if isinstance(value, float | np.floating):
        return f"{value:.8g}" if math.isfinite(value) else ""
    return "" if value is None else value


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
