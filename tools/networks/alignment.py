"""Plan views of roads: straights, arcs and the clothoids between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Pose = tuple[float, float, float]  # x, y in m, yaw in rad
Line = list[tuple[float, float]]
REACH = 3000.0  # m: the last piece goes on up to here
AWAY = 320.0  # m, radius by which a ramp turns away from the road
GAUSS = ((0.5 - math.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + math.sqrt(0.15), 5 / 18))


class Road(Protocol):
    """The left border of a carriageway, which everything else is measured from."""

    def at(self, s: float, offset: float = 0.0) -> Pose:
        """Pose ``s`` m along the road and ``offset`` m to its right."""
        ...

    def curvature(self, s: float) -> float:
        """1/m, positive to the left."""
        ...


@dataclass(frozen=True)
class Alignment:
    """Pieces of constant curvature, one after the other.

    Attributes:
        pieces: (length in m, radius in m); radius 0 is straight, positive turns left. The last goes on.
        start: pose at arc length 0.
        spiral: m over which the curvature changes linearly (a clothoid) from each piece to the next.
    """

    pieces: tuple[tuple[float, float], ...]
    start: Pose = (0.0, 0.0, 0.0)
    spiral: float = 0.0

    def at(self, s: float, offset: float = 0.0) -> Pose:
        k = int(np.searchsorted(self._grid, s, side="right")) - 1
        x, y, yaw = _advanced(self._poses[k], self._bends[k], s - self._grid[k])
        return x + offset * math.sin(yaw), y - offset * math.cos(yaw), yaw

    def curvature(self, s: float) -> float:
        return float(np.interp(s, *self._knots))

    @cached_property
    def _knots(self) -> NDArray[np.float64]:
        """[2, n] arc lengths and the curvatures there in 1/m."""
        bends = [1.0 / radius if radius else 0.0 for _, radius in self.pieces]
        borders = np.cumsum([length for length, _ in self.pieces])[:-1]
        knots = [(0.0, bends[0])]
        for border, before, after in zip(borders, bends, bends[1:], strict=False):
            knots += [(border - 0.5 * self.spiral, before), (border + 0.5 * self.spiral, after)]
        return np.array(knots).T

    @cached_property
    def _grid(self) -> NDArray[np.float64]:
        """Arc lengths every metre and at all knots: the curvature is linear in between."""
        return np.unique(np.concatenate((np.arange(0.0, REACH), self._knots[0])))

    @cached_property
    def _bends(self) -> list[tuple[float, float]]:
        """Curvature in 1/m at the start of every grid interval and its slope in 1/m^2."""
        step = np.append(np.diff(self._grid), 1.0)
        # values inside the interval, as the curvature may jump at its ends
        near = np.interp(self._grid + 0.25 * step, *self._knots)
        far = np.interp(self._grid + 0.75 * step, *self._knots)
        return list(
            zip((1.5 * near - 0.5 * far).tolist(), ((far - near) / (0.5 * step)).tolist(), strict=True)
        )

    @cached_property
    def _poses(self) -> list[Pose]:
        poses = [self.start]
        for bend, step in zip(self._bends, np.diff(self._grid), strict=False):
            poses.append(_advanced(poses[-1], bend, float(step)))
        return poses


def _advanced(pose: Pose, bend: tuple[float, float], step: float) -> Pose:
    """The pose ``step`` m further on a clothoid."""
    x, y, yaw = pose
    curvature, slope = bend
    for share, weight in GAUSS:
        t = share * step
        towards = yaw + curvature * t + 0.5 * slope * t * t
        x, y = x + weight * step * math.cos(towards), y + weight * step * math.sin(towards)
    return x, y, yaw + curvature * step + 0.5 * slope * step * step


@dataclass(frozen=True)
class Opposite:
    """The other carriageway of ``road``: its left border, seen from the other direction.

    Attributes:
        length: m of the road; the opposite one starts there.
        median: m between the two left borders.
    """

    road: Road
    length: float
    median: float

    def at(self, s: float, offset: float = 0.0) -> Pose:
        x, y, yaw = self.road.at(self.length - s, -self.median - offset)
        return x, y, yaw + math.pi

    def curvature(self, s: float) -> float:
        return -self.road.curvature(self.length - s)


def line(
    road: Road,
    start: float,
    end: float,
    offset: float | Callable[[float], float] = 0.0,
    step: float = 10.0,
) -> Line:
    """Points about ``step`` m apart, ``offset`` m (or a function of arc length) to the right of the road."""
    count = max(1, round(abs(end - start) / step))
    places = [start + (end - start) * i / count for i in range(count + 1)]
    return [road.at(s, offset(s) if callable(offset) else offset)[:2] for s in places]


def blend(t: float) -> float:
    """0 to 1 for t from 0 to 1, without a step in direction or curvature."""
    t = min(max(t, 0.0), 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


@dataclass(frozen=True)
class RampShape:
    """How a ramp leaves a road or, run backwards, joins it.

    Attributes:
        length: m.
        radius: m, of its tightest curve.
        speed: m/s.
        angle: rad at which it leaves the road; 0: by a curve of twice ``radius``.
        loop: a single curve follows at once, as in a cloverleaf, else a straight comes first.
        left: it lies left of the road.
        spiral: m of clothoid between its curves.
    """

    length: float = 180.0
    radius: float = 180.0
    speed: float = 17.0
    angle: float = 0.0
    loop: bool = False
    left: bool = False
    spiral: float = 0.0

    def line(self, road: Road, s: float, offset: float, leaving: bool) -> Line:
        """Its centre line, in driving direction, which touches the road's parallel at ``s`` tangentially."""
        x, y, yaw = road.at(s, offset)
        side, bend = (1.0 if self.left == leaving else -1.0), road.curvature(s)
        if leaving:
            return line(
                Alignment(self._pieces(side, bend), (x, y, yaw), self.spiral), 0.0, self.length, step=8.0
            )
        course = Alignment(self._pieces(side, -bend), (x, y, yaw + math.pi), self.spiral)
        return line(course, 0.0, self.length, step=8.0)[::-1]

    def _pieces(self, side: float, bend: float) -> tuple[tuple[float, float], ...]:
        """Away from the road, whose curvature is ``bend`` in 1/m, to the left (``side`` 1) or right (-1)."""
        last = (self.length, side * self.radius)
        if not self.angle:
            first, second = 0.3 * self.length, 0.2 * self.length
            return (12.0, 0.0), (first, 2.0 * side * self.radius), (second, 0.0), last
        along = 1.0 / bend if bend else 0.0
        away = (self.angle * AWAY, 1.0 / (bend + side / AWAY))
        beside = () if self.loop else ((0.25 * self.length, along),)
        return (12.0 + 0.5 * self.spiral, along), away, *beside, last
