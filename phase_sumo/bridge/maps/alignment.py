"""Smooth lane ends at junctions, so that a tractor with a trailer can follow every centre line.

Real networks shift lanes sideways at junctions, by up to a lane width within 5 m. Here the ends of the
lanes are moved towards each other, blended over at most `BLEND` metres, and the connector between them
becomes a smooth curve. How the lanes on both sides share a jump is worked out in `lane_shifts`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phase_sumo.bridge.maps.lane_shifts import lane_shifts
from phase_sumo.bridge.maps.line_geometry import (
    arc_length,
    between,
    corners,
    direction,
    heading,
    hermite,
    normals,
    resample,
    rounded,
    without_duplicates,
    wrap,
)

FloatArray = NDArray[np.float64]
JUMP = 0.3  # m sideways at a junction that a vehicle is not asked to follow
BLEND = 15.0, 60.0  # m, shortest and longest blend at either side of a junction
BLEND_CURVATURE = 0.006  # 1/m that a blend reaches where it has the room: 5.4 m/s^2 at 30 m/s
COINCIDE = 0.5  # m: lanes whose ends are closer need no connector
TIGHT = 0.06  # rad/m that a connector turns at most; the lanes take the rest of a corner
SAME_ROAD = 1.2  # rad: larger turns at a junction are turns into another road
CORNER = 0.1  # rad: a connector with a sharper corner is drawn anew
FITS = 0.1  # m that SUMO's internal lanes may be off the lanes they join


@dataclass(frozen=True)
class Connector:
    """From one lane's end to another lane's start.

    Attributes:
        source, target: indices of the lanes.
        chain: (id, edge, length in m) of the internal lanes on the way.
        inner: [P, 2] their points, None where there are none.
        line: [P, 2] the drawn connector, None where the lanes coincide or it is not drawn yet.
    """

    source: int
    target: int
    chain: tuple[tuple[str, str, float], ...] = ()
    inner: FloatArray | None = None
    line: FloatArray | None = None


def align(
    lines: list[FloatArray], connectors: list[Connector], abreast: list[tuple[int, int]]
) -> tuple[list[FloatArray], list[Connector], int]:
    """Round corners, move lane ends until no connector jumps sideways, then draw the connectors.

    Args:
        lines: [P, 2] centre line of every lane.
        connectors: between the lanes, not drawn yet.
        abreast: pairs of lanes next to each other, which move together where their connectors allow it.

    Returns:
        lines, connectors with their ``line``, and how many connections had a jump. Connections across
        lanes are left out: they have no room to be smooth, and a lane change leads there as well.
    """
    lines = _without_overlaps(lines, connectors)
    yaws = _end_yaws(lines, connectors)
    lines = [rounded(line, yaws[2 * i], yaws[2 * i + 1]) for i, line in enumerate(lines)]
    straight = np.array([_goes_straight(lines, c) for c in connectors], bool)
    jumps = np.array(
        [_jump(lines, c) if ahead else 0.0 for c, ahead in zip(connectors, straight, strict=True)]
    )
    moved = int((np.abs(jumps) > JUMP).sum())
    if moved:
        ends = np.array([(2 * c.source + 1, 2 * c.target) for c in connectors])[straight]
        lengths = np.array([arc_length(line)[-1] for line in lines])
        shifts, left = lane_shifts(lengths, ends, jumps[straight], np.array(abreast, np.int64).reshape(-1, 2))
        lines = [_shifted(line, shifts[2 * i], shifts[2 * i + 1]) for i, line in enumerate(lines)]
        across = set(np.flatnonzero(straight)[np.abs(left) > JUMP])
        connectors = [c for k, c in enumerate(connectors) if k not in across]
    return lines, [_drawn(lines, c) for c in connectors], moved


def _without_overlaps(lines: list[FloatArray], connectors: list[Connector]) -> list[FloatArray]:
    """Lanes that begin behind the end of the lane before them start there instead."""
    behind = np.zeros(len(lines))
    for c in connectors:
        a, b = lines[c.source], lines[c.target]
        if _goes_straight(lines, c):
            behind[c.target] = max(behind[c.target], -float((b[0] - a[-1]) @ direction(a, at_end=True)))
    result = []
    for line, start in zip(lines, behind, strict=True):
        length = float(arc_length(line)[-1])
        result.append(between(line, start, length) if 0.0 < start < 0.5 * length else line)
    return result


def _end_yaws(lines: list[FloatArray], connectors: list[Connector]) -> FloatArray:
    """[2 * lanes] direction in rad of every lane's start (even) and end (odd).

    Where a road has a corner at a junction that is sharper than its connector can turn, the two lanes
    share the rest, so that the corner is rounded on both sides. The straightest connection of a fork or
    merge decides first; the other lanes then leave or join along it.
    """
    yaws = np.empty(2 * len(lines))
    yaws[0::2] = [heading(line[1] - line[0]) for line in lines]
    yaws[1::2] = [heading(line[-1] - line[-2]) for line in lines]
    own, decided = yaws.copy(), np.zeros(len(yaws), bool)
    ends = [(2 * c.source + 1, 2 * c.target) for c in connectors]
    turns = np.array([wrap(float(own[b] - own[a])) for a, b in ends])
    for k in np.argsort(np.abs(turns), kind="stable"):
        (a, b), c = ends[k], connectors[k]
        reach = float(np.hypot(*(lines[c.target][0] - lines[c.source][-1])))
        turn = wrap(float(yaws[b] - yaws[a]))
        excess = float(np.sign(turn)) * max(abs(turn) - TIGHT * reach, 0.0)
        if abs(turns[k]) < SAME_ROAD and not (decided[a] and decided[b]):
            share = 0.5 if decided[a] == decided[b] else float(decided[b])
            yaws[a] += share * excess
            yaws[b] -= (1.0 - share) * excess
        decided[[a, b]] = True
    return yaws


def _goes_straight(lines: list[FloatArray], c: Connector) -> bool:
    a, b = direction(lines[c.source], at_end=True), direction(lines[c.target], at_end=False)
    return bool(a @ b > np.cos(SAME_ROAD))


def _jump(lines: list[FloatArray], c: Connector) -> float:
    """Sideways offset in m (positive left) that a connector must bridge; 0 where it has room for it.

    Measured across the mean of the two lanes' directions: an arc from one to the other has none.
    """
    a, b = lines[c.source], lines[c.target]
    mean = direction(a, at_end=True) + direction(b, at_end=False)
    size = float(np.hypot(*mean))
    gap = b[0] - a[-1]
    across = float(mean[0] * gap[1] - mean[1] * gap[0]) / size
    along = float(mean @ gap) / size
    return 0.0 if along > _blend(across) else across


def _shifted(line: FloatArray, at_start: float, at_end: float) -> FloatArray:
    """The line with its ends moved sideways, blended with a quintic (no step in direction or curvature)."""
    if max(abs(at_start), abs(at_end)) < 1e-3:
        return line
    fine = resample(line, 1.0)
    s = arc_length(fine)
    shift = at_start * _smooth(1 - s / min(_blend(at_start), s[-1]))
    shift += at_end * _smooth(1 - (s[-1] - s) / min(_blend(at_end), s[-1]))
    return fine + shift[:, None] * normals(fine)


def _blend(shift: float) -> float:
    """m over which a quintic moves sideways by ``shift`` m; its largest curvature is 5.77 shift / m^2."""
    return float(np.clip(np.sqrt(5.77 * abs(shift) / BLEND_CURVATURE), *BLEND))


def _smooth(t: FloatArray) -> FloatArray:
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


def _drawn(lines: list[FloatArray], c: Connector) -> Connector:
    """SUMO's own internal lanes where they still fit the two lanes smoothly, else a curve between them."""
    a, b = lines[c.source], lines[c.target]
    if np.hypot(*(b[0] - a[-1])) < COINCIDE:
        return c
    if c.inner is not None and np.hypot(*(c.inner[[0, -1]] - (a[-1], b[0])).T).max() < FITS:
        line = without_duplicates(np.concatenate((a[-1:], c.inner, b[:1])), closer=0.2)
        if len(line) >= 2 and (np.abs(corners(np.concatenate((a[-2:-1], line, b[1:2])))) < CORNER).all():
            return replace(c, line=line)
    line = hermite(a[-1], b[0], direction(a, at_end=True), direction(b, at_end=False))
    line = without_duplicates(line)
    return replace(c, line=line) if len(line) >= 2 else c
