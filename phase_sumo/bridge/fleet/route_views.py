"""What vehicles see where a place does not tell which road is theirs: that along their own route.

A place of the road map shows the road straight on from the lane nearest to it. Before a fork that may be the
branch that a route does not take, and behind it, while the branches are near each other, too; beside, over or
under another road, that road. There every route has views of its own, from the nodes of its lanes along its
own way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.bridge.fleet.class_rules import ClassRules
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.maps.levels import Levels
from phase_sumo.bridge.maps.road_model import RoadModel
from phase_sumo.sim.near import pairs_within
from phase_sumo.sim.road_build import RoadPoints, road_points, view_rows
from phase_sumo.sim.road_view import RoadView

AHEAD = 100  # m before a fork from which the branch is in sight
BESIDE = 6.0  # m between centres of lanes of different roads that may be taken for one another
EVERY = 3  # nodes of the other lanes that are looked at
GROWTH = 1.5  # of the table when it is full


@dataclass(frozen=True)
class RouteLanes:
    """What each lane of the network means to one route, all [L].

    Attributes:
        changes: lane changes needed from this lane to the end of the route, inf off the route.
        room: m from the lane's start that can be driven without any change, inf when none is needed.
        onward: lane to take at the lane's end, -1 where the route or the lane ends.
        exit_speed: m/s at the lane's end for the curves that follow.
        rest: m from the lane's start to the end of the route, lane changes included.
        side: +1 when the lane to the left needs fewer changes, -1 for the right, 0 for neither.
        view: [L, 3] nodes first, end and row of the road map's view for the first, see `RouteViews`.
        rules: what the lanes allow the vehicle's class.
        leave: lanes of the last edge that lead on to where SUMO drives, with the m/s allowed there; empty
            where all do or the route ends.
    """

    changes: FloatArray
    room: FloatArray
    onward: IntArray
    side: IntArray
    exit_speed: FloatArray
    rest: FloatArray
    view: IntArray
    rules: ClassRules
    leave: Mapping[int, float] = field(default_factory=dict)


class RouteViews:
    """Views of routes, beside those of places.

    Attributes:
        map: the road map; its table of views grows with the routes.
    """

    def __init__(self, model: RoadModel, levels: Levels, piece: IntArray) -> None:
        """``piece`` [V] is what `Levels` calls each node's place."""
        self.map, self._graph, self._model = model.map, model.graph, model
        graph = model.graph
        self._first = np.flatnonzero(np.diff(graph.node_lane, prepend=-1)).astype(np.int64)
        self._count = np.bincount(graph.node_lane).astype(np.int64)
        self._last = self._first + self._count - 1
        ways = graph.successor[self._last].astype(np.int64)
        self._straight = np.where(ways[:, 0] >= 0, graph.node_lane[ways[:, 0]], -1)
        self._unclear = self._beside_others(levels, piece)
        self._known: dict[tuple[int, ...], tuple[int, int, int]] = {}
        self._rows = len(model.map.view)

    def of(self, onward: IntArray, on_route: NDArray[np.bool_]) -> IntArray:
        """Make what a route needs.

        Args:
            onward: [L] lane to take at each lane's end, -1 for none.
            on_route: [L] lanes of the route.

        Returns:
            [L, 3] first node, end node and row of the first; first = end where places show the road.
        """
        result = np.zeros((len(onward), 3), np.int64)
        missing = []
        for lane, ahead, part in self._parts(onward, np.flatnonzero(on_route)):
            key = (*part, *ahead)
            if key not in self._known:
                self._known[key] = (*part, self._rows)
                self._rows += part[1] - part[0]
                missing.append(part)
            result[lane] = self._known[key]
        if missing:
            ends = np.flatnonzero(on_route & (onward >= 0))
            route = self._last[ends], self._first[onward[ends]]
            self._add(np.concatenate([np.arange(*part) for part in missing]), route)
        return result

    def seen(
        self, table: VehicleTable, node: IntArray, routes: dict[str, RouteLanes]
    ) -> tuple[IntArray, IntArray]:
        """Which row of the map's views each vehicle sees because of its route, and from where.

        Args:
            node: [N] node of each row's front bumper, -1 off the road.
            routes: of the vehicles under the policy.

        Returns:
            [N] row, -1 where the place shows the road, and [N] node of the lane where it does not.
        """
        result, places = np.full(len(node), -1), np.zeros(len(node), np.int64)
        rows = np.array([table.row_of[vehicle] for vehicle in routes], np.int64)
        views = [route.view for route in routes.values()]
        on = np.flatnonzero(node[rows] >= 0)
        rows, at = rows[on], node[rows[on]]
        front = (table["length"][rows] - table["rear_overhang"][rows]).round().astype(np.int64)
        at = np.maximum(at - front, self._graph.lane_start[at])  # places are those of the reference point
        lane = self._graph.node_lane[at].tolist()
        own = [views[k][i] for k, i in zip(on.tolist(), lane, strict=True)]
        first, end, row = np.array(own, np.int64).reshape(-1, 3).T
        result[rows] = np.where((at >= first) & (at < end), row + at - first, -1)
        places[rows] = at
        return result, places

    def _parts(
        self, onward: IntArray, lanes: IntArray
    ) -> Iterator[tuple[int, tuple[int, ...], tuple[int, int]]]:
        """Lanes with the lanes that follow within sight, and their nodes [first, end) with own views."""
        for lane in lanes.tolist():
            first, count = int(self._first[lane]), int(self._count[lane])
            ahead, metres, turns = [], 0, AHEAD
            at = lane
            while metres < AHEAD and onward[at] >= 0:
                if onward[at] != self._straight[at]:
                    turns = min(turns, metres)
                at = int(onward[at])
                ahead.append(at)
                metres += int(self._count[at])
            begin, end = self._unclear[lane].tolist()
            if turns < AHEAD:
                begin, end = min(begin, max(count - (AHEAD - turns), 0)), count
            if begin < end:
                yield lane, tuple(ahead), (first + begin, first + end)

    def _beside_others(self, levels: Levels, piece: IntArray) -> IntArray:
        """[L, 2] first and end of each lane's nodes beside lanes that it does not lead to, else count, 0."""
        graph = self._graph
        node, other = pairs_within(graph.node_xy, graph.node_xy[::EVERY], BESIDE)
        node = node[~levels.in_line(piece[node], piece[EVERY * other])]
        lane = graph.node_lane[node]
        result = np.stack((self._count, np.zeros_like(self._count)), 1)
        np.minimum.at(result[:, 0], lane, node - self._first[lane])
        np.maximum.at(result[:, 1], lane, node - self._first[lane] + 1)
        return result

    def _add(self, nodes: IntArray, route: tuple[IntArray, IntArray]) -> None:
        seen = self._view.points(nodes, route)
        points = self._points
        rows = view_rows(seen, np.column_stack((points.xy, points.direction)), points.kind)[:-1]
        begin, table = self._rows - len(rows), self.map.view
        if self._rows > len(table):
            table = torch.empty((int(GROWTH * self._rows), *table.shape[1:]))
            table[:begin] = self.map.view[:begin]
            self.map = replace(self.map, view=table)
        table[begin : self._rows] = rows

    @cached_property
    def _points(self) -> RoadPoints:
        return road_points(self._model.lines, self._graph, self._model.layer)

    @cached_property
    def _view(self) -> RoadView:
        points = self._points
        return RoadView(self._graph, points.xy, points.kind, points.of_node, points.layer)
