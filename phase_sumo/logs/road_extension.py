"""A recorded road made longer at its open ends, so that simulated vehicles may leave the recorded stretch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lanes import Lane, LaneNetwork

FloatArray = NDArray[np.float64]
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
