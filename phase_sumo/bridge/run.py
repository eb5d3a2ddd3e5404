"""Run a SUMO scenario with or without PHASE vehicles."""

from __future__ import annotations

import json
import math
import tempfile
import time as clock
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from phase_sumo.bridge.check import check_scenario
from phase_sumo.bridge.drive_options import DriveOptions
from phase_sumo.bridge.fleet.event_log import write_events
from phase_sumo.bridge.fleet.scene import Trip
from phase_sumo.bridge.live import PhaseFleet
from phase_sumo.bridge.outputs.recorder import Recorder
from phase_sumo.bridge.outputs.sumo_outputs import OUTPUTS, SumoOutputs
from phase_sumo.bridge.sumo.demand import sumo_model
from phase_sumo.bridge.sumo.file_names import OURS
from phase_sumo.bridge.sumo.options import command, read_scenario
from phase_sumo.bridge.sumo.session import Session, Simulation
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.signals import held_signals

Progress = Callable[[float, str], None]
RECORD_PERIOD = 0.2  # s between recorded frames, or SUMO's step where that is longer


def run_scenario(
    cfg: str | Path | None,
    options: DriveOptions | None = None,
    *,
    output_dir: str | Path | None = None,
    record: bool = True,
    gui: bool = False,
    over_traci: bool = False,
    progress: Progress | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Run a scenario; PHASE drives a share of the vehicles on its freeway part.

    Args:
        cfg: a ``.sumocfg``; None when ``sumo_options`` name network and demand.
        options: see `DriveOptions`.
        output_dir: folder for SUMO's and our outputs: ``result.json``, ``events.csv``, ``trips.csv``,
            ``trajectories.npz``. None leaves SUMO's outputs where the scenario puts them, without ours.
        record: write trajectories (needs ``output_dir``).
        gui: show SUMO's window.
        over_traci: run SUMO in a process of its own, through TraCI instead of libsumo.
        progress: called with the fraction done and a line of text.
        changes: single options, e.g. ``share=0.3``, ``seed=1``.

    Returns:
        The command line's JSON: vehicles, phase_vehicles, arrived, phase_collisions,
        phase_at_fault_collisions, collisions_after_hand_back (of vehicles that SUMO has driven for 10 s at
        most, not among those of PHASE), off_road, phase_vehicle_km, sim_seconds, wall_seconds,
        real_time_factor,
        policy_cpu_us_per_vehicle_step, share_of_time_under_policy, share_of_freeway_time_under_policy (of the
        PHASE vehicles' time on ``roads``), accounts (inserted = arrived + running + removed by reason),
        warnings, check (see `Check`), and more of the kind.

    Raises:
        PhaseError: the scenario or an argument cannot be used.
    """
    drive = (options or DriveOptions()).changed(changes)
    scenario = read_scenario(cfg, tuple(drive.sumo_options))
    network = drive.network(scenario.net)
    check = check_scenario(cfg, drive, network)
    policy = drive.policy
    if drive.phase and (policy is None or isinstance(policy, str | Path)):
        policy = load_policy(policy)
    keep = nullcontext(str(output_dir)) if output_dir else tempfile.TemporaryDirectory(prefix="phase_sumo_")
    with keep as folder:
        work_dir = Path(folder)
        for stale in OURS if output_dir else ():  # a run that breaks off must not look like the last one
            (work_dir / stale).unlink(missing_ok=True)
        args = command(
            scenario,
            work_dir,
            model=sumo_model(drive.model) if drive.model else None,
            redirect_outputs=output_dir is not None,
            seed=drive.seed,
            end=drive.end,
        )
        stop = drive.end if drive.end is not None else scenario.end
        with ExitStack() as ended, Session(args, work_dir, gui, over_traci) as simulation:
            fleet = PhaseFleet(simulation.api, policy, options=drive, network=network)
            outputs = SumoOutputs(fleet.scene, [name for name in OUTPUTS if scenario.value(name)])
            ended.callback(outputs.settle)  # however the run ends
            period = max(RECORD_PERIOD, simulation.step_length)
            recorder = Recorder(simulation.api, period) if output_dir and record else None
            try:
                wall = _loop(simulation, fleet, outputs, stop, recorder, progress)
            finally:
                fleet.close()
                with suppress(
                    simulation.refused, simulation.failed
                ):  # a run that broke off may end in a step
                    outputs.update()
            trajectories = recorder.finish() if recorder else None
        report = fleet.report()
        report["warnings"] += [*scenario.warnings, *outputs.warnings]
        rate = report["sim_seconds"] / wall if wall else math.nan
        result = {"scenario": scenario.name, **report, "wall_seconds": wall, "real_time_factor": rate}
        result["check"] = check.to_json()
        if output_dir:
            write_events(work_dir / "events.csv", fleet.events)
            write_trips(work_dir / "trips.csv", fleet.scene.trips.values())
            if trajectories is not None:
                trajectories.save(work_dir / "trajectories.npz")
            text = json.dumps(result, indent=1)
            (work_dir / "result.json").write_text(text + "\n", encoding="utf-8")
    return result


def _loop(
    simulation: Simulation,
    fleet: PhaseFleet,
    outputs: SumoOutputs,
    stop: float | None,
    recorder: Recorder | None,
    progress: Progress | None,
) -> float:
    """Step until ``stop`` s, or until the demand is used up; returns the wall time in s."""
    started = shown = clock.perf_counter()
    begin = simulation.time
    with held_signals() as answer_signals:  # SUMO's files and ours end with the same step
        while True:
            simulation.step()
            fleet.observe()
            outputs.update()
            time = simulation.time
            if recorder and recorder.due(time):
                recorder.sample(time, fleet.scene.table, fleet.scene.types)
            if simulation.used_up or (stop is not None and time >= stop - 1e-6):
                break  # a pose that SUMO never steps to would crash libsumo's next simulation
            fleet.drive()
            answer_signals()
            now = clock.perf_counter()
            if progress and now - shown > 0.2:
                shown = now
                progress(_fraction(fleet, begin, stop), _line(fleet))
    if progress:
        progress(1.0, _line(fleet))
    return clock.perf_counter() - started


def _fraction(fleet: PhaseFleet, begin: float, stop: float | None) -> float:
    if stop is not None:
        return (fleet.simulation.time - begin) / max(stop - begin, 1e-6)
    left = fleet.simulation.api.simulation.getMinExpectedNumber()
    return 1.0 - left / max(left + len(fleet.scene.trips) - len(fleet.scene.facts), 1)


def _line(fleet: PhaseFleet) -> str:
    return (
        f"{fleet.simulation.time:.0f} s: {len(fleet.scene.facts)} vehicles, {fleet.driven} PHASE, "
        f"{len(fleet.scene.events.of('collision'))} contacts"
    )


def write_trips(path: Path, trips: Any) -> None:
    """One CSV line per inserted vehicle."""
    lines = [",".join(f.name for f in fields(Trip))]
    for trip in trips:
        cells = asdict(trip).values()
        lines.append(
            ",".join(
                str(int(c)) if isinstance(c, bool) else f"{c:g}" if isinstance(c, float) else f'"{c}"'
                for c in cells
            )
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
