"""What is wrong with recorded tracks, by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.logs.lane_places import LanePlaces, lane_places
from phase_sumo.evaluate.logs.recording import PERIOD, Recording
from phase_sumo.evaluate.logs.sampling import chords, runs
from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.near import pairs_within

FloatArray = NDArray[np.float64]
ENTRY = 40.0  # m from an open end of the road within which vehicles may appear and vanish
BRIEF = 1.0  # s
RESTING = 1.0  # m
FASTEST = 70.0  # m/s
STEP = 5.0  # m/s that the way from one sample to the next may differ from the speed
HARDEST = 10.0  # m/s^2, over one second: emergency braking
FLAGS = {
    "breaks": f"appears or vanishes more than {ENTRY:g} m from where the road is open, or in between",
    "overlaps": "its box overlaps another vehicle's at some time",
    "jumps": f"faster than {FASTEST:g} m/s, more than {HARDEST:g} m/s² over a second, or moves "
    f"{STEP:g} m/s off its speed",
    "off_road": "its centre is beside the road at some time",
    "against": "drives against its lane at some time",
    "stands": f"does not move {RESTING:g} m in all",
    "brief": f"seen for less than {BRIEF:g} s",
}
# medians outside of these are no road traffic but another unit
LENGTHS = 2.5, 14.0  # m
SPEEDS = 0.8, 1.25  # recorded speed over that of the positions


def finished(recording: Recording, path: Path) -> Recording:
    """The recording with `FLAGS` on its tracks: the last step of every reader.

    Raises:
        PhaseError: lengths or speeds suggest other units than metres and seconds.
    """
    _check_units(recording, path)
    places = lane_places(recording)
    found = {
        "breaks": _breaks(recording),
        "overlaps": _overlaps(recording),
        "jumps": _jumps(recording),
        "off_road": (recording.present & (places.lane < 0)).any(1),
        "against": _against(recording, places),
        "stands": _stands(recording),
        "brief": recording.present.sum(1) * PERIOD < BRIEF,
    }
    vehicles = range(len(recording.length))
    return replace(
        recording, flags=tuple(frozenset(n for n, bad in found.items() if bad[v]) for v in vehicles)
    )


def _check_units(recording: Recording, path: Path) -> None:
    length = float(np.median(recording.length))
    if not LENGTHS[0] <= length <= LENGTHS[1]:
        raise PhaseError(
            f"{path}: {recording.name}: the median vehicle is {length:.1f} m long; lengths must be in metres "
            "(1 ft = 0.3048 m)"
        )
    dx, dy, time = chords(recording.x, recording.y, recording.present, 5)
    moves = recording.present & (np.nan_to_num(np.hypot(dx, dy)) > 2.0)
    if moves.any():
        implied = float(np.median(np.hypot(dx, dy)[moves] / time[moves]))
        speed = float(np.median(recording.speed[moves]))
        if not SPEEDS[0] <= speed / implied <= SPEEDS[1]:
            raise PhaseError(
                f"{path}: {recording.name}: speeds are {speed / implied:.2f} times those of the positions "
                f"({speed:.1f} against {implied:.1f} m/s); both must be in metres and seconds "
                "(1 km/h = 0.278 m/s, 1 mph = 0.447 m/s, 1 ft = 0.3048 m)"
            )


def _breaks(recording: Recording) -> NDArray[np.bool_]:
    row, first, last = runs(recording.present)
    after = {a for a, _ in recording.network.successors}
    before = {b for _, b in recording.network.successors}
    lanes = recording.network.lanes
    entries = [lane.points[0] for i, lane in enumerate(lanes) if i not in before and not lane.dead_start]
    exits = [lane.points[-1] for i, lane in enumerate(lanes) if i not in after and not lane.dead_end]
    x, y, end = recording.x, recording.y, recording.present.shape[1] - 1
    appears = (first > 0) & _far(x[row, first], y[row, first], entries)
    vanishes = (last < end) & _far(x[row, last], y[row, last], exits)
    result = np.bincount(row, minlength=len(x)) > 1
    result[row[appears | vanishes]] = True
    return result


def _far(x: FloatArray, y: FloatArray, places: list[FloatArray]) -> NDArray[np.bool_]:
    if not places:
        return np.ones(len(x), np.bool_)
    at = np.array(places)
    return np.hypot(x[:, None] - at[:, 0], y[:, None] - at[:, 1]).min(1) > ENTRY


def _overlaps(recording: Recording) -> NDArray[np.bool_]:
    """By a separating-axis test of all boxes that are close at the same time."""
    result = np.zeros(len(recording.length), np.bool_)
    reach = 0.5 * np.hypot(recording.length, recording.width)
    # long vehicles are few: pairs of others need not be looked for as far as theirs
    usual = float(np.quantile(reach, 0.9))
    for t in np.flatnonzero(recording.present.sum(0) > 1):
        here = np.flatnonzero(recording.present[:, t])
        xy = np.stack((recording.x[here, t], recording.y[here, t]), -1)
        long = np.flatnonzero(reach[here] > usual)
        pairs = (
            pairs_within(xy, xy, 2.0 * usual),
            pairs_within(xy[long], xy, float(reach[here].max() + reach[here][long].max(initial=0.0))),
        )
        a = np.concatenate((pairs[0][0], long[pairs[1][0]]))
        b = np.concatenate((pairs[0][1], pairs[1][1]))
        a, b = here[a[a != b]], here[b[a != b]]
        hit = boxes_overlap(_boxes(recording, a, t), _boxes(recording, b, t)).numpy()
        result[a[hit]] = result[b[hit]] = True
    return result


def _boxes(recording: Recording, rows: NDArray[np.int64], t: int) -> torch.Tensor:
    """[6, P] as in `phase_sumo.sim.geometry`."""
    yaw = recording.yaw[rows, t]
    return torch.from_numpy(
        np.stack(
            (
                recording.x[rows, t],
                recording.y[rows, t],
                np.cos(yaw),
                np.sin(yaw),
                0.5 * recording.length[rows],
                0.5 * recording.width[rows],
            )
        )
    )


def _jumps(recording: Recording) -> NDArray[np.bool_]:
    speed, step = recording.speed, round(1.0 / PERIOD)
    moved = np.hypot(np.diff(recording.x, axis=1), np.diff(recording.y, axis=1)) / PERIOD
    off = np.abs(moved - 0.5 * (speed[:, 1:] + speed[:, :-1])) > STEP
    hard = np.abs(speed[:, step:] - speed[:, :-step]) > HARDEST * step * PERIOD
    return (speed > FASTEST).any(1) | off.any(1) | hard.any(1)


def _against(recording: Recording, places: LanePlaces) -> NDArray[np.bool_]:
    return (np.cos(recording.yaw - places.yaw) < 0.0).any(1)


def _stands(recording: Recording) -> NDArray[np.bool_]:
    present = recording.present

    def extent(values: FloatArray) -> FloatArray:
        return np.where(present, values, -np.inf).max(1) - np.where(present, values, np.inf).min(1)

    return np.hypot(extent(recording.x), extent(recording.y)) < RESTING
