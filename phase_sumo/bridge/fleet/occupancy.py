"""Who drives ahead and behind on a lane, for many vehicles at once.

Some vehicles stand: broken down, at a stop, at the tail of a queue. They are seen from farther away than the
leader is. The policy was never told to stand, so SUMO's own models drive those who must wait behind them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.fleet.table import VehicleTable

STANDING = 2.0  # m/s, at most, of a vehicle that stands
BEHIND = 100.0  # m within which a vehicle on a lane before this one matters


class Occupancy:
    """Which vehicles are on which lane, by the node of their front bumper."""

    def __init__(
        self, road: Road, table: VehicleTable, node: IntArray, among: BoolArray | None = None
    ) -> None:
        """``node`` [N] of each row's front bumper, -1 off the road; ``among`` [N] leaves out all others."""
        self._road, self._table, self._nodes = road, table, node
        self.length, self.speed = overall_length(table), table["speed"]
        rows = np.flatnonzero(table.active & (node >= 0) & (True if among is None else among))
        self._row = rows[np.argsort(node[rows], kind="stable")]  # nodes of a lane lie in a row
        self._node = node[self._row]
        self._lane = road.graph.node_lane[self._node]

    @cached_property
    def standing(self) -> Occupancy:
        """Of the vehicles that stand alone."""
        return Occupancy(self._road, self._table, self._nodes, self.speed <= STANDING)

    def between(self, node: IntArray) -> IntArray:
        """[n] how many vehicles come before each node in the order of nodes, see `at`."""
        return np.searchsorted(self._node, node)

    def at(self, places: slice) -> tuple[list[int], list[int]]:
        """Rows and nodes of vehicles by their places in that order."""
        return self._row[places].tolist(), self._node[places].tolist()

    def leaders(
        self, node: IntArray, rows: IntArray, routes: Sequence[RouteLanes], reach: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """The next vehicles along the routes.

        Args:
            node: [n] where to look from.
            rows: [n] who looks, and is not found itself.
            reach: [n] m.

        Returns:
            Rows [n], -1 for none, and the gaps to them in m, inf for none.
        """
        if not len(self._row):
            return np.full(len(node), -1), np.full(len(node), np.inf)
        at = np.searchsorted(self._node, node)
        at += self._holds(at, rows)
        lane = self._road.graph.node_lane[node]
        there = np.minimum(at, len(self._row) - 1)
        same = (at < len(self._row)) & (self._lane[there] == lane)
        found = np.where(same, self._row[there], -1)
        gap = np.where(same, self._node[there] - node - self.length[self._row[there]], np.inf)
        beyond = np.flatnonzero(~same)
        if len(beyond):
            passed = (node[beyond] - self._road.first[lane[beyond]]).astype(np.float64)
            travelled = self._road.metres[lane[beyond]] - passed
            found[beyond], gap[beyond] = self._further(
                lane[beyond], [routes[k] for k in beyond.tolist()], travelled, rows[beyond], reach[beyond]
            )
        near = gap < reach
        return np.where(near, found, -1), np.where(near, gap, np.inf)

    def followers(self, node: IntArray, rows: IntArray) -> tuple[IntArray, FloatArray]:
        """The next vehicles behind: rows [n], -1 for none, and the gaps to those who look, inf for none."""
        at = np.searchsorted(self._node, node) - 1
        lane = self._road.graph.node_lane[node]
        there = np.maximum(at, 0)
        same = (at >= 0) & (self._lane[there] == lane)
        found = np.where(same, self._row[there], -1)
        distance = np.where(same, (node - self._node[there]).astype(np.float64), np.inf)
        for k in np.flatnonzero(~same).tolist():
            found[k], distance[k] = self._upstream(int(lane[k]), self._road.offset(node[k]), int(rows[k]))
        return found, distance - self.length[rows]

    def _holds(self, at: IntArray, rows: IntArray) -> IntArray:
        """1 where the sorted vehicles hold a given row at a place, else 0."""
        inside = np.minimum(at, len(self._row) - 1)
        return ((at < len(self._row)) & (self._row[inside] == rows)).astype(np.int64)

    def _further(
        self,
        lane: IntArray,
        routes: Sequence[RouteLanes],
        travelled: FloatArray,
        rows: IntArray,
        reach: FloatArray,
    ) -> tuple[IntArray, FloatArray]:
        """The first vehicles on the lanes after these, whose starts are ``travelled`` m away, all [n]."""
        found, gap = np.full(len(lane), -1), np.full(len(lane), np.inf)
        k = np.flatnonzero(travelled < reach)
        while len(k):
            onward = [routes[i].onward[at] for i, at in zip(k.tolist(), lane[k].tolist(), strict=True)]
            lane[k] = onward
            k = k[lane[k] >= 0]
            first = self._road.first[lane[k]]
            at = np.minimum(np.searchsorted(self._node, first), len(self._row) - 1)
            hit = (self._lane[at] == lane[k]) & (self._node[at] >= first) & (self._row[at] != rows[k])
            found[k[hit]] = self._row[at[hit]]
            gap[k[hit]] = (
                travelled[k[hit]] + self._node[at[hit]] - first[hit] - self.length[self._row[at[hit]]]
            )
            k = k[~hit]
            travelled[k] += self._road.metres[lane[k]]
            k = k[travelled[k] < reach[k]]
        return found, gap

    def _upstream(self, lane: int, base: float, row: int) -> tuple[int, float]:
        """The nearest last vehicle of the lanes before this one, whose start is ``base`` m behind."""
        best, nearest = -1, BEHIND
        upstream = [(lane, base)]
        while upstream:
            lane, base = upstream.pop()
            for before in self._road.preceding[lane]:
                end = self._road.first[before] + self._road.count[before]
                at = int(np.searchsorted(self._node, end)) - 1
                length = float(self._road.metres[before])
                if at >= 0 and self._lane[at] == before and self._row[at] != row:
                    distance = base + length - float(self._node[at] - self._road.first[before])
                    if distance < nearest:
                        best, nearest = int(self._row[at]), distance
                elif base + length < nearest:
                    upstream.append((before, base + length))
        return best, nearest if best >= 0 else np.inf


def overall_length(table: VehicleTable) -> np.ndarray:
    """[N] m, bumper to bumper, trailer included."""
    front = table["length"] - table["rear_overhang"]
    return front + np.maximum(table["rear_overhang"], table["trailer_length"] - table["trailer_setback"])


LOOK = 150.0  # m
FAST = 10.0  # m/s above which the policy does not pass closely: it was never told that somebody may stand


def standing_rooms(
    road: Road, occupancy: Occupancy, node: IntArray, rows: IntArray, routes: Sequence[RouteLanes]
) -> tuple[FloatArray, FloatArray]:
    """m that vehicles have left to one who stands, in their own lane and in those beside, inf for none.

    Args:
        node: [n] of the vehicles' front bumpers.
        rows: [n] of the vehicles in the table.
        routes: of each.

    Returns:
        [n] and [n], the latter for vehicles above `FAST` alone.
    """
    reach, standing = np.full(len(rows), LOOK), occupancy.standing
    _, own = standing.leaders(node, rows, routes, reach)
    beside = np.full(len(rows), np.inf)
    for lane in (road.graph.left[node], road.graph.right[node]):
        k = np.flatnonzero((lane >= 0) & (occupancy.speed[rows] > FAST))
        if len(k):
            _, room = standing.leaders(lane[k], rows[k], [routes[i] for i in k.tolist()], reach[k])
            beside[k] = np.minimum(beside[k], room)
    return own, beside
