"""Lanes from what logs give of their roads: carriageways along the x axis, or strips between two bounds.

They can be made longer at open ends, so that simulated vehicles may leave the recorded stretch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phase_sumo.arrays import FloatArray
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.polylines import Polylines

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


CHORD = 30.0  # m of a lane that give its direction at an end: recorded centre lines wobble


def extended(network: LaneNetwork, before: float, after: float) -> LaneNetwork:
    """The network with straight pieces of ``before`` and ``after`` m at its first and last lanes.

    Lanes of one edge go on in their mean direction, in parallel. Dead ends stay where they are.
    """
    open_start = _open([b for _, b in network.successors], [lane.dead_start for lane in network.lanes])
    open_end = _open([a for a, _ in network.successors], [lane.dead_end for lane in network.lanes])
    starts, ends = _directions(network, open_start, False), _directions(network, open_end, True)
    lanes = []
    for i, lane in enumerate(network.lanes):
        head = lane.points[:1] - before * starts[lane.edge] if open_start[i] else np.zeros((0, 2))
        tail = lane.points[-1:] + after * ends[lane.edge] if open_end[i] else np.zeros((0, 2))
        lanes.append(_longer(lane, head, tail))
    return replace(network, lanes=tuple(lanes))


def _open(linked: list[int], dead: list[bool]) -> list[bool]:
    joined = set(linked)
    return [i not in joined and not closed for i, closed in enumerate(dead)]


def _directions(network: LaneNetwork, wanted: list[bool], last: bool) -> dict[str, FloatArray]:
    """Unit vector [2] of each edge at its open ends."""
    total: dict[str, FloatArray] = {}
    for lane, use in zip(network.lanes, wanted, strict=True):
        if use:
            total[lane.edge] = total.get(lane.edge, np.zeros(2)) + _chord(lane.points, last)
    return {edge: v / np.hypot(*v) for edge, v in total.items()}


def _chord(points: FloatArray, last: bool) -> FloatArray:
    """Unit vector [2] along the first or last `CHORD` m of a line."""
    line = points[::-1] if last else points
    far = np.flatnonzero(np.hypot(*(line - line[0]).T) >= CHORD)
    away = line[far[0] if len(far) else -1] - line[0]
    return (-away if last else away) / np.hypot(*away)


def _longer(lane: Lane, head: FloatArray, tail: FloatArray) -> Lane:
    points = np.concatenate((head, lane.points, tail))
    step = np.hypot(*np.diff(points, axis=0).T)
    start, end = step[: len(head)], step[len(step) - len(tail) :]
    positions = None
    if lane.positions is not None:
        positions = start.sum() + np.concatenate((-start, lane.positions, lane.positions[-1] + end))
    return replace(lane, points=points, positions=positions, length=lane.length + start.sum() + end.sum())
