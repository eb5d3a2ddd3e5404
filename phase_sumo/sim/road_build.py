"""Polylines and lane graph -> `RoadMap`: tables and their grid index."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.near import nearest, pairs_within, ranges
from phase_sumo.sim.road_map import (
    CELL_SIZE,
    CONTACT_REACH,
    SEGMENTS_PER_CELL,
    RoadKind,
    RoadMap,
)
from phase_sumo.sim.road_view import POINT_SPACING, view_points

FloatArray = NDArray[np.float64]
MARGIN = 30.0  # m around the lanes that the grid covers
OFF_ROAD = 5.5  # m from a cell's centre to the nearest lane centre: half a wide lane + half a cell's diagonal
FAR = 1.0e6  # m: where padding points and segments lie


@dataclass(frozen=True)
class RoadLine:
    """A border of one kind: ``points`` [P, 2] in m, P >= 2, in either direction."""

    kind: RoadKind
    points: FloatArray


@dataclass(frozen=True)
class RoadPoints:
    """Road points: xy [P, 2] m, unit direction [P, 2], kind [P]; lane centres come first.

    ``of_node`` [V] is the lane-centre point that stands for each node of the lane graph.
    """

    xy: FloatArray
    direction: FloatArray
    kind: NDArray[np.int64]
    of_node: NDArray[np.int64]


def build_road_map(lines: list[RoadLine], graph: LaneGraph) -> RoadMap:
    """Index lane boundaries and road edges by position.

    Args:
        lines: lane boundaries, solid boundaries and road edges.
        graph: gives lane centres, directions and what lies ahead.
    """
    points = _points(lines, graph)
    segment, segment_kind = _segments(lines)
    origin, shape, squares, node = _cells(graph)
    centre = origin + (np.stack(np.divmod(squares, shape[1]), -1) + 0.5) * CELL_SIZE
    grid = np.full(int(shape[0] * shape[1]), len(squares), np.int64)
    grid[squares] = np.arange(len(squares))
    used, inverse = np.unique(node, return_inverse=True)
    cell_points = view_points(graph, points.xy, points.kind, points.of_node, used)[inverse]
    padding = len(points.kind)
    yaw = graph.node_yaw[node]
    off_road = np.hypot(*(centre - graph.node_xy[node]).T) > OFF_ROAD
    return RoadMap(
        point_xy=_floats(np.concatenate((points.xy, [[FAR, FAR]]))),
        point_dir=_floats(np.concatenate((points.direction, [[1.0, 0.0]]))),
        point_kind=torch.from_numpy(np.append(points.kind, -1)),
        segment=_floats(np.concatenate((segment, [[FAR, FAR, FAR + 1.0, FAR]]))),
        segment_kind=torch.from_numpy(np.append(segment_kind, RoadKind.ROAD_EDGE).astype(np.int64)),
        cell_points=torch.from_numpy(_with_padding_row(cell_points, padding)),
        cell_segments=torch.from_numpy(
            _with_padding_row(_cell_segments(centre, segment, segment_kind), len(segment))
        ),
        cell_yaw=_floats(np.append(yaw, 0.0)),
        cell_off_road=torch.from_numpy(np.append(off_road, True)),
        grid=torch.from_numpy(grid),
        grid_offset=torch.zeros(1, dtype=torch.long),
        grid_origin=_floats(origin[None]),
        grid_shape=torch.from_numpy(shape[None]),
    )


def _floats(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _with_padding_row(table: NDArray[np.int64], padding: int) -> NDArray[np.int64]:
    table = np.where(table < 0, padding, table)
    return np.concatenate((table, np.full((1, table.shape[1]), padding)))


def _points(lines: list[RoadLine], graph: LaneGraph) -> RoadPoints:
    """Lane centres every fourth node, borders every `POINT_SPACING` metres."""
    first = np.concatenate(([0], np.flatnonzero(np.diff(graph.node_lane)) + 1))
    counts = np.diff(np.append(first, len(graph.node_lane)))
    chosen = ranges(counts) % round(POINT_SPACING) == 0
    of_node = np.cumsum(chosen) - 1
    xy = [graph.node_xy[chosen].astype(np.float64)]
    yaw = graph.node_yaw[chosen]
    direction = [np.stack((np.cos(yaw), np.sin(yaw)), -1)]
    kind = [np.full(len(yaw), int(RoadKind.LANE_CENTRE))]
    for line in lines:
        at, along = _along(line.points)
        xy.append(at)
        direction.append(_with_traffic(at, along, graph))
        kind.append(np.full(len(at), int(line.kind)))
    return RoadPoints(np.concatenate(xy), np.concatenate(direction), np.concatenate(kind), of_node)


def _along(line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points about `POINT_SPACING` m apart on a line and its unit direction there."""
    s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    wanted = np.linspace(0.0, s[-1], max(1, round(s[-1] / POINT_SPACING)) + 1)
    at = np.stack([np.interp(wanted, s, line[:, k]) for k in (0, 1)], axis=-1)
    piece = np.clip(np.searchsorted(s, wanted, "right") - 1, 0, len(line) - 2)
    delta = line[piece + 1] - line[piece]
    return at, delta / np.maximum(np.hypot(*delta.T), 1e-9)[:, None]


