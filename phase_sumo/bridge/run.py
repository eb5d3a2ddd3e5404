"""Run a SUMO scenario with or without PHASE vehicles."""

from __future__ import annotations

import json
import math
import tempfile
import time as clock
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

from phase_sumo.bridge.choice import Choice
from phase_sumo.bridge.contacts import ContactMonitor
from phase_sumo.bridge.controller import Driver
from phase_sumo.bridge.demand import sumo_model
from phase_sumo.bridge.event_log import write_events
from phase_sumo.bridge.fleet import Fleet
from phase_sumo.bridge.network import read_network
from phase_sumo.bridge.options import SumoScenario, command, read_scenario
from phase_sumo.bridge.recorder import Recorder
from phase_sumo.bridge.scene import Scene, Trip
from phase_sumo.bridge.session import Session
from phase_sumo.bridge.sumo_outputs import OUTPUTS, SumoOutputs
from phase_sumo.bridge.trailers import Trailers
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.lanes import LaneNetwork

Progress = Callable[[float, str], None]
RECORD_PERIOD = 0.2  # s between recorded frames, or SUMO's step where that is longer


def run_scenario(
    cfg: str | Path,
    *,
    policy: Driver | str | Path | None = None,
    share: float = 1.0,
    types: Sequence[str] | None = None,
    alpha: float | tuple[float, float] | None = None,
    seed: int | None = None,
    model: str | None = None,
    roads: Literal["freeway", "all"] = "freeway",
    end: float | None = None,
    gui: bool = False,
    sumo_options: Sequence[str] = (),
    output_dir: str | Path | None = None,
    record: bool = True,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run a scenario; PHASE drives a share of the vehicles on its freeway part.

    Args:
        cfg: a ``.sumocfg``.
        policy: a loaded policy or its file; None loads the shipped one.
        share: of the vehicles that PHASE may drive, 0..1; the same seed and id always decide alike, and a
            larger share adds vehicles to those of a smaller one. 0 is plain SUMO.
        types: vTypes that PHASE may drive; empty for all that it can.
        alpha: longitudinal action range of every vehicle, or bounds to draw it from (see `Choice`).
        seed: SUMO's and ours; None keeps the scenario's for SUMO and takes 0 for us.
        model: SUMO car-following model (``"idm"``, ``"krauss"`` ...) for all vehicles that SUMO drives; None
            leaves what the scenario says.
        roads: ``"freeway"`` observes and drives motorways and ramps only, ``"all"`` every road.
        end: stop at this time in s instead of the scenario's end.
        gui: show SUMO's window.
        sumo_options: further SUMO options, e.g. ``["--fcd-output", "fcd.xml"]``.
        output_dir: folder for SUMO's and our outputs: ``result.json``, ``events.csv``, ``trips.csv``,
            ``trajectories.npz``. None leaves SUMO's outputs where the scenario puts them, without ours.
        record: write trajectories (needs ``output_dir``).
        progress: called with the fraction done and a line of text.

    Returns:
        The command line's JSON: vehicles, phase_vehicles, arrived, phase_collisions,
        phase_at_fault_collisions, off_road, phase_vehicle_km, sim_seconds, wall_seconds, real_time_factor,
        policy_cpu_us_per_vehicle_step, share_of_time_under_policy, accounts (inserted = arrived + running +
        removed by reason), warnings, and more of the kind.

    Raises:
        PhaseError: the scenario or an argument cannot be used.
    """
    if not 0.0 <= share <= 1.0:
        raise PhaseError(f"share {share:g} is not between 0 and 1")
    scenario = read_scenario(cfg, tuple(sumo_options))
    network = read_network(scenario.net, roads)
    driver: Driver | None = None
    if share > 0:
        driver = load_policy(policy) if policy is None or isinstance(policy, str | Path) else policy
    choice = Choice(share=share, types=tuple(types or ()), alpha=alpha, seed=seed or 0)
    keep = nullcontext(str(output_dir)) if output_dir else tempfile.TemporaryDirectory(prefix="phase_sumo_")
    with keep as folder:
        work_dir = Path(folder)
        args = command(
            scenario,
            work_dir,
            model=sumo_model(model) if model else None,
            redirect_outputs=output_dir is not None,
            seed=seed,
            end=end,
        )
        stop = end if end is not None else scenario.end
        with Session(args, work_dir, gui) as session:
            run = _Run(session, scenario, network, driver, choice)
            recorder = (
                Recorder(session.api, max(RECORD_PERIOD, session.step_length))
                if output_dir and record
                else None
            )
            run.loop(stop, recorder, progress)
            trajectories = recorder.finish() if recorder else None
        run.outputs.settle()
        result = run.result()
        if output_dir:
            write_events(work_dir / "events.csv", run.scene.events.events)
            write_trips(work_dir / "trips.csv", run.scene.trips.values())
            if trajectories is not None:
                trajectories.save(work_dir / "trajectories.npz")
            (work_dir / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    return result


class _Run:
    """The loop over SUMO's steps and what it counts."""

    def __init__(
        self,
        session: Session,
        scenario: SumoScenario,
        network: LaneNetwork,
        driver: Driver | None,
        choice: Choice,
    ) -> None:
        self.session = session
        self.scenario = scenario
        self.choice = choice
        edges = frozenset(lane.edge for lane in network.lanes if not lane.connector)
        self.scene = Scene(session, edges)
        self.monitor = ContactMonitor(self.scene.events)
        hitch = "phase.hitch" in scenario.value("fcd-output.params")
        self.fleet = Fleet(self.scene, network, driver, choice, hitch) if driver else None
        self.outputs = SumoOutputs(self.scene, [name for name in OUTPUTS if scenario.value(name)])
        self.trailers = Trailers(session.api, self.scene.table) if session.gui else None
        self.begin = self.end = session.time
        self.waiting = 0
        self.wall = 0.0

    def loop(self, stop: float | None, recorder: Recorder | None, progress: Progress | None) -> None:
        """Step until ``stop`` s, or until the demand is used up."""
        started = shown = clock.perf_counter()
        simulation = self.session.api.simulation
        if self.fleet:
            self.fleet.check_step(self.session.step_length)
            self.fleet.check_calibrators()
        while True:
            self.session.step(self.fleet.publish_motion if self.fleet else None)
            time = self.session.time
            self.scene.update()
            if self.fleet:
                self.fleet.follow_sumo(time)
            self.monitor.update(self.scene.table, time, self.scene.types)
            self.outputs.update()
            if self.trailers:
                self.trailers.update()
            if recorder and recorder.due(time):
                recorder.sample(time, self.scene.table, self.scene.types)
            if simulation.getMinExpectedNumber() == 0 or (stop is not None and time >= stop - 1e-6):
                break  # a pose that SUMO never steps to would crash libsumo's next simulation
            if self.fleet:
                self.fleet.drive(time)
            now = clock.perf_counter()
            if progress and now - shown > 0.2:
                shown = now
                progress(self._fraction(time, stop), self._line(time))
        self.wall = clock.perf_counter() - started
        self.end = self.session.time
        self.waiting = len(simulation.getPendingVehicles())
        if progress:
            progress(1.0, self._line(self.session.time))

    def _fraction(self, time: float, stop: float | None) -> float:
        if stop is not None:
            return (time - self.begin) / max(stop - self.begin, 1e-6)
        left = self.session.api.simulation.getMinExpectedNumber()
        return 1.0 - left / max(left + len(self.scene.trips) - len(self.scene.facts), 1)

    def _line(self, time: float) -> str:
        phase, contacts = int(self.scene.table.controlled.sum()), len(self.scene.events.of("collision"))
        return f"{time:.0f} s: {len(self.scene.facts)} vehicles, {phase} PHASE, {contacts} contacts"

    def result(self) -> dict[str, Any]:
        """What the run counts, by the names of the command line's JSON."""
        trips = list(self.scene.trips.values())
        phase = [t for t in trips if t.adopted]
        collisions = self.scene.events.of("collision")
        sim_seconds = self.end - self.begin
        accounts = self.scene.accounts()
        travel = [t.arrive - t.depart for t in trips if math.isfinite(t.arrive)]
        result: dict[str, Any] = {
            "scenario": str(self.scenario.path),
            "share": self.choice.share,
            "seed": self.choice.seed,
            "vehicles": len(trips),
            "phase_vehicles": len(phase),
            "arrived": sum(math.isfinite(t.arrive) for t in phase) if self.fleet else accounts["arrived"],
            "collisions": len(collisions),
            "phase_collisions": sum(c.with_phase for c in collisions),
            "phase_at_fault_collisions": sum(c.phase_at_fault for c in collisions),
            "off_road": len(self.scene.events.of("road edge")),
            "phase_vehicle_km": sum(t.policy_metres for t in trips) / 1000.0,
            "sim_seconds": sim_seconds,
            "wall_seconds": self.wall,
            "real_time_factor": sim_seconds / self.wall if self.wall else float("nan"),
            "policy_cpu_us_per_vehicle_step": self.fleet.cpu_per_decision if self.fleet else 0.0,
            "share_of_time_under_policy": _ratio(
                sum(t.policy_seconds for t in phase), sum(t.seconds for t in phase)
            ),
            "phase_arrived_under_policy": sum(t.finished for t in phase),
            "mean_travel_time": sum(travel) / len(travel) if travel else None,
            "mean_depart_delay": sum(t.delay for t in trips) / len(trips) if trips else None,
            "waiting_for_insertion": self.waiting,
            "accounts": accounts,
            "accounts_balance": accounts["inserted"]
            == sum(v for k, v in accounts.items() if k != "inserted"),
        }
        result["warnings"] = self._warnings(trips) + self.outputs.warnings
        if self.fleet:
            result["fleet"] = self.fleet.report()
        return result

    def _warnings(self, trips: list[Trip]) -> list[str]:
        seen = {t.type for t in trips}
        found = [f"no vehicle of type {t!r} was inserted" for t in self.choice.types if t not in seen]
        if self.fleet and not any(t.adopted for t in trips):
            found.append("no vehicle was driven by PHASE: check share, types and roads")
        return found


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else 0.0


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
    path.write_text("\n".join(lines) + "\n")
