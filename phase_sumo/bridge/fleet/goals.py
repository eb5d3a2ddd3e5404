"""Rolling goals: the tactical layer between a SUMO route and the policy's point goals.

The policy drives to a point; this module moves the point. Rules, in order:

1. A lane change that the route needs is asked for once the room that is left falls below
   ``CHANGE_TIME`` x target speed per change; at a lane's end (acceleration lane) that is at once.
2. A vehicle held up by a leader clearly slower than its target speed takes the left lane when that
   leads on along the route just as well and has a gap.
3. A vehicle that has overtaken goes back to the right lane when that is free far ahead.
4. Otherwise it keeps its lane.

The goal lies 6 s of target speed ahead, 40..150 m; for a change that the route needs it lies before the
place where the lane leads astray, but never nearer than the 2.5 s of driving that a change takes. On a curve
it is drawn nearer, so that the straight line to it keeps to the lane, and nearest (1.6 s) for a vehicle that
is out of line with its lane. It is set anew when it is nearer than 1.2 s, or behind; decisions 1-3 are
reviewed every second, and a change that has begun is kept until it is done or the goal is reached.
"""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from phase_sumo.bridge.fleet.road import BoolArray, FloatArray, IntArray, Road
from phase_sumo.bridge.fleet.route import Place, RouteLanes, ahead, path
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
CHANGE_TIME = 12.0  # s of target speed per needed change
CHANGE_ROOM = 150.0  # m per needed change at least
SLOWER = 2.5  # m/s below the target speed: a leader worth overtaking
LEADER_TIME = 6.0  # s within which a leader matters
GAP_AHEAD, GAP_BEHIND = 0.6, 1.0  # s of speed kept to the new leader and follower, plus GAP_MIN
GAP_MIN = 4.0  # m
FREE_TIME = 10.0  # s of free right lane that invite back
REST = 8.0  # s between two changes of one's own choice


class Occupancy:
    """Which vehicles are on which lane, by the node of their front bumper."""

    def __init__(self, road: Road, table: VehicleTable, node: np.ndarray) -> None:
        self._road = road
        self._length = overall_length(table)
        rows = np.flatnonzero(table.active & (node >= 0))
        lane = road.graph.node_lane[node[rows]]
        order = np.argsort(node[rows], kind="stable")  # nodes of a lane lie in a row
        rows, lane = rows[order], lane[order]
        offset = node[rows] - road.first[lane]
        vehicles = list(zip(offset.tolist(), rows.tolist(), strict=True))
        lanes, first, count = np.unique(lane, return_index=True, return_counts=True)
        self._lanes: dict[int, list[tuple[int, int]]] = {
            i: vehicles[k : k + n]
            for i, k, n in zip(lanes.tolist(), first.tolist(), count.tolist(), strict=True)
        }

    def leader(self, route: RouteLanes, node: int, row: int, reach: float) -> tuple[int, float] | None:
        """Row of the next vehicle ahead along the route and the gap to it in m."""
        lane, start = int(self._road.graph.node_lane[node]), self._road.offset(node)
        travelled = -float(start)
        first = True
        while travelled < reach and lane >= 0:
            vehicles = self._lanes.get(lane, [])
            begin = bisect_left(vehicles, (start, -1)) if first else 0
            for offset, other in vehicles[begin:]:
                if other != row:
                    gap = travelled + offset - self.length(other)
                    return (other, gap) if gap < reach else None
            travelled += float(self._road.metres[lane])
            lane, first = int(route.onward[lane]), False
        return None

    def follower(self, node: int, row: int, reach: float = 80.0) -> tuple[int, float] | None:
        """Row of the next vehicle behind and its distance to the front at ``node`` in m."""
        lane, start = int(self._road.graph.node_lane[node]), self._road.offset(node)
        vehicles = self._lanes.get(lane, [])
        for offset, other in reversed(vehicles[: bisect_left(vehicles, (start, -1))]):
            if other != row:
                return other, float(start - offset)
        best = None
        upstream = [(lane, float(start))]
        while upstream:
            lane, base = upstream.pop()
            for before in self._road.preceding[lane]:
                distance = base + float(self._road.metres[before])
                behind = [(distance - o, other) for o, other in self._lanes.get(before, []) if other != row]
                if behind and min(behind)[0] < (best[1] if best else reach):
                    best = (min(behind)[1], min(behind)[0])
                elif not behind and distance < reach:
                    upstream.append((before, distance))
        return best

    def length(self, row: int) -> float:
        """Bumper to bumper in m, trailer included."""
        return float(self._length[row])


def overall_length(table: VehicleTable) -> np.ndarray:
    """[N] m, bumper to bumper, trailer included."""
    front = table["length"] - table["rear_overhang"]
    return front + np.maximum(table["rear_overhang"], table["trailer_length"] - table["trailer_setback"])


