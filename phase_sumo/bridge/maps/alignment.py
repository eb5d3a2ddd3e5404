"""Smooth lane ends at junctions, so that a tractor with a trailer can follow every centre line.

Real networks shift lanes sideways at junctions, by up to a lane width within 5 m. Here the ends of the lanes
are moved towards each other, blended over at most `BLEND` metres, and the connector between them becomes a
smooth curve.

A connection that jumps sideways fixes how two lane ends lie to each other, but not which of them moves. Each
junction's ends therefore form groups that move as one, and the groups come to rest where a set of springs
does: every end is pulled to where the network file has it, lanes abreast are pulled to keep their distance,
and the two ends of a lane too short to blend between different shifts are pulled together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray, IntArray
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

LOOSE = 0.1  # spring of ends that only open out of another lane, close into one or end, against 1
ABREAST = 1.0  # spring between lanes abreast
BEND = 40.0  # m: the spring along a lane of this length is 1, and grows with curvature squared: (BEND/L)^4
STIFFEST = 1.0e4
ROOMY = 120.0  # m: a lane this long has room for the longest blend at either end, and needs no spring
PRECISION = 1.0e-4  # m


def lane_shifts(
    lengths: FloatArray, ends: IntArray, jumps: FloatArray, abreast: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Shifts at the lanes' starts and ends.

    Args:
        lengths: [L] of the lanes in m.
        ends: [C, 2] lane ends that each connection joins; end 2i is the start of lane i, 2i + 1 its end.
        jumps: [C] sideways offset of each connection in m, positive left.
        abreast: [A, 2] pairs of lanes next to each other.

    Returns:
        [2L] shift of every end in m, positive left, and [C] the jump that is left in each connection: zero
        except for those that lead across from one lane to another where both go on elsewhere.
    """
    group, offset, firm = _groups(2 * len(lengths), ends, jumps)
    pull = np.where(firm, 1.0, LOOSE)
    beside = np.concatenate((2 * abreast, 2 * abreast + 1))
    along = np.arange(2 * len(lengths)).reshape(-1, 2)
    bend = np.minimum((BEND / np.maximum(lengths, 1.0)) ** 4, STIFFEST) * (lengths < ROOMY)
    first = np.concatenate((beside[:, 0], along[:, 0]))
    second = np.concatenate((beside[:, 1], along[:, 1]))
    spring = np.concatenate((np.full(len(beside), ABREAST), bend))
    shifts = offset + _at_rest(group, offset, pull, first, second, spring)[group]
    return shifts, jumps + shifts[ends[:, 1]] - shifts[ends[:, 0]]


def _groups(count: int, ends: IntArray, jumps: FloatArray) -> tuple[IntArray, FloatArray, NDArray[np.bool_]]:
    """Ends that must meet.

    Ends are paired by the smallest jumps first; an end without a partner then joins the nearest pair as a
    lane that opens or closes there. What is left leads across from one lane to another.

    Returns:
        [E] group of every end, [E] its offset in the group in m, [E] whether it is one of a pair.
    """
    group, offset = np.arange(count), np.zeros(count)
    tied, firm = np.zeros(count, bool), np.zeros(count, bool)
    order = np.argsort(np.abs(jumps), kind="stable")
    for k in order:
        a, b = ends[k]
        if not (tied[a] or tied[b]):
            tied[[a, b]] = firm[[a, b]] = True
            group[b], offset[b] = group[a], -jumps[k]
    for k in order:
        a, b = ends[k]
        if tied[a] and not tied[b]:
            group[b], offset[b], tied[b] = group[a], offset[a] - jumps[k], True
        elif tied[b] and not tied[a]:
            group[a], offset[a], tied[a] = group[b], offset[b] + jumps[k], True
    return group, offset, firm


def _at_rest(
    group: IntArray,
    offset: FloatArray,
    pull: FloatArray,
    first: IntArray,
    second: IntArray,
    spring: FloatArray,
) -> FloatArray:
    """[G] shift t of every group that minimises the springs' energy, by conjugate gradients.

    sum pull_e (offset_e + t_g(e))^2 + sum spring_k (offset_a + t_g(a) - offset_b - t_g(b))^2
    """
    a, b = group[first], group[second]
    apart = offset[first] - offset[second]
    count = len(group)

    def gathered(on_ends: FloatArray, on_springs: FloatArray) -> FloatArray:
        total = np.bincount(group, on_ends, count).astype(np.float64)
        return total + np.bincount(a, on_springs, count) - np.bincount(b, on_springs, count)

    between = np.where(a != b, spring, 0.0)
    diagonal = (
        np.bincount(group, pull, count) + np.bincount(a, between, count) + np.bincount(b, between, count)
    )
    diagonal = np.where(diagonal > 0.0, diagonal, 1.0)  # numbers that are no group
    t = np.zeros(count)
    residual = -gathered(pull * offset, spring * apart)
    step = residual / diagonal
    size = residual @ step
    for _ in range(1000):
        if np.abs(residual / diagonal).max() < PRECISION:
            break
        force = gathered(pull * step[group], spring * (step[a] - step[b]))
        rate = size / (step @ force)
        t += rate * step
        residual = residual - rate * force
        scaled = residual / diagonal
        size, before = residual @ scaled, size
        step = scaled + size / before * step
    return t


JUMP = 0.3  # m sideways at a junction that a vehicle is not asked to follow
BLEND = 15.0, 60.0  # m, shortest and longest blend at either side of a junction
BLEND_CURVATURE = 0.006  # 1/m that a blend reaches where it has the room: 5.4 m/s^2 at 30 m/s
COINCIDE = 0.5  # m: lanes whose ends are closer need no connector
TIGHT = 0.06  # rad/m that a connector turns at most; the lanes take the rest of a corner
GENTLE = 0.02, 0.35  # rad/m above which the lanes take up to some rad of a corner in any case
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
        gentle = min(abs(turn) - GENTLE[0] * reach, GENTLE[1])
        excess = float(np.sign(turn)) * max(abs(turn) - TIGHT * reach, gentle, 0.0)
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
