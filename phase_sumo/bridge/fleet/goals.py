"""Rolling goals: the tactical layer between a SUMO route and the policy's point goals.

The policy drives to a point; this module moves the point, in the lane that `lane_choice` chooses. It lies 6 s
of target speed ahead, 40..150 m; for a change that the route needs it lies before the place where the lane
leads astray, but never nearer than the 2.5 s of driving that a change takes. On a curve it is drawn nearer,
so that the straight line to it keeps to the lane, and nearest (1.6 s) for a vehicle out of line with its
lane. It is set anew when it is nearer than 1.2 s, or behind. Lanes are reviewed every second; a change of
one's own choice begins when it has been worth while for as long as it takes, and a change that has begun is
kept until it is done, the goal is reached, or somebody stands in the new lane.
"""

from __future__ import annotations

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.fleet import lane_choice
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import Place, ahead, path
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.fleet.table import VehicleTable

GOAL_TIME = 6.0  # s of target speed
GOAL_BOUNDS = (40.0, 150.0)  # m
REFRESH_TIME = 1.2  # s of driving, at least REFRESH_DISTANCE; nearer goals keep the policy straighter
REFRESH_DISTANCE = 10.0  # m
SHORTER = (1.0, 0.8, 0.6, 0.45, 0.3)  # shares of the length that are tried
MAX_BULGE = 0.6  # m by which the way to the goal may lie beside the straight line: the policy cuts corners
STRAY_TURN, STRAY_ASIDE = 0.12, 0.9  # rad and m off the lane's direction and centre: the goal is drawn near
NEAREST_TIME = 1.6  # s of driving to the goal at least, or it would be set anew at once
REVIEW = 1.0  # s between two looks at the lanes
SHORTEST_CHANGE_TIME, SHORTEST_CHANGE = 2.5, 15.0  # s of driving and m that a change takes at least
PATIENCE = 3.0  # s for which a change of one's own choice must be worth while before it begins
REST = 8.0  # s between the end of a change and one of one's own choice


