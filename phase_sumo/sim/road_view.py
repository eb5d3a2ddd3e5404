"""Which road points a vehicle sees: chosen once per lane node, ahead along the road.

The policy knows the road only through these points, so they are spread over what driving needs: the own
lane and its neighbours up to 100 m ahead, lane boundaries beside the vehicle, and the road edges on both
sides up to 80 m ahead, which show curves, lane ends and ramp noses.
"""

from __future__ import annotations

from dataclasses import dataclass

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
OWN_DISTANCES = {*OWN_AHEAD, *EDGE_AHEAD, *BOUNDARY_AHEAD, *SPARE_EDGE_AHEAD, *SPARE_OWN_AHEAD}
EDGE_REACH = 30.0  # m sideways
BOUNDARY_REACH = 6.0  # m sideways
JUMPS = 7  # powers of two of metres: no one looks 128 m ahead
NODES_AT_ONCE = 8192  # to bound memory
ABEAM = 2.5  # m: a border point this far ahead or behind counts as beside


class RoadView:
    """What is seen of a road from the nodes of its lanes.

    Args:
        graph: lane graph.
        xy, kind: [P, 2] m and [P], the road points; lane centres come first.
        of_node: [V] lane-centre point of each node.
        layer: [P] of the road points; nobody sees a border of another layer.
    """

    def __init__(
        self, graph: LaneGraph, xy: np.ndarray, kind: IntArray, of_node: IntArray, layer: IntArray
    ) -> None:
        self._graph = graph
        self._centre = np.append(of_node, -1)
        edges = np.flatnonzero(kind == RoadKind.ROAD_EDGE)
        boundaries = np.flatnonzero((kind == RoadKind.LANE_BOUNDARY) | (kind == RoadKind.SOLID_BOUNDARY))
        self._edges = _beside(graph, xy, layer, of_node, edges, EDGE_REACH)
        self._boundaries = _beside(graph, xy, layer, of_node, boundaries, BOUNDARY_REACH)
        self._lanes = [np.where(side >= 0, side, len(side)) for side in (graph.left, graph.right)]

    def points(self, nodes: IntArray, route: tuple[IntArray, IntArray] | None = None) -> NDArray[np.int32]:
        """Road points seen from nodes.

        Args:
            nodes: [n] to look from.
            route: last nodes of lanes, and the nodes where the road goes on from there, not straight on.

        Returns:
            [n, R] points, -1 padded.
        """
        walk = _Walk.of(self._graph, route)
        edges, boundaries, centre = self._edges, self._boundaries, self._centre
        seen = np.empty((len(nodes), POINTS_PER_CELL), np.int32)
        for begin in range(0, len(nodes), NODES_AT_ONCE):
            part = slice(begin, begin + NODES_AT_ONCE)
            at = nodes[part]
            own = {d: walk.ahead(at, d) for d in OWN_DISTANCES}
            beside = [
                {d: walk.ahead(lane[at], d) for d in BESIDE_AHEAD + SPARE_BESIDE_AHEAD}
                for lane in self._lanes
            ]
            columns = [(centre, own[d]) for d in OWN_AHEAD]
            columns += [(side, own[d]) for d in EDGE_AHEAD for side in edges]
            columns += [(centre, lane[d]) for lane in beside for d in BESIDE_AHEAD]
            columns += [(side, own[d]) for d in BOUNDARY_AHEAD for side in boundaries]
            columns += [(centre, walk.fork(at, d)) for d in FORK_AHEAD]
            columns += [(side, own[d]) for d in SPARE_EDGE_AHEAD for side in edges]
            columns += [(centre, own[d]) for d in SPARE_OWN_AHEAD]
            columns += [(centre, lane[d]) for lane in beside for d in SPARE_BESIDE_AHEAD]
            points = [table[node].astype(np.int32) for table, node in columns]
            families = [
                0 if table is centre else 1 if any(table is side for side in edges) else 2
                for table, _ in columns
            ]
            seen[part] = _first_distinct(points, families, POINTS_PER_CELL)
        return seen


