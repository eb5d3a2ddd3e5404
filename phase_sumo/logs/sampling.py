"""Tracks sampled at any rate -> arrays of vehicles x time at the simulator's step, and motion along them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.errors import PhaseError
from phase_sumo.logs.recording import PERIOD
from phase_sumo.sim.near import ranges

SLOWEST = 1.0  # s: tracks sampled more rarely say too little between samples
LOST = 1.5  # times the usual period between samples: longer ones are gaps
SPAN = 5  # samples to either side that a heading is taken over
STEP = 0.5  # m: over less, a path has no direction


@dataclass(frozen=True)
class Grid:
    """``present`` [V, T] and columns of ``values``, each [V, T], NaN where absent."""

    present: NDArray[np.bool_]
    values: tuple[FloatArray, ...]


def on_grid(path: Path, vehicle: IntArray, time: FloatArray, values: FloatArray, count: int) -> Grid:
    """Interpolate samples linearly at multiples of `PERIOD` from the first one of all.

    Gaps within a track stay: the vehicle is absent there.

    Args:
        path: file, for messages.
        vehicle: [S] row of each sample's vehicle, 0..V-1.
        time: [S] s.
        values: [C, S].
        count: V.

    Raises:
        PhaseError: a vehicle has two samples at one time, or they are more than `SLOWEST` apart.
    """
    order = np.lexsort((time, vehicle))
    vehicle, time, values = vehicle[order], time[order] - time.min(), values[:, order]
    same, step = np.diff(vehicle) == 0, np.diff(time)
    if (step[same] <= 1e-6).any():
        at = int(np.flatnonzero(same & (step <= 1e-6))[0])
        raise PhaseError(
            f"{path}: a vehicle has two samples at {time[at]:.2f} s from the start; an id may stand for one "
            "vehicle only"
        )
    usual = float(np.median(step[same])) if same.any() else PERIOD
    if usual > SLOWEST:
        raise PhaseError(
            f"{path}: samples of a vehicle are {usual:g} apart in time, at most {SLOWEST:g} s is possible; "
            "are times in seconds?"
        )
    first = np.flatnonzero(np.concatenate(([True], ~same)))
    last = np.append(first[1:], len(vehicle)) - 1
    begin = np.ceil(time[first] / PERIOD - 1e-6).astype(np.int64)
    end = np.floor(time[last] / PERIOD + 1e-6).astype(np.int64)
    counts = np.maximum(end - begin + 1, 0)
    row = np.repeat(np.arange(len(first)), counts)
    sample = np.repeat(begin, counts) + ranges(counts)
    # one rising number for all tracks, so that one search finds the samples on either side
    apart = 2.0 * (float(time.max()) + 1.0)
    after = np.searchsorted(vehicle * apart + time, vehicle[first][row] * apart + sample * PERIOD - 1e-6)
    after = np.clip(after, first[row], last[row])
    before = np.maximum(after - 1, first[row])
    gap = time[after] - time[before]
    share = np.clip((sample * PERIOD - time[before]) / np.maximum(gap, 1e-9), 0.0, 1.0)
    known = (gap <= LOST * max(usual, PERIOD)) | (share < 1e-3) | (share > 1.0 - 1e-3)
    row, sample, share, before, after = row[known], sample[known], share[known], before[known], after[known]
    size = count, int(sample.max(initial=0)) + 1
    present = np.zeros(size, np.bool_)
    number = vehicle[first][row]
    present[number, sample] = True
    return Grid(
        present,
        tuple(
            placed(value[before] + share * (value[after] - value[before]), number, sample, size)
            for value in values
        ),
    )


def placed(values: FloatArray, vehicle: IntArray, sample: IntArray, size: tuple[int, ...]) -> FloatArray:
    """[V, T] of the values [S] of single samples, NaN elsewhere."""
    result = np.full(size, np.nan)
    result[vehicle, sample] = values
    return result


def runs(present: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
    """Vehicle, first and last sample of every uninterrupted piece of a track."""
    padded = np.pad(present, ((0, 0), (1, 1))).astype(np.int8)
    change = np.diff(padded, axis=1)
    row, first = np.nonzero(change == 1)
    _, last = np.nonzero(change == -1)
    return row, first, last - 1


@dataclass(frozen=True)
class Chords:
    """Ways across the samples of tracks, all [S], vehicle by vehicle in the order of time.

    Attributes:
        vehicle, sample: what each is about.
        dx, dy: m between the samples before and after it.
        seconds: between those; 0 for a piece of a single sample.
    """

    vehicle: IntArray
    sample: IntArray
    dx: FloatArray
    dy: FloatArray
    seconds: FloatArray


def chords(x: FloatArray, y: FloatArray, present: NDArray[np.bool_], span: int) -> Chords:
    """Between the samples ``span`` before and after each, or fewer at the ends of a piece of its track."""
    row, first, last = runs(present)
    counts = last - first + 1
    v, low, high = (np.repeat(a, counts) for a in (row, first, last))
    t = low + ranges(counts)
    reach = np.minimum(span, np.minimum(t - low, high - t))
    # at the ends of a piece, one-sided
    a = np.where(reach > 0, t - reach, np.maximum(t - 1, low))
    b = np.where(reach > 0, t + reach, np.minimum(t + 1, high))
    return Chords(v, t, x[v, b] - x[v, a], y[v, b] - y[v, a], (b - a) * PERIOD)


def path_speed(x: FloatArray, y: FloatArray, present: NDArray[np.bool_]) -> FloatArray:
    """[V, T] m/s from the positions before and after; 0 for a single sample."""
    c = chords(x, y, present, 1)
    return placed(np.hypot(c.dx, c.dy) / np.maximum(c.seconds, PERIOD), c.vehicle, c.sample, x.shape)


def path_yaw(
    x: FloatArray, y: FloatArray, present: NDArray[np.bool_], resting: float | FloatArray
) -> FloatArray:
    """[V, T] direction of the path in rad, over half a second to either side.

    While a vehicle hardly moves it keeps the direction it had, or else takes the one it then has, or
    else ``resting`` (rad, broadcast to [V, T]).
    """
    c = chords(x, y, present, SPAN)
    moves = np.hypot(c.dx, c.dy) > STEP
    yaw = np.where(moves, np.arctan2(c.dy, c.dx), np.broadcast_to(resting, x.shape)[c.vehicle, c.sample])
    here = np.arange(len(yaw))
    first = np.searchsorted(c.vehicle, c.vehicle)
    last = np.searchsorted(c.vehicle, c.vehicle, "right") - 1
    earlier = np.maximum.accumulate(np.where(moves, here, -1))
    later = np.minimum.accumulate(np.where(moves, here, len(yaw))[::-1])[::-1]
    source = np.where(earlier >= first, earlier, np.where(later <= last, later, here))
    return placed(yaw[source], c.vehicle, c.sample, x.shape)
