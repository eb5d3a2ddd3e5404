"""The busiest way through a network, as one axis that speeds and trajectories can be drawn along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.evaluate.traffic import steps
from phase_sumo.evaluate.trajectories import Trajectories

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Corridor:
    """Edges in driving order and the distance in m at which each begins."""

    start: dict[str, float]
    length: float


def find_corridor(t: Trajectories) -> Corridor:
    """From the edge with most samples along the most used transitions, both ways, junctions included."""
    edges = list(dict.fromkeys(t.lane_edges))
    number = {edge: i for i, edge in enumerate(edges)}
    of_lane = np.array([number[e] for e in t.lane_edges] + [-1], np.int64)
    samples = of_lane[t.lane]
    samples = samples[samples >= 0]
    if not len(samples):
        return Corridor({}, 0.0)
    s = steps(t)
    a, b = of_lane[t.lane[s.before]], of_lane[t.lane[s.after]]
    moved = (a != b) & (a >= 0) & (b >= 0)
    pairs, count = np.unique(np.stack((a[moved], b[moved])), axis=1, return_counts=True)
    busiest = int(np.bincount(samples).argmax())
    upstream = _follow(busiest, pairs[1], pairs[0], count)[:0:-1]
    downstream = [e for e in _follow(busiest, pairs[0], pairs[1], count) if e not in upstream]
    order = [*upstream, *downstream]
    length = np.zeros(len(edges))
    for lane, edge in enumerate(of_lane[:-1]):
        length[edge] = max(length[edge], t.lane_length[lane])
    start, at = {}, 0.0
    for edge in order:
        start[edges[edge]] = at
        at += float(length[edge])
    return Corridor(start, at)


def along(t: Trajectories, corridor: Corridor) -> FloatArray:
    """[S] distance of each sample's front bumper along the corridor in m, NaN off it."""
    offset = np.array([corridor.start.get(e, np.nan) for e in t.lane_edges] + [np.nan])
    return offset[t.lane] + t.position


def speed_profile(t: Trajectories, corridor: Corridor, width: float = 50.0) -> tuple[FloatArray, FloatArray]:
    """Mean speed in m/s of the samples in slices of ``width`` m; NaN where fewer than five are.

    Returns:
        centres of the slices in m, and the means.
    """
    s = along(t, corridor)
    good = np.isfinite(s)
    edges = np.arange(0.0, max(corridor.length, width) + width, width)
    count = np.histogram(s[good], edges)[0]
    total = np.histogram(s[good], edges, weights=t.speed[good])[0]
    mean = np.where(count >= 5, total / np.maximum(count, 1), np.nan)
    return 0.5 * (edges[:-1] + edges[1:]), mean


def _follow(first: int, source, target, count) -> list[int]:
    chain, seen = [first], {first}
    while True:
        options = np.flatnonzero(source == chain[-1])
        options = [o for o in options if int(target[o]) not in seen]
        if not options:
            return chain
        best = int(target[max(options, key=lambda o: count[o])])
        chain.append(best)
        seen.add(best)
