"""Point pairs closer than a radius, by sorting into squares: linear memory, no Python loop per point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


def ranges(counts: IntArray) -> IntArray:
    """0..counts[0]-1, 0..counts[1]-1, ... as one array."""
    ends = np.cumsum(counts)
    return np.arange(int(ends[-1]) if len(ends) else 0) - np.repeat(ends - counts, counts)


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
    key = key[order]
    found: list[tuple[IntArray, IntArray]] = []
    for column in (-1, 0, 1):
        # the three squares of a column are neighbours in the sorted keys
        low = (home[:, 0] + column) * rows + home[:, 1] - 1
        first, last = np.searchsorted(key, low, "left"), np.searchsorted(key, low + 2, "right")
        counts = last - first
        q = np.repeat(np.arange(len(query)), counts)
        p = order[np.repeat(first, counts) + ranges(counts)]
        close = ((query[q] - points[p]) ** 2).sum(1) <= radius * radius
        found.append((q[close], p[close]))
    q, p = np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])
    order = np.argsort(q, kind="stable")
    return q[order], p[order]


def nearest(query: np.ndarray, points: np.ndarray, radius: float) -> tuple[IntArray, NDArray[np.float64]]:
    """Nearest point of each query within ``radius`` m.

    Returns:
        [Q] index (-1 where there is none) and [Q] distance in m (inf there).
    """
    index = np.full(len(query), -1, np.int64)
    distance = np.full(len(query), np.inf)
    q, p = pairs_within(query, points, radius)
    d = np.hypot(*(np.asarray(query, np.float64)[q] - np.asarray(points, np.float64)[p]).T)
    order = np.lexsort((d, q))
    q, p, d = q[order], p[order], d[order]
    first = np.ones(len(q), bool)
    first[1:] = q[1:] != q[:-1]
    index[q[first]], distance[q[first]] = p[first], d[first]
    return index, distance
