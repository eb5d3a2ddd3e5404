"""Polylines and lane graph -> `RoadMap`: tables and their grid index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.near import nearest
from phase_sumo.sim.polylines import Polylines
from phase_sumo.sim.road_cells import OFF_ROAD, cell_segments, cells
from phase_sumo.sim.road_map import ABSENT, BLOCK, FAR, RoadKind, RoadMap, merge
from phase_sumo.sim.road_view import POINT_SPACING, RoadView

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RoadLine:
    """A border of one kind: ``points`` [P, 2] in m, P >= 2, in either direction, in one layer of the map."""

    kind: RoadKind
    points: FloatArray
    layer: int = 0


@dataclass(frozen=True)
class RoadPoints:
    """Road points: xy [P, 2] m, unit direction [P, 2], kind and layer [P]; lane centres come first.

    ``of_node`` [V] is the lane-centre point that stands for each node of the lane graph.
    """

    xy: FloatArray
    direction: FloatArray
    kind: NDArray[np.int64]
    layer: NDArray[np.int64]
    of_node: NDArray[np.int64]


def build_road_map(
    lines: list[RoadLine], graph: LaneGraph, layer: NDArray[np.int64] | None = None
) -> RoadMap:
    """Index lane boundaries and road edges by position.

    Args:
        lines: lane boundaries, solid boundaries and road edges.
        graph: gives lane centres, directions and what lies ahead.
        layer: [V] of each node where roads lie over each other, by default 0.

    Returns:
        A map for every layer, side by side.
    """
    layer = np.zeros(len(graph.node_lane), np.int64) if layer is None else layer
    points = road_points(lines, graph, layer)
    view = RoadView(graph, points.xy, points.kind, points.of_node, points.layer)
    maps = [
        _layer_map(
            [line for line in lines if line.layer == k], graph, np.flatnonzero(layer == k), points, view
        )
        for k in range(int(layer.max()) + 1)
    ]
    return maps[0] if len(maps) == 1 else merge(maps)


def _layer_map(
    lines: list[RoadLine], graph: LaneGraph, nodes: NDArray[np.int64], points: RoadPoints, view: RoadView
) -> RoadMap:
    segment, segment_kind = _segments(lines)
    grid, slot, node = cells(graph, nodes)
    squares = np.full(BLOCK**2 + grid.slots, len(slot))
    squares[BLOCK**2 + slot] = np.arange(len(slot))
    off_road = np.hypot(*(grid.centre(grid.square(slot)) - graph.node_xy[node]).T) > OFF_ROAD
    looked_from = np.bincount(node, minlength=len(graph.node_lane)) > 0
    seen = view.points(np.flatnonzero(looked_from))
    row = (np.cumsum(looked_from) - 1)[node]  # of each cell
    near = cell_segments(grid, slot, segment, segment_kind)
    in_reach = (near >= 0).sum(1)
    touched = in_reach > 0
    border_row = np.where(touched, np.cumsum(touched) - 1, touched.sum())
    return RoadMap(
        view=view_rows(seen, np.column_stack((points.xy, points.direction)), points.kind),
        border=view_rows(near[touched, : in_reach.max(initial=1)], segment, segment_kind),
        cell_view=torch.from_numpy(np.append(row, len(seen))),
        cell_border=torch.from_numpy(np.append(border_row, touched.sum())),
        cell_yaw=_floats(np.append(graph.node_yaw[node], 0.0)),
        cell_node=_floats(np.concatenate((graph.node_xy[node], [[FAR, FAR]]))),
        cell_off_road=torch.from_numpy(np.append(off_road, True)),
        grid=torch.from_numpy(squares),
        grid_block=torch.from_numpy(np.append((grid.block + 1) * BLOCK**2, 0)),
        grid_offset=torch.zeros(1, dtype=torch.long),
        grid_origin=_floats(grid.origin[None]),
        grid_shape=torch.tensor([grid.block.shape]),
    )


def _floats(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def view_rows(index: NDArray[np.int32], values: FloatArray, kind: NDArray[np.int64]) -> torch.Tensor:
    """[n + 1, 5, k] the values that index [n, k] points to, empty for -1 and in the last row."""
    empty = np.array([[FAR], [FAR], [FAR], [FAR], [ABSENT]])
    columns = np.concatenate((np.column_stack((values, kind)).T, empty), 1).astype(np.float32)
    rows = np.empty((len(index) + 1, 5, index.shape[1]), np.float32)
    rows[-1] = empty
    for k, column in enumerate(columns):
        np.take(column, index, out=rows[:-1, k], mode="wrap")  # -1 is the empty one at the end
    return torch.from_numpy(rows)


def road_points(lines: list[RoadLine], graph: LaneGraph, layer: NDArray[np.int64]) -> RoadPoints:
    """Lane centres every fourth node, borders every `POINT_SPACING` metres."""
    chosen = (np.arange(len(graph.node_lane)) - graph.lane_start) % round(POINT_SPACING) == 0
    yaw = graph.node_yaw[chosen]
    borders = Polylines.of([line.points for line in lines])
    samples = borders.samples(POINT_SPACING)
    at = borders.at(samples)
    kinds = np.array([int(line.kind) for line in lines], np.int64)
    layers = np.repeat(np.array([line.layer for line in lines], np.int64), samples.counts)
    return RoadPoints(
        xy=np.concatenate((graph.node_xy[chosen].astype(np.float64), at)),
        direction=np.concatenate(
            (
                np.stack((np.cos(yaw), np.sin(yaw)), -1),
                _with_traffic(at, borders.direction(samples), graph, layers, layer),
            )
        ),
        kind=np.concatenate((np.full(len(yaw), int(RoadKind.LANE_CENTRE)), np.repeat(kinds, samples.counts))),
        layer=np.concatenate((layer[chosen], layers)),
        of_node=np.cumsum(chosen) - 1,
    )


def _with_traffic(
    at: FloatArray,
    direction: FloatArray,
    graph: LaneGraph,
    layer: NDArray[np.int64],
    node_layer: NDArray[np.int64],
) -> FloatArray:
    """Directions turned round where they point against the nearest lane of their layer."""
    node = np.full(len(at), -1, np.int64)
    for k in np.unique(layer):
        own, among = np.flatnonzero(layer == k), np.flatnonzero(node_layer == k)
        found, _ = nearest(at[own], graph.node_xy[among], 8.0)
        node[own] = np.where(found >= 0, among[found], -1) if len(among) else -1
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