def _with_traffic(at: FloatArray, direction: FloatArray, graph: LaneGraph) -> FloatArray:
    """Directions turned round where they point against the nearest lane."""
    node, _ = nearest(at, graph.node_xy, 8.0)
    yaw = graph.node_yaw[node]
    against = (direction[:, 0] * np.cos(yaw) + direction[:, 1] * np.sin(yaw) < 0) & (node >= 0)
    return np.where(against[:, None], -direction, direction)


def _segments(lines: list[RoadLine]) -> tuple[FloatArray, NDArray[np.int64]]:
    """[S, 4] and [S] of all lines."""
    pieces = [np.concatenate((line.points[:-1], line.points[1:]), axis=1) for line in lines]
    kinds = [np.full(len(line.points) - 1, int(line.kind)) for line in lines]
    if not pieces:
        return np.zeros((0, 4)), np.zeros(0, np.int64)
    return np.concatenate(pieces), np.concatenate(kinds)


def _cells(graph: LaneGraph) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Grid squares near the lanes.

    Returns:
        origin [2] in m, shape [2], flat square index of each cell [C], its nearest node [C].
    """
    low = graph.node_xy.min(0).astype(np.float64) - MARGIN
    shape = np.ceil((graph.node_xy.max(0) + MARGIN - low) / CELL_SIZE).astype(np.int64)
    # only squares close to a node are looked at, so that a long network needs no full grid of queries
    home = ((graph.node_xy - low) // CELL_SIZE).astype(np.int64)
    reach = int(np.ceil(MARGIN / CELL_SIZE))
    near = np.zeros(shape, bool)
    near[home[:, 0], home[:, 1]] = True
    for axis in (0, 1):
        spread = near.copy()
        for shift in range(1, reach + 1):
            spread |= _shifted(near, shift, axis) | _shifted(near, -shift, axis)
        near = spread
    squares = np.flatnonzero(near)
    centre = low + (np.stack(np.divmod(squares, shape[1]), -1) + 0.5) * CELL_SIZE
    node, _ = nearest(centre, graph.node_xy, MARGIN)
    return low, shape, squares[node >= 0], node[node >= 0]


def _shifted(mask: NDArray[np.bool_], by: int, axis: int) -> NDArray[np.bool_]:
    result = np.roll(mask, by, axis)
    edge = [slice(None), slice(None)]
    edge[axis] = slice(0, by) if by > 0 else slice(by, None)
    result[tuple(edge)] = False
    return result


def _cell_segments(centre: FloatArray, segment: FloatArray, kind: NDArray[np.int64]) -> NDArray[np.int64]:
    """[C, G] segments within `CONTACT_REACH` of each cell centre, nearest first, -1 padded."""
    spacing = 4.0
    length = np.hypot(*(segment[:, 2:] - segment[:, :2]).T)
    count = np.ceil(length / spacing).astype(np.int64) + 1
    owner = np.repeat(np.arange(len(segment)), count)
    share = (ranges(count) / np.repeat(np.maximum(count - 1, 1), count))[:, None]
    samples = segment[owner, :2] * (1 - share) + segment[owner, 2:] * share
    cell, sample = pairs_within(centre, samples, CONTACT_REACH + spacing)
    pair = np.unique(cell * len(segment) + owner[sample])
    cell, index = np.divmod(pair, max(len(segment), 1))
    distance = point_segment_distance(centre[cell], segment[index])
    close = distance <= CONTACT_REACH
    cell, index, distance = cell[close], index[close], distance[close]
    crowded = np.bincount(cell, minlength=len(centre)) > SEGMENTS_PER_CELL
    if crowded.any():
        warnings.warn(
            f"{int(crowded.sum())} grid squares see more than {SEGMENTS_PER_CELL} border segments; "
            "the farthest lane boundaries there are ignored",
            stacklevel=3,
        )
    # a full square keeps its road edges and loses boundaries
    boundary_last = crowded[cell] & (kind[index] != RoadKind.ROAD_EDGE)
    order = np.lexsort((distance, boundary_last, cell))
    cell, index = cell[order], index[order]
    rank = ranges(np.bincount(cell, minlength=len(centre)))
    table = np.full((len(centre), SEGMENTS_PER_CELL), -1, np.int64)
    fits = rank < SEGMENTS_PER_CELL
    table[cell[fits], rank[fits]] = index[fits]
    return table


def point_segment_distance(point: FloatArray, segment: FloatArray) -> FloatArray:
    """[Q] distance in m from points [Q, 2] to segments [Q, 4]."""
    a, b = segment[:, :2], segment[:, 2:]
    along = b - a
    t = ((point - a) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
    foot = a + np.clip(t, 0.0, 1.0)[:, None] * along
    return np.hypot(*(point - foot).T)
