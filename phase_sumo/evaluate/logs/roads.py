"""Roads of logs that come without a map: straight carriageways along the x axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lanes import Lane, LaneNetwork

FloatArray = NDArray[np.float64]
SPEED_LIMIT = 31.3  # m/s, 70 mph, where a log names none; nothing is measured against it


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
