"""A road network as plain lanes: what any map format is read into before it becomes tensors.

The bridge fills these from SUMO networks; tests and toy roads fill them by hand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
DECIMALS = 6  # of coordinates in m that are moved: then the same road is the same wherever it was
FAR = 10_000.0  # m from the origin from where on coordinates are moved: float32 counts millimetres there


@dataclass(frozen=True)
class Lane:
    """One drivable lane (or one junction connector), centre line in driving direction.

    Attributes:
        id: SUMO lane id, e.g. ``"main_2"``; connectors keep the id of their first internal lane.
        edge: id of the edge (the connector's junction edge for connectors).
        points: [P, 2] centre line in m, no duplicate points, P >= 2.
        width: lane width in m.
        speed_limit: m/s.
        length: SUMO's length in m; may differ from the geometric length of ``points``.
        left, right: index into `LaneNetwork.lanes` of the lane abreast on that side *of the driver* to
            which a change is permitted, or -1.
        solid_left, solid_right: a lane of the same edge lies there but may not be changed into.
        allows_car, allows_truck: permissions by vehicle class.
        class_limits: (vehicle class, its own limit in m/s) where some have one.
        connector: True for a lane inside a junction.
        dead_start, dead_end: the lane begins or ends within the road (acceleration lane, lane drop), so a
            road edge closes it; a lane that merely has no predecessor or successor is open there.
        parts: (internal lane id, lane position where it starts in m) of a connector's chain.
        positions: [P] SUMO's lane position of each point in m, where ``points`` are not SUMO's own line;
            by default positions grow evenly from 0 to ``length``.
        start, end: ids of the junctions at its ends, "" where they are not known.
    """

    id: str
    edge: str
    points: FloatArray
    width: float
    speed_limit: float
    length: float
    left: int = -1
    right: int = -1
    solid_left: bool = False
    solid_right: bool = False
    allows_car: bool = True
    allows_truck: bool = True
    class_limits: tuple[tuple[str, float], ...] = ()
    connector: bool = False
    dead_start: bool = False
    dead_end: bool = False
    parts: tuple[tuple[str, float], ...] = ()
    positions: FloatArray | None = None
    start: str = ""
    end: str = ""


@dataclass(frozen=True)
class GeoReference:
    """Where the network lies on earth, as its file says it.

    Attributes:
        projection: PROJ string from WGS 84; "!" or "-" where the network has none.
        net_offset: "x,y" in m, added to projected coordinates.
    """

    projection: str
    net_offset: str

    def moved(self, x: float, y: float) -> GeoReference:
        """That of coordinates to which x, y in m are added; an offset that is none stays as it is."""
        try:
            east, north = (float(v) for v in self.net_offset.split(",")[:2])
        except ValueError:
            return self
        return replace(self, net_offset=f"{east + x!r},{north + y!r}")


@dataclass(frozen=True)
class LaneNetwork:
    """All drivable lanes of a network and how they follow each other.

    Attributes:
        name: shown in pictures and messages.
        lanes: see `Lane`.
        successors: (from, to) index pairs: the end of one lane is the start of the other.
        left_hand: traffic drives on the left.
        warnings: what was left out or repaired while reading.
        geo: where the network lies on earth, if its file says so.
        origin: m, what to add to get the coordinates of its file, from which far roads are moved: see `FAR`.
    """

    name: str
    lanes: tuple[Lane, ...]
    successors: tuple[tuple[int, int], ...]
    left_hand: bool = False
    warnings: tuple[str, ...] = ()
    geo: GeoReference | None = None
    origin: tuple[float, float] = (0.0, 0.0)

    def moved(self, x: float, y: float) -> LaneNetwork:
        """The same road with all points moved, and so what tells where it lies."""
        by = np.array((x, y))
        lanes = tuple(replace(lane, points=np.round(lane.points + by, DECIMALS)) for lane in self.lanes)
        origin = (self.origin[0] - x, self.origin[1] - y)
        return replace(self, lanes=lanes, geo=self.geo and self.geo.moved(x, y), origin=origin)


def away(points: np.ndarray) -> tuple[float, float]:
    """The middle of points [P, 2] some of which lie farther than `FAR` from the origin, else the origin."""
    if len(points) == 0 or np.abs(points).max() <= FAR:
        return 0.0, 0.0
    x, y = 0.5 * (points.min(0) + points.max(0))
    return float(x), float(y)
