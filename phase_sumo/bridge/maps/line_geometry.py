"""Polylines: arc length, resampling, smooth curves."""

from __future__ import annotations

import itertools

import numpy as np
import shapely
from shapely.geometry import LineString

from phase_sumo.arrays import FloatArray

KINK = 0.05  # rad: sharper corners of a lane are rounded
ROUNDING = 15.0  # m at either side of a corner over which it is rounded at most
SHORTEST_CHORD = 5.0  # m: corners closer together count as one curve
SPIKE = 2.6  # rad: no road turns by this much in one point
DETAIL = 0.1  # m: smaller wiggles between corners are dropped when a lane is rounded


def without_duplicates(points: FloatArray, closer: float = 0.02) -> FloatArray:
    """Points without those closer than ``closer`` m to the one before; the last point stays."""
    if (np.hypot(*np.diff(points, axis=0).T) > closer).all():
        return points
    keep = [0]
    for i in range(1, len(points)):
        if np.hypot(*(points[i] - points[keep[-1]])) > closer:
            keep.append(i)
    if keep[-1] != len(points) - 1 and len(keep) > 1:
        keep[-1] = len(points) - 1
    return points[keep]


def without_spikes(points: FloatArray) -> FloatArray:
    """Points without duplicates and without those at which the line turns back on itself."""
    points = without_duplicates(points)
    while len(points) > 2 and (back := np.abs(corners(points)) > SPIKE).any():
        points = without_duplicates(np.delete(points, int(back.argmax()) + 1, axis=0))
    return points


def arc_length(points: FloatArray) -> FloatArray:
    """[P] distance of each point from the first along the line, in m."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))


def between(points: FloatArray, start: float, end: float) -> FloatArray:
    """The part of a line from ``start`` to ``end`` m along it."""
    s = arc_length(points)
    ends = np.stack([np.interp((start, end), s, points[:, k]) for k in (0, 1)], axis=-1)
    return np.concatenate((ends[:1], points[(s > start + 0.02) & (s < end - 0.02)], ends[1:]))


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


def tangents(points: FloatArray) -> FloatArray:
    """[P, 2] unit direction at every point."""
    delta = np.gradient(points, axis=0)
    return delta / np.maximum(np.linalg.norm(delta, axis=1), 1e-9)[:, None]


def normals(points: FloatArray) -> FloatArray:
    """[P, 2] unit normal at every point, to the left."""
    direction = tangents(points)
    return np.stack((-direction[:, 1], direction[:, 0]), axis=-1)


def heading(vector: FloatArray) -> float:
    """Angle in rad of one vector [2]."""
    return float(np.arctan2(vector[1], vector[0]))


def wrap(angle: float) -> float:
    """Angle in -pi..pi."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def corners(points: FloatArray) -> FloatArray:
    """[P - 2] heading change in rad at every inner point."""
    delta = np.diff(points, axis=0)
    turn = np.diff(np.arctan2(delta[:, 1], delta[:, 0]))
    return (turn + np.pi) % (2 * np.pi) - np.pi


def rounded(points: FloatArray, start_yaw: float, end_yaw: float) -> FloatArray:
    """The line with its corners rounded, through the same points and with the given end directions.

    Coarsely digitised ramps turn by up to 0.6 rad in one point; no trailer follows that. A cubic spline
    through the points has no corner, and stays on the straight pieces further than `ROUNDING` from one.
    """
    turns = corners(points)
    off_start = wrap(start_yaw - heading(points[1] - points[0]))
    off_end = wrap(end_yaw - heading(points[-1] - points[-2]))
    if max(abs(off_start), abs(off_end), float(np.abs(turns).max(initial=0.0))) < KINK:
        return points
    knots = _knots(points)
    chord = np.hypot(*np.diff(knots, axis=0).T)
    unit = np.diff(knots, axis=0) / chord[:, None]
    # at a knot the shorter chord decides the direction, as in a circle through three points
    tangent = np.concatenate((unit[:1], unit[:-1] * chord[1:, None] + unit[1:] * chord[:-1, None], unit[-1:]))
    tangent[0], tangent[-1] = (np.cos(start_yaw), np.sin(start_yaw)), (np.cos(end_yaw), np.sin(end_yaw))
    tangent /= np.hypot(*tangent.T)[:, None]
    pieces = [hermite(knots[i], knots[i + 1], tangent[i], tangent[i + 1])[1:] for i in range(len(knots) - 1)]
    return without_duplicates(np.concatenate((knots[:1], *pieces)))


def _knots(points: FloatArray) -> FloatArray:
    """Corner points thinned to `SHORTEST_CHORD`, with extra ones `ROUNDING` m beside on long straights."""
    line = np.asarray(shapely.simplify(LineString(points), DETAIL).coords)
    keep = [0]
    for i in range(1, len(line) - 1):
        if np.hypot(*(line[i] - line[keep[-1]])) >= SHORTEST_CHORD:
            keep.append(i)
    if len(keep) > 1 and np.hypot(*(line[-1] - line[keep[-1]])) < SHORTEST_CHORD:
        keep.pop()
    line = line[[*keep, len(line) - 1]]
    knots = [line[0]]
    for a, b in itertools.pairwise(line):
        length = float(np.hypot(*(b - a)))
        if length > 2.5 * ROUNDING:
            share = ROUNDING / length
            knots += [a + share * (b - a), b - share * (b - a)]
        knots.append(b)
    return np.array(knots)
