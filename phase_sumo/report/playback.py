"""Recorded runs in a compact form that the report's player decodes: see ``templates/playback.js``.

Every channel is quantised to int16 steps, stored as the change since the frame before, and all channels of a
run, one after the other, are deflated and written as base64.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from phase_sumo.bridge.maps.road_lines import drivable_surface, lane_boundaries
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.report.road_pictures import View
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.road_map import RoadKind

PERIOD = 0.4  # s between frames, about; the player interpolates
MOST_SAMPLES = 500_000  # poses on the page: at most about 4 MB
LEAD = 20.0  # s before the moment that the player opens at, where a run does not fit whole
STEP = {
    "x": 0.02, "y": 0.02, "yaw": 0.001, "hitch": 0.001, "speed": 0.02, "target_speed": 0.1, "alpha": 0.01,
}  # fmt: skip  # m, rad, m/s: smallest difference that is kept


def pack(
    first: Mapping[str, Trajectories],
    network: LaneNetwork,
    view: View,
    moment: float,
    collisions: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """What the player needs, as JSON types.

    Args:
        first: the first seed's trajectories by model.
        view: where the player opens.
        moment: s, when it opens, inside the window that is kept.
        collisions: of those runs, with ``model``, ``time``, ``x``, ``y``.
    """
    sampled = max(t.period for t in first.values())
    period = sampled * max(1, round(PERIOD / sampled))
    begin, end = window(first, moment, period)
    origin = np.round([view.x, view.y])
    runs = {name: _run(t, origin, begin, end, period) for name, t in first.items()}
    for name, run in runs.items():
        run["collisions"] = [
            [round(c["time"], 2), round(c["x"] - origin[0], 1), round(c["y"] - origin[1], 1)]
            for c in collisions
            if c["model"] == name and begin <= c["time"] <= end
        ]
    return {
        "begin": begin,
        "end": end,
        "moment": float(np.clip(moment, begin, end)),
        "period": period,
        "origin": origin.tolist(),
        "yaw": round(view.yaw, 4),
        "steps": STEP,
        "road": _road(network, origin),
        "runs": runs,
    }


def window(first: Mapping[str, Trajectories], moment: float, period: float) -> tuple[float, float]:
    """Begin and end in s of what fits into `MOST_SAMPLES`: all, or from shortly before ``moment`` on."""
    times = np.sort(np.concatenate([t.time for t in first.values()]))
    if not len(times):
        return 0.0, 0.0
    most = int(MOST_SAMPLES * period / min(t.period for t in first.values()))
    begin = float(times[0])
    if len(times) > most:
        begin = max(begin, moment - LEAD)
        late = times[times >= begin]
        return begin, float(late[min(most, len(late)) - 1])
    return begin, float(times[-1])


def _run(t: Trajectories, origin: np.ndarray, begin: float, end: float, period: float) -> dict[str, Any]:
    """Tracks (uninterrupted stays of a vehicle) with their quantised channels."""
    frame = np.rint((t.time - begin) / period).astype(np.int64)
    near = np.abs(t.time - begin - frame * period) < 0.25 * t.period
    rows = np.flatnonzero(near & (t.time >= begin - 1e-6) & (t.time <= end + 1e-6))
    rows = rows[np.lexsort((frame[rows], t.vehicle[rows]))]
    starts = np.append(True, (np.diff(t.vehicle[rows]) != 0) | (np.diff(frame[rows]) != 1))[: len(rows)]
    first = np.flatnonzero(starts)
    count = np.diff(np.append(first, len(rows)))
    channels = {
        "x": t.x[rows] - origin[0],
        "y": t.y[rows] - origin[1],
        "yaw": _unwrapped(t.yaw[rows], starts),
        "hitch": t.hitch[rows],
        "speed": t.speed[rows],
        "target_speed": t.target_speed[rows],
        "alpha": np.where(t.controlled[rows], t.alpha[rows], 0.0),  # 0: SUMO drives
    }
    heads, deltas = [], []
    for name, values in channels.items():
        steps = np.rint(values / STEP[name]).astype(np.int64)
        change = np.diff(steps, prepend=0)
        change[first] = 0
        heads.append(steps[first])
        deltas.append(np.clip(change, -32768, 32767).astype("<i2"))
    vehicles = t.vehicle[rows[first]]
    shapes, shape_of = np.unique(t.shape[vehicles].round(2), axis=0, return_inverse=True)
    return {
        "shapes": shapes.tolist(),
        "tracks": [
            [
                t.vehicle_ids[v],
                t.vehicle_types[v],
                int(s),
                int(frame[rows[f]]),
                int(n),
                [int(h) for h in head],
            ]
            for v, s, f, n, head in zip(
                vehicles, shape_of.ravel(), first, count, np.stack(heads, -1), strict=True
            )
        ],
        "samples": len(rows),
        "data": base64.b64encode(zlib.compress(np.concatenate(deltas).tobytes(), 9)).decode(),
    }


def _unwrapped(yaw: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Angles without jumps by 2 pi within a track."""
    turn = np.diff(yaw, prepend=yaw[:1])
    wraps = np.where(starts, 0.0, np.rint(turn / (2.0 * np.pi)))
    return yaw - 2.0 * np.pi * np.cumsum(wraps)


def _road(network: LaneNetwork, origin: np.ndarray) -> dict[str, list]:
    """Outlines and markings as flat lists of decimetres."""

    def flat(line: np.ndarray) -> list[int]:
        return np.rint(10.0 * (np.asarray(line)[:, :2] - origin)).astype(int).ravel().tolist()

    parts = shapely.get_parts(drivable_surface(network).simplify(0.05))
    lines = lane_boundaries(network)
    return {
        "surface": [flat(np.asarray(r.coords)) for part in parts for r in (part.exterior, *part.interiors)],
        "dashed": [flat(b.points) for b in lines if b.kind == RoadKind.LANE_BOUNDARY],
        "solid": [flat(b.points) for b in lines if b.kind == RoadKind.SOLID_BOUNDARY],
    }
