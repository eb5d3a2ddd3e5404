"""Lanes from what logs give of their roads: carriageways along the x axis, or strips between two bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.polylines import Polylines

FloatArray = NDArray[np.float64]
SPEED_LIMIT = 31.3  # m/s, 70 mph, where a log names none; nothing is measured against it
SPACING = 2.0  # m between points of a centre line


@dataclass(frozen=True)
class Carriageway:
    """Lanes abreast in one direction.

    Attributes:
        name: edge id.
        begin, end: x in m; traffic runs from one to the other.
        centres: [L] y of the lane centres in m, from the rightmost lane of the driver to the leftmost.
        widths: [L] m.
        speed_limit: m/s.
    """

    name: str
    begin: float
    end: float
    centres: FloatArray
    widths: FloatArray
    speed_limit: float = SPEED_LIMIT


def straight_road(name: str, carriageways: Sequence[Carriageway]) -> LaneNetwork:
    """Lanes of all carriageways, each with changes allowed between all its lanes."""
    lanes: list[Lane] = []
    for way in carriageways:
        first, count = len(lanes), len(way.centres)
        for k, (y, width) in enumerate(zip(way.centres, way.widths, strict=True)):
            lanes.append(
                Lane(
                    id=f"{way.name}_{k}",
                    edge=way.name,
                    points=np.array([[way.begin, y], [way.end, y]], np.float64),
                    width=float(width),
                    speed_limit=way.speed_limit,
                    length=abs(way.end - way.begin),
                    left=first + k + 1 if k + 1 < count else -1,
                    right=first + k - 1 if k else -1,
                )
            )
    return LaneNetwork(name, tuple(lanes), ())


@dataclass(frozen=True)
class Strip:
    """A lanelet: a piece of lane between two bounds.

    Attributes:
        id: name of the lane.
        left, right: [P, 2] and [Q, 2] bounds in driving direction, in m.
        left_of, right_of: the strip abreast in the same direction, or -1.
        solid_left, solid_right: the marking there may not be crossed.
        successors: strips that begin where this one ends.
        speed_limit: m/s.
    """

    id: str
    left: FloatArray
    right: FloatArray
    left_of: int
    right_of: int
    solid_left: bool
    solid_right: bool
    successors: tuple[int, ...]
    speed_limit: float = SPEED_LIMIT


def strip_road(name: str, strips: Sequence[Strip]) -> LaneNetwork:
    """A lane for every strip, midway between its bounds and as wide as it is in the median.

    Strips abreast share an edge. One without a successor (predecessor) ends (begins) within the road where
    one abreast goes on; elsewhere the road is open there.
    """
    edges = _edges(strips)
    leads = {after for strip in strips for after in strip.successors}
    goes_on = {edge for edge, strip in zip(edges, strips, strict=True) if strip.successors}
    comes_from = {edges[after] for after in leads}
    lanes = []
    for i, strip in enumerate(strips):
        points, width = _midline(strip.left, strip.right)
        left, right = strip.left_of, strip.right_of
        lanes.append(
            Lane(
                id=strip.id,
                edge=strips[edges[i]].id,
                points=points,
                width=width,
                speed_limit=strip.speed_limit,
                length=float(np.hypot(*np.diff(points, axis=0).T).sum()),
                left=-1 if strip.solid_left else left,
                right=-1 if strip.solid_right else right,
                solid_left=strip.solid_left and left >= 0,
                solid_right=strip.solid_right and right >= 0,
                dead_start=i not in leads and edges[i] in comes_from,
                dead_end=not strip.successors and edges[i] in goes_on,
            )
        )
    links = tuple((i, after) for i, strip in enumerate(strips) for after in strip.successors)
    return LaneNetwork(name, tuple(lanes), links)


def _edges(strips: Sequence[Strip]) -> list[int]:
    """Per strip the first of all those that lie beside it or beside one beside it."""
    edge = list(range(len(strips)))
    while True:
        for i, strip in enumerate(strips):
            for k in (strip.left_of, strip.right_of):
                if k >= 0:
                    edge[i] = edge[k] = min(edge[i], edge[k])
        if all(edge[i] == edge[k] for i, s in enumerate(strips) for k in (s.left_of, s.right_of) if k >= 0):
            return edge


def _midline(left: FloatArray, right: FloatArray) -> tuple[FloatArray, float]:
    """Points about `SPACING` apart midway between two bounds, and the width across in the median."""
    bounds = Polylines.of([left, right])
    pieces = max(1, round(float(bounds.length.mean()) / SPACING))
    share = np.linspace(0.0, 1.0, pieces + 1)

    def along(line: int) -> FloatArray:
        own = slice(int(bounds.first[line]), int(bounds.first[line] + bounds.counts[line]))
        s = bounds.s[own] - bounds.s[own.start]
        return np.stack([np.interp(share * s[-1], s, bounds.points[own, k]) for k in (0, 1)], -1)

    a, b = along(0), along(1)
    middle = 0.5 * (a + b)
    tangent = np.gradient(middle, axis=0)
    across = (a - b)[:, 1] * tangent[:, 0] - (a - b)[:, 0] * tangent[:, 1]
    return middle, float(np.median(across / np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9)))
