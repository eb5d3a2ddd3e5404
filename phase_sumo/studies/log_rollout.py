"""The vehicles of a recorded window driven on in SUMO, by PHASE or by one of SUMO's models."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.drivers import Driver
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.live import PhaseFleet
from phase_sumo.bridge.sumo.conventions import angle_from_yaw
from phase_sumo.bridge.sumo.demand import sumo_model
from phase_sumo.bridge.sumo.options import SUMO_OPTIONS
from phase_sumo.bridge.sumo.session import Session, Simulation
from phase_sumo.logs.lane_matching import LanePlaces, lane_places
from phase_sumo.logs.recorded_roads import extended
from phase_sumo.logs.recording import PERIOD, Recording, Window
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.studies.log_scenario import Start, SumoRoad, start_of, write_demand, write_road

LANE_CHANGE = "4.6"  # s a lane change of SUMO's own vehicles takes, the mean of Toledo & Zohar (2007)
KEEP_ROUTE = 2  # moveToXY: exactly there
BACKGROUND = "idm"  # drives what PHASE cannot


def roll_out(
    window: Window,
    road: SumoRoad,
    places: LanePlaces,
    model: str,
    driver: Driver | None = None,
    seed: int = 0,
) -> Recording:
    """Tracks of a window's agents under a model, from the recorded places, speeds and directions on.

    Args:
        road: the recording's, with room beyond its ends.
        places: where the samples of the window's recording are on it.
        model: ``"phase"`` or a car-following model of SUMO.
        driver: the policy of ``"phase"``.
        seed: SUMO's, and of the action ranges alpha.

    Returns:
        The window's agents [N] over its steps + 1 samples, the first as recorded. A vehicle that left the
        simulation is absent from then on.
    """
    phase = model == "phase"
    start = start_of(window, road, places)
    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as temporary:
        folder = Path(temporary)
        demand = folder / "window.rou.xml"
        names = write_demand(window, start, sumo_model(BACKGROUND if phase else model), demand)
        args = ["-n", str(road.path), "-r", str(demand), "--step-length", f"{PERIOD:g}", "--seed", str(seed)]
        args += [*SUMO_OPTIONS, "--no-step-log", "true", "--no-warnings", "true", "--xml-validation", "never"]
        if not phase:
            args += ["--lanechange.duration", LANE_CHANGE]
        with Session(args, folder) as simulation:
            _place(simulation, names, start)
            if phase:
                fleet = PhaseFleet(simulation.api, driver, share=1.0, roads="all", guard=False, seed=seed)
                try:
                    samples = _drive(
                        simulation, fleet.scene, fleet.observe, fleet.drive, names, start, window.steps
                    )
                finally:
                    fleet.close()
            else:
                scene = Scene(simulation, None)
                samples = _drive(simulation, scene, scene.update, _nothing, names, start, window.steps)
    x, y, yaw, speed, there = (values.T for values in samples)
    return replace(window.recording, present=there > 0, x=x, y=y, yaw=yaw, speed=speed)


def _place(simulation: Simulation, names: list[str], start: Start) -> None:
    """Insert the vehicles, and tell SUMO where they are after its next step."""
    simulation.step()
    vehicle = simulation.api.vehicle
    angle = angle_from_yaw(start.yaw)
    for k, name in enumerate(names):
        vehicle.moveToXY(name, "", -1, start.x[k], start.y[k], float(angle[k]), KEEP_ROUTE, 10.0)


def _drive(
    simulation: Simulation,
    scene: Scene,
    observe: Callable[[], Any],
    drive: Callable[[], Any],
    names: list[str],
    start: Start,
    steps: int,
) -> np.ndarray:
    """[5, steps + 1, N] x, y, yaw of the box, speed, and whether the vehicle is there."""
    table = scene.table
    samples = np.full((5, steps + 1, len(names)), np.nan)
    for step in range(steps + 1):
        simulation.step()
        observe()
        if step == 0:
            _correct(simulation, table, names, start)
        rows = np.array([table.row_of.get(name, -1) for name in names])
        samples[:4, step, rows >= 0] = _poses(table, rows[rows >= 0])
        samples[4, step] = rows >= 0
        if step < steps:
            drive()
    return samples


def _nothing() -> None:
    """SUMO drives."""


def _correct(simulation: Simulation, table: VehicleTable, names: list[str], start: Start) -> None:
    """SUMO takes the way that vehicles were moved for their speed.

    Where traffic drives on the left, it also takes what is left of the lane's centre for right of it.
    """
    vehicle = simulation.api.vehicle
    for k, name in enumerate(names):
        row = table.row_of.get(name)
        if row is None:
            continue
        table["speed"][row], table["accel"][row], table["accel_history"][row] = start.speed[k], 0.0, 0.0
        if not table.controlled[row]:
            vehicle.setPreviousSpeed(name, float(start.speed[k]), 0.0)
            if start.left_hand:
                vehicle.setLateralLanePosition(name, -vehicle.getLateralLanePosition(name))


def _poses(table: VehicleTable, rows: np.ndarray) -> np.ndarray:
    """[4, n] centre of the line from the front bumper to the last end, its direction, and the speed."""
    a = {name: table[name][rows].astype(np.float64) for name in ("x", "y", "yaw", "hitch", "speed")}
    front_x, front_y = (values[rows] for values in table.front)
    trailer = table["trailer_length"][rows] > 0
    behind = np.where(
        trailer, table["trailer_length"][rows] - table["trailer_setback"][rows], table["rear_overhang"][rows]
    )
    yaw = a["yaw"] - np.where(trailer, a["hitch"], 0.0)
    back_x, back_y = a["x"] - behind * np.cos(yaw), a["y"] - behind * np.sin(yaw)
    along = np.arctan2(front_y - back_y, front_x - back_x)
    return np.stack((0.5 * (front_x + back_x), 0.5 * (front_y + back_y), along, a["speed"]))


BEFORE, ROOM = 60.0, 60.0  # m of road added before the recorded stretch, and after it beyond the farthest way
FASTEST = 45.0  # m/s


def roll_out_all(
    windows: Sequence[Window],
    models: Sequence[str],
    driver: Driver | None,
    seed: int,
    progress: Callable[[float, str], None],
) -> Iterator[tuple[Window, LaneNetwork, dict[str, Recording]]]:
    """Every window, its road with room beyond its ends, and its agents' tracks by model (see `roll_out`).

    Windows come road by road, since each is made once.
    """
    by_road: dict[int, list[Window]] = {}
    for window in windows:
        by_road.setdefault(id(window.recording.network), []).append(window)
    done = 0
    for of_road in by_road.values():
        after = ROOM + FASTEST * max(w.steps for w in of_road) * PERIOD
        road = extended(of_road[0].recording.network, BEFORE, after)
        with tempfile.TemporaryDirectory(prefix="phase_sumo_") as temporary:
            sumo = write_road(road, Path(temporary))
            for window in of_road:
                progress(done / len(windows), f"rollouts, {window.recording.name}")
                done += 1
                where = lane_places(window.recording, road)
                yield window, road, {m: roll_out(window, sumo, where, m, driver, seed) for m in models}
