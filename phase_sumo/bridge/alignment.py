"""Smooth lane ends at junctions, so that a tractor with a trailer can follow every centre line.

Real networks shift lanes sideways at junctions, by up to a lane width within 5 m. Here the ends of the
lanes are moved towards each other, blended over `BLEND` metres, and the connector between them becomes a
smooth curve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phase_sumo.bridge.net_xml import XmlLane

FloatArray = NDArray[np.float64]
JUMP = 0.3  # m sideways at a junction that a vehicle is not asked to follow
BLEND = 15.0, 30.0  # m, shortest and longest blend at either side of a junction
BLEND_PER_METRE = 16.0  # m of blend per metre of sideways shift
RIGID = 40.0  # m: a shorter lane has no room for two blends and moves as a whole
COINCIDE = 0.5  # m: lanes whose ends are closer need no connector


@dataclass(frozen=True)
class Connector:
    """From one lane's end to another lane's start; ``line`` is None where they coincide."""

    source: int
    target: int
    chain: tuple[XmlLane, ...] = ()
    line: FloatArray | None = None


def without_duplicates(points: FloatArray, closer: float = 0.02) -> FloatArray:
    """Points without those closer than ``closer`` m to the one before; the last point stays."""
    keep = [0]
    for i in range(1, len(points)):
        if np.hypot(*(points[i] - points[keep[-1]])) > closer:
            keep.append(i)
    if keep[-1] != len(points) - 1 and len(keep) > 1:
        keep[-1] = len(points) - 1
    return points[keep]


def arc_length(points: FloatArray) -> FloatArray:
    """[P] distance of each point from the first along the line, in m."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))


def resample(points: FloatArray, step: float) -> FloatArray:
    """The same line with points about ``step`` m apart; its own corners are kept only by chance."""
    s = arc_length(points)
    wanted = np.linspace(0.0, s[-1], max(1, round(s[-1] / step)) + 1)
    return np.stack([np.interp(wanted, s, points[:, k]) for k in (0, 1)], axis=-1)


def hermite(start: FloatArray, end: FloatArray, start_dir: FloatArray, end_dir: FloatArray) -> FloatArray:
    """Cubic from ``start`` to ``end`` tangent to the unit directions there, points about 1 m apart."""
    reach = float(np.hypot(*(end - start)))
    t = np.linspace(0.0, 1.0, max(2, round(reach)) + 1)[:, None]
    h00, h10 = 2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t
    h01, h11 = -2 * t**3 + 3 * t**2, t**3 - t**2
    return h00 * start + h10 * reach * start_dir + h01 * end + h11 * reach * end_dir


def direction(points: FloatArray, at_end: bool, over: float = 3.0) -> FloatArray:
    """Unit direction of a line over its first or last ``over`` metres."""
    line = points if at_end else points[::-1]
    s = arc_length(line)
    back = max(s[-1] - over, 0.0)
    other = np.array([np.interp(back, s, line[:, k]) for k in (0, 1)])
    delta = (line[-1] - other) if at_end else (other - line[-1])
    return delta / np.hypot(*delta)


def align(
    lines: list[FloatArray], connectors: list[Connector]
) -> tuple[list[FloatArray], list[Connector], int]:
    """Move lane ends until no connector jumps sideways, then draw the connectors.

    Returns:
        lines, connectors with their ``line``, and how many connections had a jump.
    """
    jumps = np.array([_jump(lines, c) for c in connectors])
    moved = int((np.abs(jumps) > JUMP).sum())
    if moved:
        shifts = _shifts(lines, connectors, jumps)
        lines = [
            _shifted(line, shifts[2 * i], shifts[2 * i + 1]) for i, line in enumerate(lines)
        ]
    drawn = [_drawn(lines, c, bool(abs(jump) > JUMP)) for c, jump in zip(connectors, jumps, strict=True)]
    return lines, drawn, moved


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


def _shifts(lines: list[FloatArray], connectors: list[Connector], jumps: NDArray[np.float64]) -> FloatArray:
    """[2 * lanes] sideways shift of every lane's start (even) and end (odd), positive left.

    Lane ends that are connected form groups that move rigidly against each other, joined in the order of
    the smallest jump, so that the straight-on connection decides where a lane also forks. Each group is
    then placed where its lanes move least.
    """
    offset = np.zeros(2 * len(lines))
    group = np.arange(2 * len(lines))
    ties = [(2 * i, 2 * i + 1, 0.0) for i, line in enumerate(lines) if arc_length(line)[-1] < RIGID]
    order = np.argsort(np.abs(jumps), kind="stable")
    ties += [(2 * connectors[k].source + 1, 2 * connectors[k].target, -float(jumps[k])) for k in order]
    for a, b, step in ties:
        if group[a] == group[b]:
            continue
        members = group == group[b]
        offset[members] += offset[a] + step - offset[b]
        group[members] = group[a]
    for g in np.unique(group):
        members = group == g
        low, high = np.percentile(offset[members], [50, 50], method="lower"), np.percentile(
            offset[members], [50, 50], method="higher"
        )
        offset[members] -= 0.5 * (low[0] + high[0])
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
        shift = at_start * _smooth(1 - s / _blend(at_start)) + at_end * _smooth(1 - (s[-1] - s) / _blend(at_end))
    tangent = np.gradient(fine, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    return fine + shift[:, None] * np.stack((-tangent[:, 1], tangent[:, 0]), axis=-1)


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
    """No corner sharper than a heading change of 0.15 rad."""
    delta = np.diff(line, axis=0)
    yaw = np.unwrap(np.arctan2(delta[:, 1], delta[:, 0]))
    return bool((np.abs(np.diff(yaw)) < 0.15).all())
