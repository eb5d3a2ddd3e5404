"""Point pairs closer than a radius, by sorting into squares: linear memory, no Python loop per point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


def ranges(counts: IntArray) -> IntArray:
    """0..counts[0]-1, 0..counts[1]-1, ... as one array."""
    ends = np.cumsum(counts)
    return np.arange(int(ends[-1]) if len(ends) else 0) - np.repeat(ends - counts, counts)


def abeam(
    at: np.ndarray,
    index: IntArray,
    line: np.ndarray,
    direction: np.ndarray,
    bounds: tuple[IntArray, IntArray],
    spacing: float,
    rounds: int,
) -> IntArray:
    """The point of a line abeam of each position, found by sliding along the line.

    Args:
        at: [Q, 2] m.
        index: [Q] points to begin at.
        line, direction: [P, 2] evenly spaced points of lines, m, and unit directions there.
        bounds: [Q] first and last point of the line that each position slides along.
        spacing: m between points.
        rounds: how often to slide; each round leaves a small share of the way on curves.
    """
    for _ in range(rounds):
        ahead = ((at - line[index]) * direction[index]).sum(1)
        index = np.clip(index + np.rint(ahead / spacing).astype(np.int64), *bounds)
    return index


def pairs_within(query: np.ndarray, points: np.ndarray, radius: float) -> tuple[IntArray, IntArray]:
    """All (query index, point index) pairs at most ``radius`` m apart, sorted by query index.

    Args:
        query: [Q, 2] m.
        points: [P, 2] m.
    """
    if len(query) == 0 or len(points) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    query, points = np.asarray(query, np.float64), np.asarray(points, np.float64)
    origin = np.minimum(query.min(0), points.min(0)) - radius
    square = ((points - origin) // radius).astype(np.int64)
    home = ((query - origin) // radius).astype(np.int64)
    rows = int(max(square[:, 1].max(), home[:, 1].max())) + 3
    key = square[:, 0] * rows + square[:, 1]
    order = np.argsort(key, kind="stable")
    key, x, y = key[order], points[order, 0], points[order, 1]
    # the three squares of a column are neighbours in the sorted keys
    low = (home[:, :1] + (-1, 0, 1)) * rows + home[:, 1:] - 1
    first, last = np.searchsorted(key, low, "left"), np.searchsorted(key, low + 2, "right")
    counts = (last - first).ravel()
    before = np.cumsum(counts) - counts
    q = np.repeat(np.arange(len(query)), (last - first).sum(1))
    p = np.repeat(first.ravel() - before, counts) + np.arange(len(q))
    dx, dy = query[:, 0][q] - x[p], query[:, 1][q] - y[p]
    close = np.flatnonzero(dx * dx + dy * dy <= radius * radius)
    return q[close], order[p[close]]


def nearest(query: np.ndarray, points: np.ndarray, radius: float) -> tuple[IntArray, NDArray[np.float64]]:
    """Nearest point of each query within ``radius`` m.

    Returns:
        [Q] index (-1 where there is none) and [Q] distance in m (inf there).
    """
    index = np.full(len(query), -1, np.int64)
    distance = np.full(len(query), np.inf)
    query, points = np.asarray(query, np.float64), np.asarray(points, np.float64)
    for reach in (radius / 4, radius / 2, radius):  # most have a point close by, among few candidates
        missing = np.flatnonzero(index < 0)
        q, p = pairs_within(query[missing], points, reach)
        q = missing[q]
        d = np.hypot(query[q, 0] - points[p, 0], query[q, 1] - points[p, 1])
        np.minimum.at(distance, q, d)
        best = np.flatnonzero(d == distance[q])[::-1]  # the first of equally near ones is written last
        index[q[best]] = p[best]
    return index, distance