class GoalPlanner:
    """Sets the goal of every PHASE vehicle and remembers what it decided."""

    def __init__(self, road: Road, table: VehicleTable) -> None:
        self._road = road
        self._table = table
        self._review: dict[str, float] = {}
        self._changing: dict[str, tuple[int, int, float]] = {}  # lane being left, side, until when
        self._rested: dict[str, float] = {}
        self._wished: dict[str, tuple[int, float]] = {}  # side, and since when
        self.changes_wanted = 0

    def forget(self, vehicle: str) -> None:
        """The vehicle is no longer ours."""
        for memory in (self._review, self._changing, self._rested, self._wished):
            memory.pop(vehicle, None)

    def beside(self, node: IntArray) -> IntArray:
        """[N] node abreast in the lane that each row changes to, -1 for none.

        Args:
            node: [N] node of each row's front bumper, -1 off the road.
        """
        road, abreast = self._road, np.full(len(node), -1)
        for vehicle, (lane, side, _) in self._changing.items():
            at = node[self._table.row_of[vehicle]]
            if at >= 0 and road.graph.node_lane[at] == lane:
                abreast[self._table.row_of[vehicle]] = (road.left if side > 0 else road.right)[at]
        return abreast

    def update(
        self, time: float, node: IntArray, occupancy: Occupancy, routes: dict[str, RouteLanes]
    ) -> None:
        """Refresh the goals that need it."""
        table = self._table
        rows = np.flatnonzero(table.controlled & (node >= 0))
        dx, dy = table["goal_x"][rows] - table["x"][rows], table["goal_y"][rows] - table["y"][rows]
        distance = dx * np.cos(table["yaw"][rows]) + dy * np.sin(table["yaw"][rows])
        near = distance < np.maximum(REFRESH_TIME * table["speed"][rows], REFRESH_DISTANCE)
        vehicles = [table.ids[row] for row in rows.tolist()]
        review = np.array([self._review.get(vehicle, -np.inf) for vehicle in vehicles])
        due = np.flatnonzero(near | (time >= review - 1e-6))
        if not len(due):
            return
        fresh = near | ~np.isfinite(review)  # these need a goal
        own = [routes[vehicle] for vehicle in vehicles]
        blocked = self._blocked(occupancy, rows, node, own)
        asking = []
        for k in due.tolist():
            vehicle = vehicles[k]
            self._review[vehicle] = time + REVIEW
            if vehicle in self._changing:
                if not near[k] and not blocked[k] and self._on_its_way(time, vehicle, int(node[rows[k]])):
                    continue
                del self._changing[vehicle]
                self._rested[vehicle] = time + REST
                fresh[k] = True
            asking.append(k)
        if asking:
            own = [own[k] for k in asking]
            self._ask(time, rows[asking], fresh[asking], node[rows[asking]], occupancy, own)

    def _blocked(
        self, occupancy: Occupancy, rows: IntArray, node: IntArray, routes: list[RouteLanes]
    ) -> BoolArray:
        """[n] whether somebody stands in the lane that a vehicle changes to, nearer than in its own."""
        blocked = np.zeros(len(rows), bool)
        if not self._changing:
            return blocked
        beside = self.beside(node)[rows]
        k = np.flatnonzero(beside >= 0)
        if len(k):
            ways = [routes[i] for i in k.tolist()]
            there, here = (
                lane_choice.blocks(occupancy, self._table, rows[k], at[k], ways)
                for at in (beside, node[rows])
            )
            blocked[k] = there < here
        return blocked

    def _on_its_way(self, time: float, vehicle: str, node: int) -> bool:
        lane, _, until = self._changing[vehicle]
        return lane == self._road.graph.node_lane[node] and time < until

    def _ask(
        self,
        time: float,
        rows: IntArray,
        fresh: BoolArray,
        at: IntArray,
        occupancy: Occupancy,
        routes: list[RouteLanes],
    ) -> None:
        """Choose lanes; set the goals of those that change, are out of line or need one (``fresh``)."""
        road, table, graph = self._road, self._table, self._road.graph
        vehicles = [table.ids[row] for row in rows.tolist()]
        stray = self._stray(rows, at)
        resting = np.array([time < self._rested.get(vehicle, -np.inf) for vehicle in vehicles])
        side, needed = lane_choice.sides(road, table, occupancy, rows, at, routes, stray | resting)
        lasting = np.array([self._lasts(time, *wish) for wish in zip(vehicles, side.tolist(), strict=True)])
        side = np.where(needed | lasting, side, 0)
        beside = np.where(side > 0, road.left[at], np.where(side < 0, road.right[at], -1))
        changing = beside >= 0
        for k in np.flatnonzero(changing | fresh | stray).tolist():
            row, here = int(rows[k]), int(at[k])
            length = float(np.clip(GOAL_TIME * table["goal_speed"][row], *GOAL_BOUNDS))
            if changing[k]:
                lane = int(graph.node_lane[here])
                length = min(length, self._change_length(row, here, lane, routes[k]))
                self.changes_wanted += 1
                self._changing[vehicles[k]] = (lane, int(side[k]), time + GOAL_TIME)
                here = int(beside[k])
            self._set(row, self._place(row, routes[k], here, length, bool(stray[k]) and not changing[k]))

    def _stray(self, rows: IntArray, node: IntArray) -> BoolArray:
        """Whether vehicles are out of line with their lane, behind a kink or after swerving."""
        graph = self._road.graph
        x, y = (
            at[rows] - middle for at, middle in zip(self._table.front, graph.node_xy[node].T, strict=True)
        )
        yaw = graph.node_yaw[node]
        turn = np.remainder(self._table["yaw"][rows] - yaw + np.pi, 2 * np.pi) - np.pi
        aside = y * np.cos(yaw) - x * np.sin(yaw)
        return (np.abs(turn) > STRAY_TURN) | (np.abs(aside) > STRAY_ASIDE)

    def _lasts(self, time: float, vehicle: str, side: int) -> bool:
        """Whether the vehicle has wished for the lane on a side long enough."""
        before, since = self._wished.get(vehicle, (0, time))
        if side != before:
            since = time
        self._wished[vehicle] = (side, since)
        return time - since >= PATIENCE - 1e-6

    def _change_length(self, row: int, node: int, lane: int, route: RouteLanes) -> float:
        """m within which the change must be done: the room that is left, if that can be driven."""
        room = float(route.room[lane]) - self._road.offset(node)
        shortest = max(SHORTEST_CHANGE_TIME * float(self._table["speed"][row]), SHORTEST_CHANGE)
        return max(room / max(float(route.changes[lane]), 1.0), shortest)

    def _place(self, row: int, route: RouteLanes, node: int, length: float, stray: bool) -> Place:
        """The goal, drawn nearer on a curve so that the straight line to it keeps to the lane."""
        nearest = max(NEAREST_TIME * float(self._table["speed"][row]), SHORTEST_CHANGE)
        xy = self._road.graph.node_xy[path(self._road, route, node, length)].astype(np.float64)
        lengths = [share * length for share in SHORTER if share * length > nearest and not stray]
        straight = (s for s in lengths if _bulge(xy[: round(s) + 1]) <= MAX_BULGE)
        return ahead(self._road, route, node, next(straight, nearest))

    def _set(self, row: int, place: Place) -> None:
        table = self._table
        table["goal_x"][row], table["goal_y"][row], table["goal_yaw"][row] = place.x, place.y, place.yaw


def _bulge(xy: FloatArray) -> float:
    """Largest distance in m of the points [n, 2] of a way from the straight line between its ends."""
    along = xy[-1] - xy[0]
    aside = (xy[:, 0] - xy[0, 0]) * along[1] - (xy[:, 1] - xy[0, 1]) * along[0]
    return float(np.abs(aside).max() / max(np.hypot(*along), 1e-6))
