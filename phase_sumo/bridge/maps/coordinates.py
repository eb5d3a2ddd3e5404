"""Coordinates of a network <-> WGS 84, and <-> SUMO's lane id and lane position."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from pyproj import Proj
from pyproj.exceptions import ProjError
from shapely.geometry import LineString

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.bridge.maps.line_geometry import arc_length
from phase_sumo.errors import PhaseError
from phase_sumo.sim.lanes import GeoReference, Lane, LaneNetwork


class NetProjection:
    """Geographic reference of one network.

    Args:
        reference: of the network (`LaneNetwork.geo`), None where the file has no ``<location>``.
        name: of the network, for messages.

    Raises:
        PhaseError: the network has no projection, or one that pyproj does not know.
    """

    def __init__(self, reference: GeoReference | None, name: str) -> None:
        if reference is None or reference.projection in ("", "!", "-"):
            given = "no <location>" if reference is None else f"projParameter={reference.projection!r}"
            raise PhaseError(
                f"{name}: no geographic reference ({given}); import the network again with a projection "
                "(netconvert --proj.utm)"
            )
        try:
            x, y = (float(v) for v in reference.net_offset.split(",")[:2])
            if not np.isfinite((x, y)).all():
                raise ValueError
        except ValueError:
            raise PhaseError(
                f"{name}: netOffset={reference.net_offset!r}, expected 'x,y' in m; "
                "write the network again with netconvert"
            ) from None
        try:
            self._project = Proj(reference.projection)
        except ProjError as error:
            raise PhaseError(
                f"{name}: projParameter={reference.projection!r} is no projection "
                f"({' '.join(str(error).split())}); write the network again with netconvert"
            ) from error
        self._offset = x, y

    def to_xy(self, lon: ArrayLike, lat: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Network coordinates in m of longitudes and latitudes in degrees; inf where there are none."""
        x, y = self._project(np.asarray(lon, float), np.asarray(lat, float))
        return np.asarray(x) + self._offset[0], np.asarray(y) + self._offset[1]

    def to_lonlat(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Longitudes and latitudes in degrees of network coordinates in m; inf where there are none."""
        x, y = np.asarray(x, float) - self._offset[0], np.asarray(y, float) - self._offset[1]
        lon, lat = self._project(x, y, inverse=True)
        return np.asarray(lon), np.asarray(lat)


REACH = 10.0  # m: farther from every centre line is off the road
YAW_COST = 4.0  # m per rad when lanes compete
ITERATIONS = 12


class LanePositions:
    """Both ways between SUMO's lane coordinates and the plane, vectorised.

    Lane positions are SUMO's, in m from 0 to the lane's length, which need not be its geometric length.
    Where a centre line was smoothed, a position means the point of the smoothed line abreast of SUMO's
    point there; the two lie as far apart as the lines do. Everywhere else they are the same point.
    """

    def __init__(self, network: LaneNetwork) -> None:
        self._lines = [_LaneLine(lane) for lane in network.lanes]
        self._shapes = np.array([LineString(lane.points) for lane in network.lanes], object)
        self._tree = shapely.STRtree(self._shapes)
        self._lane = {lane.id: (i, 0.0) for i, lane in enumerate(network.lanes)}
        for i, lane in enumerate(network.lanes):  # several internal lanes may make one connector
            self._lane |= {part: (i, start) for part, start in lane.parts}

    def xy(self, lane_id: Iterable[str], position: ArrayLike, offset: ArrayLike = 0.0) -> FloatArray:
        """[n, 2] points in m.

        Args:
            lane_id: [n] SUMO lane ids, internal ones included.
            position: [n] lane positions in m, held within the lane.
            offset: [n] or one, m to the left of the centre line.

        Raises:
            PhaseError: a lane is not in the network.
        """
        index, start = self._indices(lane_id)
        position = np.broadcast_to(np.asarray(position, float), index.shape) + start
        offset = np.broadcast_to(np.asarray(offset, float), index.shape)
        result = np.zeros((len(index), 2))
        for i, rows in _grouped(index):
            result[rows] = self._lines[i].point(position[rows], offset[rows])
        return result

    def on_lane(self, lane_id: Iterable[str], xy: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """[n] lane positions and [n] offsets to the left in m of points [n, 2], each on its given lane."""
        index, start = self._indices(lane_id)
        position, offset = self._project(index, np.asarray(xy, float).reshape(-1, 2))
        return position - start, offset

    def locate(self, xy: ArrayLike, yaw: ArrayLike | None = None) -> tuple[list[str], FloatArray, FloatArray]:
        """The lane under each point.

        Args:
            xy: [n, 2] in m.
            yaw: [n] directions in rad, which decide between lanes that cross or touch.

        Returns:
            [n] lane ids ("" more than 10 m off every lane), [n] lane positions and [n] offsets to the
            left in m (NaN there).
        """
        xy = np.asarray(xy, float).reshape(-1, 2)
        points: NDArray[Any] = shapely.points(xy)  # type: ignore[assignment]  # an array for an array
        row, lane = self._tree.query(points, predicate="dwithin", distance=REACH)
        cost = shapely.distance(points[row], self._shapes[lane])
        if yaw is not None:
            own = np.zeros(len(row))
            for i, rows in _grouped(lane):
                own[rows] = self._lines[i].yaw(shapely.line_locate_point(self._shapes[i], points[row[rows]]))
            turn = np.asarray(yaw, float).reshape(-1)[row] - own
            cost = cost + YAW_COST * np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        order = np.lexsort((cost, row))
        found, first = np.unique(row[order], return_index=True)
        index = lane[order][first]
        position, offset = np.full(len(xy), np.nan), np.full(len(xy), np.nan)
        names = [""] * len(xy)
        position[found], offset[found] = self._project(index, xy[found])
        for k, i in zip(found, index, strict=True):
            names[k], position[k] = self._lines[i].part(position[k])
        return names, position, offset

    def _indices(self, lane_id: Iterable[str]) -> tuple[IntArray, FloatArray]:
        try:
            found = [self._lane[name] for name in lane_id]
        except KeyError as error:
            raise PhaseError(
                f"lane {error} is not in the network; pass the id of a lane that was kept"
            ) from None
        return np.array([i for i, _ in found], np.int64), np.array([start for _, start in found])

    def _project(self, index: IntArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        position, offset = np.zeros(len(xy)), np.zeros(len(xy))
        along = shapely.line_locate_point(self._shapes[index], shapely.points(xy))
        for i, rows in _grouped(index):
            position[rows], offset[rows] = self._lines[i].project(along[rows], xy[rows])
        return position, offset


class _LaneLine:
    """One centre line: points, distance along it and SUMO's position at each point."""

    def __init__(self, lane: Lane) -> None:
        self.points = lane.points
        self.along = arc_length(lane.points)
        even = self.along / self.along[-1] * lane.length
        self.positions = even if lane.positions is None else lane.positions
        delta = np.diff(lane.points, axis=0)
        unit = delta / np.hypot(*delta.T)[:, None]
        bisector = unit[:-1] + unit[1:]
        bisector /= np.maximum(np.hypot(*bisector.T), 1e-9)[:, None]
        self.unit = np.concatenate((unit[:1], bisector, unit[-1:]))
        self.parts = lane.parts or ((lane.id, 0.0),)

    def point(self, position: FloatArray, offset: FloatArray) -> FloatArray:
        at, unit = self._frame(np.interp(position, self.positions, self.along))
        return at + offset[:, None] * np.stack((-unit[:, 1], unit[:, 0]), -1)

    def project(self, along: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position and offset of points, from the distance along the line of the points nearest to them."""
        for _ in range(ITERATIONS):  # to where the line's direction, turning evenly, is square to the offset
            at, unit = self._frame(along)
            along = np.clip(along + ((xy - at) * unit).sum(1), 0.0, self.along[-1])
        at, unit = self._frame(along)
        left = unit[:, 0] * (xy - at)[:, 1] - unit[:, 1] * (xy - at)[:, 0]
        return np.interp(along, self.along, self.positions), left

    def yaw(self, along: FloatArray) -> FloatArray:
        _, unit = self._frame(along)
        return np.arctan2(unit[:, 1], unit[:, 0])

    def part(self, position: float) -> tuple[str, float]:
        """The internal lane of a connector, and the position on it."""
        at = sum(position >= start for _, start in self.parts[1:])
        name, start = self.parts[at]
        return name, position - start

    def _frame(self, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """[n, 2] points and [n, 2] unit directions, which turn evenly from point to point."""
        x, y, u, v = (
            np.interp(along, self.along, column) for column in np.hstack((self.points, self.unit)).T
        )
        return np.stack((x, y), -1), np.stack((u, v), -1) / np.maximum(np.hypot(u, v), 1e-9)[:, None]


def _grouped(index: IntArray) -> list[tuple[int, IntArray]]:
    """(value, rows that hold it)."""
    order = np.argsort(index, kind="stable")
    values, first = np.unique(index[order], return_index=True)
    return list(zip(values.tolist(), np.split(order, first[1:]), strict=True)) if len(index) else []
