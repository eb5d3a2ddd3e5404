"""The observed road for the fleet: lane graph, road map, and where each vehicle is on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.fleet.route_views import RouteViews
from phase_sumo.bridge.maps.levels import Levels
from phase_sumo.bridge.maps.road_model import road_model
from phase_sumo.sim.curve_speed import SIDEWAYS, SIDEWAYS_TRUCK, WINDOW, lane_speeds
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.near import pairs_within
from phase_sumo.sim.road_map import RoadMap

MATCH_RADIUS = 6.0  # m, farther from any lane centre is off the road
MATCH_YAW = np.radians(75.0)
TIGHTEST = 12.0  # m, radius of turns at crossings; ramps of motorways are wider
SLACK, SLACK_TRUCK = 0.4, 0.2  # m beside the middle of the lane in slight kinks
OVERLAP = 2.0  # m between the centres of two lanes up to which a vehicle may be counted on either
ASTRAY = 1.5  # m beside a lane, from where on a vehicle does not find back by itself
REMATCH = 2.6  # m from the tracked node, from where on the whole graph is searched
YAW_COST = 4.0  # m per rad when nodes compete in a search of the whole graph


class Road:
    """A lane network with its graph; nodes are about 1 m apart, so node counts stand for metres.

    Attributes:
        network, levels: lanes, and which of them lie on one road.
        graph, map: lane graph and road map, which grows with the routes' ``views``.
        piece, layer: [V] piece of road, see `Levels`, and layer of the map of each node.
        first, count: [L] node range of each lane.
        metres: [L] geometric length.
        edges: ids of the edges that PHASE may drive on, at first all whose lanes are kept and nowhere turn in
            less than `TIGHTEST`.
        lanes_of: edge -> its lanes, without ways across junctions.
        following, preceding: lanes after and before each lane.
        abreast: [2, L] lane to the left and to the right on the same edge, -1 for none; whether a change is
            permitted is another question, see `LaneRules`.
        left, right: [V] node in these lanes, -1 where they are not abreast.
        curve_speed: [2, V] m/s for the curves ahead in the lane, of cars and of trucks.
    """

    def __init__(self, network: LaneNetwork, levels: Levels | None = None) -> None:
        self.network, self.levels = network, levels or Levels(network)
        model = road_model(network, self.levels)
        self.graph, self.layer = model.graph, model.layer
        self.piece = self.levels.of_nodes(self.graph)
        self.views = RouteViews(model, self.levels, self.piece)
        self.count = np.bincount(self.graph.node_lane, minlength=len(network.lanes))
        self.first = np.concatenate(([0], np.cumsum(self.count)[:-1]))
        self.metres = np.array([float(np.hypot(*np.diff(c.points, axis=0).T).sum()) for c in network.lanes])
        tight = self.graph.node_lane[np.abs(self.graph.curvature(WINDOW)) > 1.0 / TIGHTEST]
        self._width = np.array([lane.width for lane in network.lanes])
        self.edges = frozenset(c.edge for c in network.lanes if not c.connector)
        self.edges -= {network.lanes[i].edge for i in tight}
        self.lanes_of: dict[str, list[int]] = {}
        for i, lane in enumerate(network.lanes):
            if not lane.connector:
                self.lanes_of.setdefault(lane.edge, []).append(i)
        self.following: list[list[int]] = [[] for _ in network.lanes]
        self.preceding: list[list[int]] = [[] for _ in network.lanes]
        for a, b in network.successors:
            self.following[a].append(b)
            self.preceding[b].append(a)
        self.abreast = _abreast(network)
        self.left, self.right = _nodes_abreast(network, self.graph, self.abreast)
        self._step = self._neighbourhood()
        kinds = (SIDEWAYS, SLACK), (SIDEWAYS_TRUCK, SLACK_TRUCK)
        self.curve_speed = np.stack([lane_speeds(self.graph, *kind) for kind in kinds])

    @property
    def map(self) -> RoadMap:
        return self.views.map

    def offset(self, node: int) -> int:
        """Metres (nodes) from the start of the node's lane."""
        return int(node - self.first[self.graph.node_lane[node]])

    def track(
        self,
        node: IntArray,
        x: FloatArray,
        y: FloatArray,
        yaw: FloatArray,
        piece: IntArray | None = None,
    ) -> tuple[IntArray, FloatArray]:
        """The node nearest to each position, searched from the last one (-1: unknown).

        Nobody gets to another level: who is lost is looked for on the road that the last node lies on.

        Args:
            node: [n].
            x, y, yaw: [n] m and rad.
            piece: [n] of road that unknown ones are on, -1 for any.

        Returns:
            node [n], -1 off the road, and the distance to it in m.
        """
        at = np.stack((x, y), -1)
        known = node >= 0
        here = np.where(known, node, 0)
        best = self._distance(here, at)
        for _ in range(64):  # hill climbing along and across the lanes
            options = self._step[here]
            distance = np.hypot(*np.moveaxis(self.graph.node_xy[options] - at[:, None], -1, 0))
            choice = distance.argmin(1)
            nearest = distance[np.arange(len(here)), choice]
            better = nearest < best - 1e-4
            if not better.any():
                break
            here = np.where(better, options[np.arange(len(here)), choice], here)
            best = np.where(better, nearest, best)
        lost = ~known | (best > REMATCH)
        if lost.any():
            here = here.copy()
            near = np.where(known, self.piece[here], -1 if piece is None else piece)
            here[lost] = self._search(at[lost], yaw[lost], near[lost])
            best[lost] = np.where(
                here[lost] >= 0, self._distance(np.maximum(here[lost], 0), at[lost]), np.inf
            )
        return here, best

    def beyond_lane(self, node: IntArray, x: FloatArray, y: FloatArray) -> BoolArray:
        """[n] whether positions are more than `ASTRAY` beside the lanes of their nodes [n], -1 for none."""
        graph, known = self.graph, node >= 0
        at, yaw = graph.node_xy[node], graph.node_yaw[node]
        aside = np.abs((y - at[:, 1]) * np.cos(yaw) - (x - at[:, 0]) * np.sin(yaw))
        return known & (aside > 0.5 * self._width[graph.node_lane[node]] + ASTRAY)

    def overlapping(self, node: int, x: float, y: float, lanes: BoolArray) -> int:
        """The nearest node on one of some ``lanes`` [L] that overlap here with a vehicle's own.

        Behind a fork two lanes run on over each other for a while, and tracking may have followed either.

        Args:
            node: where tracking saw it.

        Returns:
            -1 where there is none.
        """
        _, near = pairs_within(np.array([[x, y]]), self.graph.node_xy, OVERLAP)
        turn = self.graph.node_yaw[near] - self.graph.node_yaw[node]
        near = near[lanes[self.graph.node_lane[near]] & (np.cos(turn) > np.cos(MATCH_YAW))]
        near = near[self.levels.touching(np.full(len(near), self.piece[node]), self.piece[near])]
        if not len(near):
            return -1
        return int(near[np.hypot(*(self.graph.node_xy[near] - (x, y)).T).argmin()])

    def _distance(self, node: IntArray, at: FloatArray) -> FloatArray:
        return np.hypot(*(self.graph.node_xy[node] - at).T).astype(np.float64)

    def _search(self, at: FloatArray, yaw: FloatArray, piece: IntArray) -> IntArray:
        found = np.full(len(at), -1, np.int64)
        query, node = pairs_within(at, self.graph.node_xy, MATCH_RADIUS)
        turn = np.abs(np.remainder(self.graph.node_yaw[node] - yaw[query] + np.pi, 2 * np.pi) - np.pi)
        on = piece[query]
        use = (turn < MATCH_YAW) & ((on < 0) | self.levels.touching(on, self.piece[node]))
        query, node, turn = query[use], node[use], turn[use]
        cost = np.hypot(*(self.graph.node_xy[node] - at[query]).T) + YAW_COST * turn
        order = np.lexsort((cost, query))
        query, node = query[order], node[order]
        head = np.r_[True, query[1:] != query[:-1]] if len(query) else np.zeros(0, bool)
        found[query[head]] = node[head]
        return found

    def _neighbourhood(self) -> IntArray:
        """[V, 6] successors and the nodes abreast; the node itself where there is none."""
        options = np.column_stack((self.graph.successor, self.left, self.right)).astype(np.int64)
        return np.where(options >= 0, options, np.arange(len(options))[:, None])


