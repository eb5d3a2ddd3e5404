"""Scenario windows: pieces of a recording that start with the vehicles then on the road.

What is wrong with recorded tracks is flagged by name; windows leave flagged vehicles out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray
from phase_sumo.errors import PhaseError
from phase_sumo.logs.lane_matching import LanePlaces, lane_changes, lane_places
from phase_sumo.logs.recording import HISTORY, PERIOD, Recording, Window
from phase_sumo.logs.sampling import chords, runs
from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.near import pairs_within

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
TOGETHER = 500  # samples looked at together
# medians outside of these are no road traffic but another unit
LENGTHS = 2.5, 14.0  # m
SPEEDS = 0.8, 1.25  # recorded speed over that of the positions
ON_ROAD = 0.5  # of all positions: fewer on its lanes, and it is another road


def finished(recording: Recording, path: Path) -> Recording:
    """The recording with `FLAGS` on its tracks: the last step of every reader.

    Raises:
        PhaseError: lengths or speeds suggest other units than metres and seconds, or most vehicles are beside
            the road.
    """
    _check_units(recording, path)
    places = lane_places(recording)
    on_road = float((places.lane >= 0)[recording.present].mean())
    if on_road < ON_ROAD:
        raise PhaseError(
            f"{path}: {recording.name}: {1 - on_road:.0%} of the positions are beside the lanes of "
            f"{recording.network.name}; pass the map of this place, in the coordinates of the log"
        )
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
    c = chords(recording.x, recording.y, recording.present, 5)
    way = np.hypot(c.dx, c.dy)
    moves = way > 2.0
    if moves.any():
        implied = float(np.median(way[moves] / c.seconds[moves]))
        speed = float(np.median(recording.speed[c.vehicle, c.sample][moves]))
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
    x, y = recording.x, recording.y
    apart = float(np.nanmax(x) - np.nanmin(x)) + 4.0 * float(reach.max())
    for begin in range(0, x.shape[1], TOGETHER):
        vehicle, sample = np.nonzero(recording.present[:, begin : begin + TOGETHER])
        if not len(vehicle):
            continue
        # one place per time, so that vehicles only meet those of the same time
        xy = np.stack((x[vehicle, begin + sample] + apart * sample, y[vehicle, begin + sample]), -1)
        long = np.flatnonzero(reach[vehicle] > usual)
        pairs = pairs_within(xy, xy, 2.0 * usual)
        more = pairs_within(xy[long], xy, 2.0 * float(reach.max()))
        a, b = np.concatenate((pairs[0], long[more[0]])), np.concatenate((pairs[1], more[1]))
        a, b = a[a != b], b[a != b]
        yaw = recording.yaw[vehicle, begin + sample]
        sizes = 0.5 * recording.length[vehicle], 0.5 * recording.width[vehicle]
        boxes = torch.from_numpy(np.stack((*xy.T, np.cos(yaw), np.sin(yaw), *sizes)))
        hit = boxes_overlap(boxes[:, a], boxes[:, b]).numpy()
        result[vehicle[a[hit]]] = result[vehicle[b[hit]]] = True
    return result


def _jumps(recording: Recording) -> NDArray[np.bool_]:
    x, y, speed, second = recording.x, recording.y, recording.speed, round(1.0 / PERIOD)
    v, t = _followed(recording.present, 1)
    moved = np.hypot(x[v, t + 1] - x[v, t], y[v, t + 1] - y[v, t]) / PERIOD
    off = v[np.abs(moved - 0.5 * (speed[v, t + 1] + speed[v, t])) > STEP]
    v, t = _followed(recording.present, second)
    hard = v[np.abs(speed[v, t + second] - speed[v, t]) > HARDEST * second * PERIOD]
    return _among(np.concatenate((off, hard, np.nonzero(speed > FASTEST)[0])), recording)


def _followed(present: NDArray[np.bool_], steps: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Vehicle and sample of all that are present ``steps`` samples later, too."""
    vehicle, sample = np.nonzero(present[:, :-steps] & present[:, steps:])
    return vehicle, sample


def _against(recording: Recording, places: LanePlaces) -> NDArray[np.bool_]:
    v, t = np.nonzero(recording.present)
    return _among(v[np.cos(recording.yaw[v, t] - places.yaw[v, t]) < 0.0], recording)


def _among(vehicle: NDArray[np.int64], recording: Recording) -> NDArray[np.bool_]:
    """[V] the vehicles that are named."""
    return np.bincount(vehicle, minlength=len(recording.length)) > 0


def _stands(recording: Recording) -> NDArray[np.bool_]:
    x, y = (np.fmax.reduce(a, 1) - np.fmin.reduce(a, 1) for a in (recording.x, recording.y))
    return np.asarray(np.hypot(x, y) < RESTING)


SHARE = 85.0  # percentile of the speeds recorded in a lane that its drivers like to drive


def windows(
    recording: Recording,
    seconds: float = 10.0,
    lane_changes_only: bool = True,
    stride: float | None = None,
    shortest: float = 5.0,
    without: frozenset[str] = frozenset(),
) -> list[Window]:
    """Cut a recording into scenario windows.

    Agents are the vehicles that are present when the window begins, with their centre on a lane. What
    appears later is no agent. A vehicle may be lost before the window ends; `Window.last` says when, in the
    extreme at once.

    Args:
        recording: the tracks.
        seconds: length of a window.
        lane_changes_only: leave out windows in which no agent changes lanes (the paper's choice).
        stride: seconds from the begin of one window to the next; by default ``seconds``, so that windows do
            not overlap.
        shortest: what is left at the end of a recording is a window, too, if it has this many seconds.
        without: leave out agents whose track has one of these `FLAGS`.

    Raises:
        PhaseError: a length is not positive, or a flag unknown.
    """
    stride = seconds if stride is None else stride
    for name, value in (("seconds", seconds), ("stride", stride), ("shortest", shortest)):
        if not value >= PERIOD:
            raise PhaseError(f"{name} {value:g}: pass at least {PERIOD:g} s")
    if unknown := without - FLAGS.keys():
        raise PhaseError(f"no flag {', '.join(sorted(unknown))}; there are {', '.join(FLAGS)}")
    places = lane_places(recording)
    changes = lane_changes(recording, places)
    used = np.unique(places.lane[places.lane >= 0]).tolist()
    speed = {k: float(np.percentile(recording.speed[places.lane == k], SHARE)) for k in used}
    vehicle, first, until = runs(recording.present)
    sound = np.array([not (flags & without) for flags in recording.flags], np.bool_)
    length, steps, result = recording.present.shape[1], round(seconds / PERIOD), []
    for begin in range(0, length - round(shortest / PERIOD), round(stride / PERIOD)):
        size = min(steps, length - 1 - begin)
        there = np.flatnonzero((first <= begin) & (begin <= until) & sound[vehicle])
        there = there[places.lane[vehicle[there], begin] >= 0]
        if not len(there):
            continue
        agents, last = vehicle[there], np.minimum(until[there], begin + size)
        row = np.minimum(np.searchsorted(agents, changes.vehicle), len(agents) - 1)
        within = (agents[row] == changes.vehicle) & (changes.begin >= begin) & (changes.end <= last[row])
        if within.any() or not lane_changes_only:
            past = min(begin, round(HISTORY / PERIOD))
            result.append(
                Window(
                    recording.cut(agents, begin - past, begin + size + 1),
                    agents,
                    past,
                    size,
                    last - (begin - past),
                    int(within.sum()),
                    np.array([speed[k] for k in places.lane[agents, begin].tolist()]),
                )
            )
    return result