class GoalPlanner:
    """Sets the goal of every PHASE vehicle and remembers what it decided."""

    def __init__(self, road: Road, table: VehicleTable) -> None:
        self._road = road
        self._table = table
        self._review: dict[str, float] = {}
        self._changing: dict[str, tuple[int, float]] = {}  # lane being left, time until which to persist
        self._rested: dict[str, float] = {}
        self.changes_wanted = 0

    def forget(self, vehicle: str) -> None:
        """The vehicle is no longer ours."""
        for memory in (self._review, self._changing, self._rested):
            memory.pop(vehicle, None)

    def update(self, time: float, node: np.ndarray, routes: dict[str, RouteLanes]) -> None:
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
        occupancy = Occupancy(self._road, table, node)
        stray = self._stray(rows[due], node[rows[due]])
        for k, astray in zip(due.tolist(), stray.tolist(), strict=True):
            row, vehicle = int(rows[k]), vehicles[k]
            reached = bool(near[k]) or not np.isfinite(review[k])  # or no goal yet
            self._review[vehicle] = time + REVIEW
            self._plan(time, row, int(node[row]), routes[vehicle], occupancy, reached, astray)

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

    def _plan(
        self,
        time: float,
        row: int,
        node: int,
        route: RouteLanes,
        occupancy: Occupancy,
        reached: bool,
        stray: bool,
    ) -> None:
        table, road = self._table, self._road
        vehicle = table.ids[row]
        lane = int(road.graph.node_lane[node])
        target = float(table["goal_speed"][row])
        begun = self._changing.get(vehicle)
        if begun is not None:
            if begun[0] == lane and not reached and time < begun[1]:
                return  # on its way
            del self._changing[vehicle]
            self._rested[vehicle] = time + REST
            reached = True
        side = self._side(time, row, node, lane, route, occupancy, target, stray)
        abreast = int((road.graph.left if side > 0 else road.graph.right)[node]) if side else -1
        if abreast < 0 and not reached and not stray:
            return
        length = float(np.clip(GOAL_TIME * target, *GOAL_BOUNDS))
        if abreast >= 0:
            length = min(length, self._change_length(row, node, lane, route))
            self.changes_wanted += 1
            self._changing[vehicle] = (lane, time + GOAL_TIME)
        start = abreast if abreast >= 0 else node
        self._set(row, self._place(row, route, start, length, stray and abreast < 0))

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

    def _side(
        self,
        time: float,
        row: int,
        node: int,
        lane: int,
        route: RouteLanes,
        occupancy: Occupancy,
        target: float,
        stray: bool,
    ) -> int:
        """+1 to the left, -1 to the right, 0 to stay."""
        needed = float(route.changes[lane])
        left_room = float(route.room[lane]) - self._road.offset(node)
        if needed > 0 and np.isfinite(needed) and left_room < needed * max(CHANGE_TIME * target, CHANGE_ROOM):
            return int(route.side[lane])
        if stray or time < self._rested.get(self._table.ids[row], -np.inf):
            return 0
        leader = occupancy.leader(route, node, row, LEADER_TIME * target)
        slow = leader is not None and float(self._table["speed"][leader[0]]) < target - SLOWER
        for side, wanted in ((1, slow), (-1, not slow)):
            beside = int((self._road.graph.left if side > 0 else self._road.graph.right)[node])
            if wanted and beside >= 0 and self._worth(row, beside, side, route, occupancy, target, needed):
                return side
        return 0

    def _worth(
        self,
        row: int,
        beside: int,
        side: int,
        route: RouteLanes,
        occupancy: Occupancy,
        target: float,
        needed: float,
    ) -> bool:
        """Whether the lane beside leads on, is better to drive on, and has a gap."""
        lane = int(self._road.graph.node_lane[beside])
        changes = float(route.changes[lane])
        room = float(route.room[lane]) - self._road.offset(beside)
        if changes > needed and room < (changes + 1.0) * max(CHANGE_TIME * target, CHANGE_ROOM):
            return False
        if not np.isfinite(changes) or (side < 0 and changes > needed):
            return False
        table = self._table
        leader = occupancy.leader(route, beside, row, FREE_TIME * target)
        if leader is not None:
            other, gap = leader
            speed = float(table["speed"][other])
            if gap < GAP_MIN + GAP_AHEAD * float(table["speed"][row]):
                return False
            if side > 0 and speed < target - SLOWER and gap < LEADER_TIME * target:
                return False
            if side < 0 and speed < target + 1.0:
                return False
        elif side < 0 and room < FREE_TIME * target and changes > 0:
            return False
        follower = occupancy.follower(beside, row)
        if follower is None:
            return True
        other, distance = follower
        speed = float(table["speed"][other])
        closing = max(speed - float(table["speed"][row]), 0.0)
        gap = distance - occupancy.length(row)
        return gap > GAP_MIN + GAP_BEHIND * speed * 0.5 + 3.0 * closing


def _bulge(xy: FloatArray) -> float:
    """Largest distance in m of the points [n, 2] of a way from the straight line between its ends."""
    along = xy[-1] - xy[0]
    aside = (xy[:, 0] - xy[0, 0]) * along[1] - (xy[:, 1] - xy[0, 1]) * along[0]
    return float(np.abs(aside).max() / max(np.hypot(*along), 1e-6))