@dataclass(frozen=True)
class _Walk:
    """Ways ahead along the road; node number V stands for "beyond the road's end".

    Attributes:
        jumps: [7][V + 1] node 1, 2, 4 ... 64 m ahead of each node.
        branch: [V + 1] the other branch at a fork, V without one.
        to_fork: [V + 1] metres to the next fork ahead; 128 or more means none in sight.
    """

    jumps: list[IntArray]
    branch: IntArray
    to_fork: IntArray

    @staticmethod
    def of(graph: LaneGraph, route: tuple[IntArray, IntArray] | None = None) -> _Walk:
        beyond = len(graph.node_lane)
        onward = _onward(graph)
        branch = np.append(graph.successor[:, 1].astype(np.int64), -1)
        if route is not None:
            end, target = route
            branch[end] = np.where(target != onward[end], onward[end], branch[end])
            onward[end] = target
        jumps = [np.append(np.where(onward >= 0, onward, beyond), beyond)]
        to_fork = np.where(branch >= 0, 0, 2**JUMPS)
        for k in range(JUMPS):
            jump = jumps[-1]
            to_fork = np.minimum(to_fork, to_fork[jump] + 2**k)
            jumps.append(jump[jump])
        return _Walk(jumps[:JUMPS], np.where(branch >= 0, branch, beyond), to_fork)

    def ahead(self, node: IntArray, metres: int) -> IntArray:
        """Node ``metres`` ahead of each."""
        for k, jump in enumerate(self.jumps):
            if metres >> k & 1:
                node = jump[node]
        return node

    def fork(self, node: IntArray, metres: int) -> IntArray:
        """Node ``metres`` ahead of each along the other branch of the first fork, V before it is reached."""
        result = np.full(len(node), len(self.branch) - 1)
        rows = np.flatnonzero(self.to_fork[node] < metres)
        straight = self.to_fork[node[rows]]
        branch = self.branch[self._ahead_each(node[rows], straight)]
        result[rows] = self._ahead_each(branch, metres - 1 - straight)
        return result

    def _ahead_each(self, node: IntArray, metres: IntArray) -> IntArray:
        for k, jump in enumerate(self.jumps):
            node = np.where(metres >> k & 1, jump[node], node)
        return node


def _onward(graph: LaneGraph) -> IntArray:
    """[V] next node; at a lane's end the road goes on in the lane beside it."""
    following = graph.successor[:, 0].astype(np.int64)
    onward = following.copy()
    for side in (graph.left, graph.right):
        over = np.flatnonzero((onward < 0) & (side >= 0))
        onward[over] = following[side[over]]
    return onward


def _beside(
    graph: LaneGraph,
    xy: np.ndarray,
    layer: IntArray,
    of_node: IntArray,
    candidates: IntArray,
    reach: float,
) -> tuple[IntArray, IntArray]:
    """[V + 1] nearest of some points to the left and to the right of every node's lane-centre point.

    -1 where there is none, and for the node beyond the road's end.
    """
    node = np.flatnonzero(np.diff(of_node, prepend=-1))  # the node each lane-centre point lies on
    yaw = graph.node_yaw[node]
    found = np.full((2, len(node)), -1)
    for radius in (reach / 4, reach / 2, reach):  # the far ones only where a side has no near one
        missing = np.flatnonzero((found < 0).any(0))
        point, k = pairs_within(xy[missing], xy[candidates], radius)
        point = missing[point]
        own = layer[candidates[k]] == layer[point]
        point, k = point[own], k[own]
        x, y = (xy[candidates[k]] - xy[point]).T
        along, across = _turned(x, y, yaw[point])
        apart = np.abs(across) + 0.1 * np.abs(along)
        for side, sign in zip(found, (1.0, -1.0), strict=True):
            rows = np.flatnonzero((np.abs(along) <= ABEAM) & (sign * across > 0) & (side[point] < 0))
            rows = rows[np.argsort(-apart[rows], kind="stable")]  # the nearest is written last
            side[point[rows]] = candidates[k[rows]]
    closest = of_node[np.minimum(np.arange(len(of_node)) + round(POINT_SPACING / 2), graph.lane_end)]
    left, right = found[:, closest]
    return np.append(left, -1), np.append(right, -1)


def _turned(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metres along and to the left of a direction."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return x * cos + y * sin, y * cos - x * sin


def _first_distinct(columns: list[NDArray[np.int32]], families: list[int], count: int) -> NDArray[np.int32]:
    """[n, count] the first distinct entries >= 0 across ``columns`` [n], in their order, -1 padded.

    Columns of different families have no entry in common.
    """
    rows = len(columns[0])
    result = np.full((rows, count), -1, np.int32)
    filled = np.zeros(rows, np.int64)
    for k, column in enumerate(columns):
        fresh = (column >= 0) & (filled < count)
        for earlier in range(k):
            if families[earlier] == families[k]:
                fresh &= column != columns[earlier]
        row = np.flatnonzero(fresh)
        result[row, filled[row]] = column[row]
        filled[row] += 1
    return result
