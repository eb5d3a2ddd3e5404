"""Recorded boxes as vehicles of the simulator: shapes, and poses of their reference point."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.logs.recording import PERIOD, Recording
from phase_sumo.sim.vehicles import VehicleShape

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# proportions of sampled vehicles, see `phase_sumo.sim.dimensions`: shares of the length of the car, rigid
# truck or tractor, in this order
WHEELBASE = np.array([0.6, 0.55, 0.75])
REAR_OVERHANG = np.array([0.2, 0.27, 0.1])
KINDS = "car", "rigid_truck", "articulated_truck"
TRACTOR = 7.0 / 14.1  # tractor to trailer length, the means sampled
TRAILER_BASE = 0.8  # hitch to axle, of the trailer's length
SETBACK = 0.9  # m from the trailer's front to the hitch
HISTORY = 10.0  # s of path that turn a trailer, several times its length


def shape(recording: Recording, rows: IntArray) -> VehicleShape:
    """Geometry of the vehicles ``rows`` [N], as one world of N.

    The box of an articulated truck, L long, is divided into a tractor of length a and a trailer of length b
    with a / b as in training; from the tractor's front bumper to the trailer's rear they measure L:

        (1 - 0.1) a + b - `SETBACK` = L
    """
    sizes = {
        name: torch.from_numpy(value.astype(np.float32))[None]
        for name, value in _sizes(recording, rows).items()
    }
    kind = np.array(recording.kind, object)[rows]
    return VehicleShape(**sizes, truck=torch.from_numpy(kind != "car")[None])


def poses(
    recording: Recording, rows: IntArray, samples: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Reference points of the vehicles ``rows`` [N] at ``samples`` [S].

    The box's front bumper and direction are those of the car, rigid truck or tractor. The trailer is drawn
    along the recorded path: over the `HISTORY` that there is, its axle follows the hitch at a constant
    distance (a tractrix, which solves the hitch equation); at the path's begin it is in line.

    Returns:
        x, y in m, yaw and hitch angle in rad, each [N, S]; NaN where absent.
    """
    sizes = _sizes(recording, rows)
    ahead = 0.5 * recording.length[rows] - (sizes["length"] - sizes["rear_overhang"])
    yaw = recording.yaw[rows]
    x = recording.x[rows] + ahead[:, None] * np.cos(yaw)
    y = recording.y[rows] + ahead[:, None] * np.sin(yaw)
    hitch = np.where(recording.present[rows][:, samples], 0.0, np.nan)
    long = np.flatnonzero(sizes["trailer_base"] > 0)
    if len(long) and len(samples):
        begin = max(0, int(samples.min()) - round(HISTORY / PERIOD))
        span = slice(begin, int(samples.max()) + 1)
        found = _hitch(x[long, span], y[long, span], yaw[long, span], sizes["trailer_base"][long])
        hitch[long] = found[:, samples - begin]
    return x[:, samples], y[:, samples], yaw[:, samples], hitch


def _sizes(recording: Recording, rows: IntArray) -> dict[str, FloatArray]:
    """Numbers of `VehicleShape` in its order, each [N]."""
    kind = np.array([KINDS.index(recording.kind[row]) for row in rows], np.int64)
    length, width = recording.length[rows], recording.width[rows]
    trailer = np.where(kind == 2, (length + SETBACK) / (1.0 + (1.0 - REAR_OVERHANG[2]) * TRACTOR), 0.0)
    length = np.where(kind == 2, TRACTOR * trailer, length)
    return {
        "length": length,
        "width": width,
        "wheelbase": WHEELBASE[kind] * length,
        "rear_overhang": REAR_OVERHANG[kind] * length,
        "trailer_length": trailer,
        "trailer_width": np.where(kind == 2, width, 0.0),
        "trailer_base": TRAILER_BASE * trailer,
        "trailer_setback": np.where(kind == 2, SETBACK, 0.0),
    }


def _hitch(x: FloatArray, y: FloatArray, yaw: FloatArray, base: FloatArray) -> FloatArray:
    """[M, S] hitch angles along paths of the hitch [M, S], for trailers ``base`` [M] m long.

    The axle moves along the mean of the trailer's directions before and after a step, s = (s_x, s_y) long:
    with u the direction before, half of the turn is the angle from u to 2 base u + s.
    """
    result, trailer = np.full(x.shape, np.nan), np.full(len(x), np.nan)
    behind_x, behind_y = np.full(len(x), np.nan), np.full(len(x), np.nan)  # 2 base behind the hitch
    for t in range(x.shape[1]):
        half = _wrap(np.arctan2(y[:, t] - behind_y, x[:, t] - behind_x) - trailer)
        # an absent vehicle leaves NaN, so that it begins anew where it is seen again
        trailer = np.where(np.isnan(behind_x), yaw[:, t], trailer + 2.0 * half)
        result[:, t] = _wrap(yaw[:, t] - trailer)
        behind_x, behind_y = x[:, t] - 2.0 * base * np.cos(trailer), y[:, t] - 2.0 * base * np.sin(trailer)
    return result


def _wrap(angle: FloatArray) -> FloatArray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