def _abreast(network: LaneNetwork) -> IntArray:
    """[2, L] lanes to the left and right on the same edge, over solid lines too; SUMO counts them in ids."""
    found = np.array([[lane.left, lane.right] for lane in network.lanes], np.int64).reshape(-1, 2).T
    place = {lane.id: i for i, lane in enumerate(network.lanes)}
    up = -1 if network.left_hand else 1
    for i, lane in enumerate(network.lanes):
        edge, _, number = lane.id.rpartition("_")
        for k, (solid, way) in enumerate(((lane.solid_left, up), (lane.solid_right, -up))):
            if solid and found[k, i] < 0 and number.isdigit():
                found[k, i] = place.get(f"{edge}_{int(number) + way}", -1)
    return found


def _nodes_abreast(network: LaneNetwork, graph: LaneGraph, abreast: IntArray) -> tuple[IntArray, IntArray]:
    lanes = network.lanes
    if all(
        (lane.left, lane.right) == tuple(pair) for lane, pair in zip(lanes, abreast.T.tolist(), strict=True)
    ):
        return graph.left, graph.right
    open_lanes = [
        replace(lane, left=left, right=right)
        for lane, (left, right) in zip(lanes, abreast.T.tolist(), strict=True)
    ]
    graph = build_lane_graph(replace(network, lanes=tuple(open_lanes)))
    return graph.left, graph.right
