"""Which road points a vehicle sees: chosen once per lane node, ahead along the road.

The policy knows the road only through these points, so they are spread over what driving needs: the own
lane and its neighbours up to 100 m ahead, lane boundaries beside the vehicle, and the road edges on both
sides up to 80 m ahead, which show curves, lane ends and ramp noses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.near import pairs_within
from phase_sumo.sim.road_map import POINTS_PER_CELL, RoadKind

IntArray = NDArray[np.int64]
POINT_SPACING = 4.0  # m between road points of a line
OWN_AHEAD = (5, 15, 30, 50, 75, 100)  # m, lane centres ahead in the own lane
BESIDE_AHEAD = (5, 25, 50, 80)  # m, in each adjacent lane
FORK_AHEAD = (60, 100)  # m, along the other branch of a fork
BOUNDARY_AHEAD = (5, 30, 60)  # m, nearest lane boundary on either side
EDGE_AHEAD = (0, 15, 30, 50, 80)  # m, road edge on either side
# what fills the places that a narrow road leaves free
SPARE_EDGE_AHEAD = (8, 22, 40, 65)  # m
SPARE_OWN_AHEAD = (0, 10, 22, 40, 60, 90)  # m
SPARE_BESIDE_AHEAD = (15, 35)  # m
EDGE_REACH = 30.0  # m sideways
BOUNDARY_REACH = 6.0  # m sideways
ABEAM = 2.5  # m: a border point this far ahead or behind counts as beside


def view_points(
    graph: LaneGraph, xy: np.ndarray, kind: IntArray, of_node: IntArray, nodes: IntArray
) -> IntArray:
    """[len(nodes), R] road points seen from each node, -1 padded.

    Args:
        graph: lane graph.
        xy, kind: [P, 2] m and [P], the road points.
        of_node: [V] lane-centre point of each node.
        nodes: nodes to look from.
    """
    onward = _onward(graph)
    edges = _beside(graph, xy, kind == RoadKind.ROAD_EDGE, EDGE_REACH)
    boundary = (kind == RoadKind.LANE_BOUNDARY) | (kind == RoadKind.SOLID_BOUNDARY)
    boundaries = _beside(graph, xy, boundary, BOUNDARY_REACH)
    left, right = (_at(side.astype(np.int64), nodes) for side in (graph.left, graph.right))

    own = _walk(onward, nodes, max(OWN_AHEAD))
    beside = [_walk(onward, lane, max(BESIDE_AHEAD)) for lane in (left, right)]
    fork = _walk(onward, nodes, max(OWN_AHEAD), fork=graph.successor[:, 1].astype(np.int64))

    columns = [_at(of_node, own[d]) for d in OWN_AHEAD]
    columns += [_at(side, own[d]) for d in EDGE_AHEAD for side in edges]
    columns += [_at(of_node, lane[d]) for lane in beside for d in BESIDE_AHEAD]
    columns += [_at(side, own[d]) for d in BOUNDARY_AHEAD for side in boundaries]
    columns += [_at(of_node, fork[d]) for d in FORK_AHEAD]
    columns += [_at(side, own[d]) for d in SPARE_EDGE_AHEAD for side in edges]
    columns += [_at(of_node, own[d]) for d in SPARE_OWN_AHEAD]
    columns += [_at(of_node, lane[d]) for lane in beside for d in SPARE_BESIDE_AHEAD]
    return _first_distinct(np.stack(columns, axis=1), POINTS_PER_CELL)


def _at(table: IntArray, index: IntArray) -> IntArray:
    """``table[index]``, -1 where the index is."""
    return np.where(index >= 0, table[index], -1)


def _onward(graph: LaneGraph) -> IntArray:
    """[V] next node; at a lane's end the road goes on in the lane beside it."""
    onward = graph.successor[:, 0].astype(np.int64)
    for side in (graph.left, graph.right):
        over = _at(graph.successor[:, 0].astype(np.int64), side.astype(np.int64))
        onward = np.where(onward >= 0, onward, over)
    return onward


def _walk(onward: IntArray, start: IntArray, steps: int, fork: IntArray | None = None) -> list[IntArray]:
    """Nodes 0, 1, 2 ... metres ahead of ``start``, -1 beyond the road's end.

    With ``fork`` [V] (the other branch, -1 without one) the walk takes the first other branch it meets,
    and is -1 until then.
    """
    path = [start]
    taken = np.zeros(len(start), bool)
    here = start
    for _ in range(steps):
        ahead = _at(onward, here)
        if fork is not None:
            branch = _at(fork, here)
            turn = (branch >= 0) & ~taken
            ahead, taken = np.where(turn, branch, ahead), taken | turn
        here = ahead
        path.append(here if fork is None else np.where(taken, here, -1))
    return path


def _beside(
    graph: LaneGraph, xy: np.ndarray, mask: NDArray[np.bool_], reach: float
) -> tuple[IntArray, IntArray]:
    """Nearest masked point to the left and to the right of every node, -1 where there is none."""
    candidates = np.flatnonzero(mask)
    node, k = pairs_within(graph.node_xy, xy[candidates], reach)
    delta = xy[candidates[k]] - graph.node_xy[node]
    yaw = graph.node_yaw[node]
    along = delta[:, 0] * np.cos(yaw) + delta[:, 1] * np.sin(yaw)
    across = delta[:, 1] * np.cos(yaw) - delta[:, 0] * np.sin(yaw)
    sides = []
    for sign in (1.0, -1.0):
        found = np.full(len(graph.node_yaw), -1, np.int64)
        near = (np.abs(along) <= ABEAM) & (sign * across > 0)
        n, p, key = node[near], candidates[k[near]], np.abs(across[near]) + 0.1 * np.abs(along[near])
        order = np.lexsort((-key, n))  # the nearest is written last
        found[n[order]] = p[order]
        sides.append(found)
    return sides[0], sides[1]


def _first_distinct(columns: IntArray, count: int) -> IntArray:
    """The first ``count`` distinct entries >= 0 of every row, in their order, -1 padded."""
    rows, width = columns.shape
    order = np.argsort(columns, axis=1, kind="stable")
    ordered = np.take_along_axis(columns, order, 1)
    repeated = np.zeros((rows, width), bool)
    repeated[:, 1:] = ordered[:, 1:] == ordered[:, :-1]
    keep = np.zeros((rows, width), bool)
    np.put_along_axis(keep, order, ~repeated & (ordered >= 0), 1)
    rank = np.cumsum(keep, axis=1) - 1
    result = np.full((rows, count), -1, np.int64)
    r, c = np.nonzero(keep & (rank < count))
    result[r, rank[r, c]] = columns[r, c]
    return result
