"""The grid squares near the lanes: which there are, the lane node nearest to each, the borders in reach."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.near import abeam, ranges
from phase_sumo.sim.road_map import BLOCK, CELL_SIZE, CONTACT_REACH, SEGMENTS_PER_CELL, RoadKind

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
MARGIN = 30.0  # m around the lanes that the grid covers
OFF_ROAD = 5.5  # m from a cell's centre to the nearest lane centre: half a wide lane + half a cell's diagonal
ROWS_AT_ONCE = 16384  # segments, to bound memory
AROUND = tuple(product((-1, 0, 1), repeat=2))


@dataclass(frozen=True)
class Grid:
    """Squares of `CELL_SIZE` in blocks of `BLOCK` x `BLOCK`, of which only those near a lane are stored.

    Attributes:
        origin: [2] lower left corner in m.
        block: [nx, ny] number of each stored block, -1 elsewhere.
        corner: [B, 2] first square of each stored block along x and y.
    """

    origin: FloatArray
    block: IntArray
    corner: IntArray

    @staticmethod
    def around(xy: np.ndarray) -> Grid:
        """The grid of all blocks within `MARGIN` of points [V, 2]."""
        origin = xy.min(0).astype(np.float64) - MARGIN
        size = CELL_SIZE * BLOCK
        shape = np.floor((xy.max(0) + MARGIN - origin) / size).astype(np.int64) + 1
        block = np.full(shape, -1)
        for shift in product((-MARGIN, MARGIN), repeat=2):  # twice the margin is less than a block
            x, y = ((xy + shift - origin) // size).astype(np.int64).T
            block[x, y] = 0
        stored = np.argwhere(block == 0)
        block[stored[:, 0], stored[:, 1]] = np.arange(len(stored))
        return Grid(origin, block, stored * BLOCK)

    @cached_property
    def framed(self) -> IntArray:
        """``block`` with a frame of blocks that are not stored, flat."""
        return np.pad(self.block, 1, constant_values=-1).ravel()

    @property
    def slots(self) -> int:
        """Number of stored squares."""
        return len(self.corner) * BLOCK * BLOCK

    def slot(self, x: IntArray, y: IntArray) -> IntArray:
        """Number of each square among the stored ones, -1 where it is not."""
        nx, ny = self.block.shape
        bx, by = np.clip(x // BLOCK, -1, nx), np.clip(y // BLOCK, -1, ny)
        block = self.framed[(bx + 1) * (ny + 2) + by + 1]
        return np.where(block >= 0, (block * BLOCK + x % BLOCK) * BLOCK + y % BLOCK, -1)

    def square(self, slot: IntArray) -> IntArray:
        """[n, 2] position of stored squares along x and y."""
        block, local = np.divmod(slot, BLOCK * BLOCK)
        return self.corner[block] + np.stack(np.divmod(local, BLOCK), -1)

    def centre(self, square: IntArray) -> FloatArray:
        """[n, 2] m."""
        return self.origin + (square + 0.5) * CELL_SIZE


def cells(graph: LaneGraph, nodes: IntArray) -> tuple[Grid, IntArray, IntArray]:
    """Grid squares whose centre lies within `MARGIN` of a lane, or of the given ``nodes`` of lanes.

    Every node offers itself to the nine squares around it: the nearest one within 1.5 squares of a centre is
    among them. From there nodes spread ring by ring, sliding along their lanes as they go.

    Returns:
        the grid, slot of each cell [C], its nearest node [C].
    """
    grid = Grid.around(graph.node_xy[nodes])
    node, distance = np.full(grid.slots, -1), np.full(grid.slots, np.inf)
    along = np.stack((np.cos(graph.node_yaw), np.sin(graph.node_yaw)), -1)
    square = ((graph.node_xy[nodes] - grid.origin) // CELL_SIZE).astype(np.int64)
    ring = _spread(graph, grid, square, nodes, node, distance)
    ring = _kept(ring, node, distance, 1.5 * CELL_SIZE)
    while len(ring):
        ring = _spread(graph, grid, grid.square(ring), node[ring], node, distance)
        at, first = grid.centre(grid.square(ring)), node[ring]
        slid = abeam(
            at, first, graph.node_xy, along, (graph.lane_start[first], graph.lane_end[first]), 1.0, 2
        )
        node[ring], distance[ring] = slid, np.hypot(*(at - graph.node_xy[slid]).T)
        ring = _kept(ring, node, distance, MARGIN)
    found = np.flatnonzero(node >= 0)
    return grid, found, node[found]


def _kept(ring: IntArray, node: IntArray, distance: FloatArray, longest: float) -> IntArray:
    """Forget nodes that are farther than ``longest`` m; returns the slots that keep theirs."""
    far = ring[distance[ring] > longest]
    node[far], distance[far] = -1, np.inf
    return ring[node[ring] >= 0]


def _spread(
    graph: LaneGraph, grid: Grid, square: IntArray, offered: IntArray, node: IntArray, distance: FloatArray
) -> IntArray:
    """Give squares without a node the nearest one ``offered`` at a square beside; returns their slots."""
    free = node < 0
    for shift in AROUND:
        beside = square + shift
        slot = grid.slot(beside[:, 0], beside[:, 1])
        row = np.flatnonzero(free[slot] & (slot >= 0))
        slot = slot[row]
        x, y = (graph.node_xy[offered[row]] - grid.centre(beside[row])).T
        apart = np.hypot(x, y)
        np.minimum.at(distance, slot, apart)
        best = apart == distance[slot]
        node[slot[best]] = offered[row[best]]
    return np.flatnonzero(free & (node >= 0))


def cell_segments(grid: Grid, slot: IntArray, segment: FloatArray, kind: IntArray) -> NDArray[np.int32]:
    """[C, G] segments within `CONTACT_REACH` of each cell's centre, nearest first, -1 padded.

    Args:
        grid, slot: the cells.
        segment, kind: [S, 4] m and [S], the borders.
    """
    cell_of = np.full(grid.slots, -1)
    cell_of[slot] = np.arange(len(slot))
    parts = [
        _cells_in_reach(grid, cell_of, np.arange(a, min(a + ROWS_AT_ONCE, len(segment))), segment)
        for a in range(0, len(segment), ROWS_AT_ONCE)
    ]
    cell = np.concatenate([np.zeros(0, np.int64), *(p[0] for p in parts)])
    index = np.concatenate([np.zeros(0, np.int64), *(p[1] for p in parts)])
    distance = np.concatenate([np.zeros(0), *(p[2] for p in parts)])
    counts = np.bincount(cell, minlength=len(slot))
    crowded = counts > SEGMENTS_PER_CELL
    if crowded.any():
        warnings.warn(
            f"{int(crowded.sum())} grid squares see more than {SEGMENTS_PER_CELL} border segments; "
            "the farthest lane boundaries there are ignored",
            stacklevel=4,
        )
    # a full square keeps its road edges and loses boundaries
    boundary_last = crowded[cell] & (kind[index] != RoadKind.ROAD_EDGE)
    order = np.argsort(cell + (distance / CONTACT_REACH + boundary_last) / 3.0, kind="stable")
    cell, index, rank = cell[order], index[order], ranges(counts)
    table = np.full((len(slot), SEGMENTS_PER_CELL), -1, np.int32)
    fits = rank < SEGMENTS_PER_CELL
    table[cell[fits], rank[fits]] = index[fits]
    return table


def _cells_in_reach(
    grid: Grid, cell_of: IntArray, which: IntArray, segment: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Cell, segment and distance of all pairs in reach, found column of squares by column of squares."""
    low = np.minimum(segment[which, :2], segment[which, 2:])
    high = np.maximum(segment[which, :2], segment[which, 2:])
    first, last = _centres_between(low[:, 0], high[:, 0], grid.origin[0])
    count = np.maximum(last - first + 1, 0)
    which, column = np.repeat(which, count), np.repeat(first, count) + ranges(count)
    # the piece of the segment that is in reach of the column's centre line
    ax, ay, bx, by = segment[which].T
    x = grid.origin[0] + (column + 0.5) * CELL_SIZE
    run = np.where(np.abs(bx - ax) < 1e-6, 1e-6, bx - ax)
    ends = np.clip((x + CONTACT_REACH * np.array([[-1.0], [1.0]]) - ax) / run, 0.0, 1.0)
    y = ay + ends * (by - ay)
    first, last = _centres_between(y.min(0), y.max(0), grid.origin[1])
    count = np.maximum(last - first + 1, 0)
    which, column = np.repeat(which, count), np.repeat(column, count)
    row = np.repeat(first, count) + ranges(count)
    slot = grid.slot(column, row)
    cell = np.where(slot >= 0, cell_of[slot], -1)
    near = np.flatnonzero(cell >= 0)
    cell, which = cell[near], which[near]
    distance = point_segment_distance(grid.centre(np.stack((column[near], row[near]), -1)), segment[which])
    close = distance <= CONTACT_REACH
    return cell[close], which[close], distance[close]


def _centres_between(low: FloatArray, high: FloatArray, origin: float) -> tuple[IntArray, IntArray]:
    """First and last square along an axis whose centre lies at most `CONTACT_REACH` outside [low, high]."""
    first = np.ceil((low - CONTACT_REACH - origin) / CELL_SIZE - 0.5)
    last = np.floor((high + CONTACT_REACH - origin) / CELL_SIZE - 0.5)
    return first.astype(np.int64), last.astype(np.int64)


def point_segment_distance(point: FloatArray, segment: FloatArray) -> FloatArray:
    """[Q] distance in m from points [Q, 2] to segments [Q, 4]."""
    (px, py), (ax, ay, bx, by) = point.T, segment.T
    dx, dy = bx - ax, by - ay
    t = ((px - ax) * dx + (py - ay) * dy) / np.maximum(dx * dx + dy * dy, 1e-12)
    t = np.clip(t, 0.0, 1.0)
    return np.hypot(px - ax - t * dx, py - ay - t * dy)
