"""Smooth lane ends at junctions, so that a tractor with a trailer can follow every centre line.

Real networks shift lanes sideways at junctions, by up to a lane width within 5 m. Here the ends of the
lanes are moved towards each other, blended over `BLEND` metres, and the connector between them becomes a
smooth curve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phase_sumo.bridge.lines import (
    arc_length,
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
from phase_sumo.bridge.net_xml import XmlLane

FloatArray = NDArray[np.float64]
JUMP = 0.3  # m sideways at a junction that a vehicle is not asked to follow
BLEND = 15.0, 30.0  # m, shortest and longest blend at either side of a junction
BLEND_PER_METRE = 16.0  # m of blend per metre of sideways shift
RIGID = 40.0  # m: a shorter lane has no room for two blends and moves as a whole
COINCIDE = 0.5  # m: lanes whose ends are closer need no connector
TIGHT = 0.1  # rad/m that a connector turns at most; the lanes take the rest of a corner
SAME_ROAD = 1.2  # rad: larger turns at a junction are turns into another road
CORNER = 0.15  # rad: a connector with a sharper corner is drawn anew


@dataclass(frozen=True)
class Connector:
    """From one lane's end to another lane's start; ``line`` is None where they coincide."""

    source: int
    target: int
    chain: tuple[XmlLane, ...] = ()
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
        lines, connectors with their ``line``, and how many connections had a jump.
    """
    yaws = _end_yaws(lines, connectors)
    lines = [rounded(line, yaws[2 * i], yaws[2 * i + 1]) for i, line in enumerate(lines)]
    jumps = np.array([_jump(lines, c) for c in connectors])
    moved = int((np.abs(jumps) > JUMP).sum())
    if moved:
        shifts = _shifts(lines, connectors, jumps, abreast)
        lines = [_shifted(line, shifts[2 * i], shifts[2 * i + 1]) for i, line in enumerate(lines)]
    drawn = [_drawn(lines, c, bool(abs(jump) > JUMP)) for c, jump in zip(connectors, jumps, strict=True)]
    return lines, drawn, moved


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


def _jump(lines: list[FloatArray], c: Connector) -> float:
    """Sideways offset in m (positive left) that a connector must bridge; 0 where it has room for it.

    Measured across the mean of the two lanes' directions: an arc from one to the other has none.
    """
    a, b = lines[c.source], lines[c.target]
    mean = direction(a, at_end=True) + direction(b, at_end=False)
    size = float(np.hypot(*mean))
    if size < 1e-3:
        return 0.0
    gap = b[0] - a[-1]
    across = float(mean[0] * gap[1] - mean[1] * gap[0]) / size
    along = float(mean @ gap) / size
    return 0.0 if along > BLEND_PER_METRE * abs(across) else across


def _shifts(
    lines: list[FloatArray],
    connectors: list[Connector],
    jumps: NDArray[np.float64],
    abreast: list[tuple[int, int]],
) -> FloatArray:
    """[2 * lanes] sideways shift of every lane's start (even) and end (odd), positive left.

    Lane ends that are connected form groups that move rigidly against each other, joined in the order of
    the smallest jump, so that the straight-on connection decides where a lane also forks. Lanes abreast
    then join their groups, and each group is placed where its lanes move least.
    """
    offset = np.zeros(2 * len(lines))
    group = np.arange(2 * len(lines))
    ties = [(2 * i, 2 * i + 1, 0.0) for i, line in enumerate(lines) if arc_length(line)[-1] < RIGID]
    order = np.argsort(np.abs(jumps), kind="stable")
    ties += [(2 * connectors[k].source + 1, 2 * connectors[k].target, -float(jumps[k])) for k in order]
    ties += [(2 * i + end, 2 * j + end, 0.0) for i, j in abreast for end in (0, 1)]
    for a, b, step in ties:
        if group[a] == group[b]:
            continue
        members = group == group[b]
        offset[members] += offset[a] + step - offset[b]
        group[members] = group[a]
    for g in np.unique(group):
        members = group == g
        offset[members] -= np.median(offset[members])
    return offset


def _shifted(line: FloatArray, at_start: float, at_end: float) -> FloatArray:
    """The line with its ends moved sideways, blended with a quintic (no step in direction or curvature)."""
    if max(abs(at_start), abs(at_end)) < 1e-3:
        return line
    fine = resample(line, 1.0)
    s = arc_length(fine)
    if s[-1] < RIGID:
        weight = _smooth(s / s[-1])
        shift = at_start * (1 - weight) + at_end * weight
    else:
        shift = at_start * _smooth(1 - s / _blend(at_start))
        shift += at_end * _smooth(1 - (s[-1] - s) / _blend(at_end))
    return fine + shift[:, None] * normals(fine)


def _blend(shift: float) -> float:
    return float(np.clip(BLEND_PER_METRE * abs(shift), *BLEND))


def _smooth(t: FloatArray) -> FloatArray:
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


def _drawn(lines: list[FloatArray], c: Connector, jumped: bool) -> Connector:
    a, b = lines[c.source], lines[c.target]
    if not c.chain and np.hypot(*(b[0] - a[-1])) < COINCIDE:
        return c
    if c.chain and not jumped:
        inner = np.concatenate([part.points for part in c.chain])
        line = without_duplicates(np.concatenate((a[-1:], inner, b[:1])), closer=0.2)
        if len(line) >= 2 and _straight_enough(line):
            return replace(c, line=line)
    line = hermite(a[-1], b[0], direction(a, at_end=True), direction(b, at_end=False))
    line = without_duplicates(line)
    return replace(c, line=line) if len(line) >= 2 else c


def _straight_enough(line: FloatArray) -> bool:
    return bool((np.abs(corners(line)) < CORNER).all())
