"""Which lane to take, for many vehicles at once. Rules, in order:

1. A lane change that the route needs is asked for once the room that is left falls below
   ``CHANGE_TIME`` x target speed per change; at a lane's end (acceleration lane) that is at once.
2. Otherwise a vehicle wishes for the lane beside, the left one first, if by MOBIL the change
   gains more than the threshold, is safe, and leads on along the route without a needed change soon. To the
   left it must gain itself. The bias to the right holds where the right lane is free far ahead. A vehicle
   that stands counts as a leader from farther away, whoever drives before it; one who leaves its lane for
   that reason does not wait, and is worth `WAY_OUT` more.
3. Otherwise it keeps its lane.

MOBIL on top of the improved IDM: acceleration of a vehicle with speed v and desired speed v0, a gap s behind
a leader who is slower by dv:

    s* = s0 + max(0, v T + v dv / (2 sqrt(a b))),  z = s* / s
    free = a (1 - (v / v0)^4) for v <= v0, else -b (1 - (v0 / v)^(4 a / b))
    for v <= v0:  free (1 - z^(2 a / free)) if z < 1 else a (1 - z^2)
    for v > v0:   free if z < 1 else free + a (1 - z^2)

Unlike in the plain IDM a leader as fast as oneself is no hindrance beyond the gap s*. A lane change of the
vehicle c gains

    a'_c - a_c + p (a'_n - a_n + a'_o - a_o),

n the follower in the new lane, o the one in the old, accelerations after the change primed; it is worth while
above the threshold, which a bias raises for changes away from the keep-right lane and lowers for those
towards it. It is safe if neither c nor n must brake harder than ``SAFE_BRAKING`` after it.

Kesting, Treiber, Helbing, "General lane-changing model MOBIL for car-following models" (2007): threshold and
bias are near its 0.1 and 0.3 m/s^2, politeness within its 0.2 to 0.5; of its safe braking of 4 m/s^2 we allow
half, since the policy takes several seconds for a change. Treiber, Kesting, "Traffic Flow Dynamics" (2013),
chapter 11: the improved IDM, and T, a, b, s0 for motorways.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.fleet.table import VehicleTable

TIME_GAP = 1.0  # s, T
STANDSTILL = 2.0  # m, s0
ACCELERATION, BRAKING = 1.0, 1.5  # m/s^2, a and b
POLITENESS = 0.3  # p
THRESHOLD = 0.2  # m/s^2
KEEP_RIGHT = 0.3  # m/s^2, bias
SAFE_BRAKING = 2.0  # m/s^2


def acceleration(speed: FloatArray, target: FloatArray, gap: FloatArray, ahead: FloatArray) -> FloatArray:
    """Improved IDM, m/s^2.

    Args:
        speed, target: m/s, at least 0 and above 0.
        gap: m, inf without a leader; what is below 0.1 counts as that.
        ahead: speed of the leader in m/s, any number without one.
    """
    closing = speed * (speed - ahead) / (2.0 * np.sqrt(ACCELERATION * BRAKING))
    z = (STANDSTILL + np.maximum(speed * TIME_GAP + closing, 0.0)) / np.maximum(gap, 0.1)
    slow = speed <= target
    free = np.where(
        slow,
        ACCELERATION * (1.0 - (speed / target) ** 4),
        -BRAKING * (1.0 - (target / np.maximum(speed, target)) ** (4.0 * ACCELERATION / BRAKING)),
    )
    held_up = ACCELERATION * (1.0 - z * z)
    # the exponent grows without bound as free -> 0, where the factor does not matter
    approaching = free * (1.0 - np.minimum(z, 1.0) ** (2.0 * ACCELERATION / np.maximum(free, 1e-2)))
    return np.where(slow, np.where(z < 1.0, approaching, held_up), free + np.minimum(held_up, 0.0))


def felt(braking: FloatArray) -> FloatArray:
    """Accelerations as an incentive: harder than comfortable braking counts as that.

    Drivers who follow closer than T, as the policy and people in queues do, do not brake as the IDM would.
    """
    return np.maximum(braking, -BRAKING)


def gain(own: FloatArray, new_follower: FloatArray, old_follower: FloatArray) -> FloatArray:
    """What a change is worth in m/s^2, from how much more each of the three will `felt`-ly accelerate."""
    return own + POLITENESS * (new_follower + old_follower)


def safe(own: FloatArray, new_follower: FloatArray) -> BoolArray:
    """Whether nobody must brake hard, from the accelerations after the change."""
    return (own >= -SAFE_BRAKING) & (new_follower >= -SAFE_BRAKING)


LEFT, RIGHT = 1, -1
CHANGE_TIME = 12.0  # s of target speed per needed change
CHANGE_ROOM = 150.0  # m per needed change at least
LOOK_TIME = 10.0  # s of target speed within which a leader matters
BLOCKED_TIME, BLOCKED_ROOM = 16.0, 100.0  # s of target speed, at least m, within which a standing one does
FARTHER = 50.0  # m by which another lane must be free beyond the own one to be a way out
WAY_OUT = 1.0  # m/s^2


def sides(
    road: Road,
    table: VehicleTable,
    occupancy: Occupancy,
    rows: IntArray,
    node: IntArray,
    routes: Sequence[RouteLanes],
    bound: BoolArray,
) -> tuple[IntArray, BoolArray]:
    """Where to go, `LEFT`, `RIGHT` or 0 to stay, and whether that is for the route or a lane that is blocked.

    Args:
        rows, node: [n] the vehicles and the nodes of their front bumpers.
        routes: of each.
        bound: [n] those that change only if they need to.
    """
    lane = road.graph.node_lane[node]
    needed, room, side = (
        np.array([getattr(route, name)[k] for route, k in zip(routes, lane.tolist(), strict=True)])
        for name in ("changes", "room", "side")
    )
    stretch = np.maximum(CHANGE_TIME * table.wanted_speed[rows], CHANGE_ROOM)
    must = (needed > 0) & np.isfinite(needed) & (room - (node - road.first[lane]) < needed * stretch)
    chosen = np.where(must, side, 0)
    blocked = np.isfinite(blocks(occupancy, table, rows, node, routes))
    ask = np.flatnonzero(~must & (~bound | blocked))
    if len(ask):
        own = [routes[k] for k in ask.tolist()]
        scene = _Scene(road, table, occupancy, rows[ask], node[ask], own)
        left, right = (scene.worth(way, needed[ask], stretch[ask]) for way in (LEFT, RIGHT))
        first = (left > THRESHOLD) & ((left >= right) | ~blocked[ask])
        chosen[ask] = np.where(first, LEFT, np.where(right > THRESHOLD, RIGHT, 0))
    return chosen, must | (blocked & (chosen != 0))


def blocks(
    occupancy: Occupancy,
    table: VehicleTable,
    rows: IntArray,
    node: IntArray,
    routes: Sequence[RouteLanes],
) -> FloatArray:
    """[n] m from the nodes to the next standing vehicle along the routes, inf for none within reach.

    Args:
        rows: [n] the vehicles that look.
        node: [n] where they look from, -1 for nowhere: inf.
    """
    reach = np.maximum(BLOCKED_TIME * table.wanted_speed[rows], BLOCKED_ROOM)
    room, look = np.full(len(rows), np.inf), np.flatnonzero(node >= 0)
    if len(look):
        own = [routes[k] for k in look.tolist()]
        _, room[look] = occupancy.standing.leaders(node[look], rows[look], own, reach[look])
    return room


class _Scene:
    """Some vehicles, and whom they have ahead and behind in their lanes."""

    def __init__(
        self,
        road: Road,
        table: VehicleTable,
        occupancy: Occupancy,
        rows: IntArray,
        node: IntArray,
        routes: Sequence[RouteLanes],
    ) -> None:
        self._road, self._occupancy, self._routes = road, occupancy, routes
        self._rows, self._node = rows, node
        self._speed = np.maximum(table["speed"].astype(np.float64), 0.0)
        # SUMO's vehicles are taken to drive as fast as they want
        self._target = np.where(table.controlled, table.wanted_speed, np.maximum(self._speed, 1.0))
        self._reach = LOOK_TIME * self._target[rows]
        self._leader, self._gap = occupancy.leaders(node, rows, routes, self._reach)
        self._block = blocks(occupancy, table, rows, node, routes)
        self._table = table
        follower, behind = occupancy.followers(node, rows)
        self._now = self._free_of(rows, self._gap, self._leader, self._block)
        whole = behind + occupancy.length[rows] + self._gap
        self._relief = np.where(
            follower >= 0,
            felt(self._acceleration(follower, whole, self._leader))
            - felt(self._acceleration(follower, behind, rows)),
            0.0,
        )

    def worth(self, way: int, needed: FloatArray, stretch: FloatArray) -> FloatArray:
        """[n] m/s^2 that a change gains, with the bias; -inf where it is impossible, unsafe or of no use."""
        worth = np.full(len(self._rows), -np.inf)
        beside = (self._road.left if way == LEFT else self._road.right)[self._node]
        use = (beside >= 0) & self._permitted(way)
        if way == LEFT:
            use &= (self._leader >= 0) | np.isfinite(self._block)  # or there is nothing to gain
        use[use] = self._leads_on(beside[use], np.flatnonzero(use), way, needed[use], stretch[use])
        k = np.flatnonzero(use)
        if not len(k):
            return worth
        rows, node, occupancy = self._rows[k], beside[k], self._occupancy
        routes = [self._routes[i] for i in k.tolist()]
        leader, gap = occupancy.leaders(node, rows, routes, self._reach[k])
        block = blocks(occupancy, self._table, rows, node, routes)
        follower, behind = occupancy.followers(node, rows)
        own = self._free_of(rows, gap, leader, block)
        whole = np.maximum(behind, 0.0) + occupancy.length[rows] + np.maximum(gap, 0.0)
        before = self._acceleration(follower, whole, leader)
        after = np.where(follower >= 0, self._acceleration(follower, behind, rows), 0.0)
        burden = np.where(follower >= 0, felt(after) - felt(before), 0.0)
        advantage = felt(own) - felt(self._now[k])
        way_out = block > self._block[k] + FARTHER
        value = gain(advantage, burden, self._relief[k]) + WAY_OUT * way_out
        if way == LEFT:
            value = np.where((advantage > 0) | way_out, value - KEEP_RIGHT, -np.inf)
        else:
            free = (leader < 0) | (self._speed[leader] > self._target[rows])
            free &= np.isinf(block)
            value = value + KEEP_RIGHT * free
        worth[k] = np.where(safe(own, after), value, -np.inf)
        return worth

    def _permitted(self, way: int) -> BoolArray:
        """[n] whether the vehicles' class may change to that side."""
        name = "left" if way == LEFT else "right"
        lanes = self._road.graph.node_lane[self._node].tolist()
        return np.array([getattr(r.rules, name)[i] for r, i in zip(self._routes, lanes, strict=True)], bool)

    def _acceleration(self, rows: IntArray, gap: FloatArray, leader: IntArray) -> FloatArray:
        """Of the vehicles ``rows`` behind the ``leader`` rows, -1 for none; rows -1 give a number, too."""
        return acceleration(self._speed[rows], self._target[rows], gap, self._speed[leader])

    def _free_of(self, rows: IntArray, gap: FloatArray, leader: IntArray, block: FloatArray) -> FloatArray:
        """Of the vehicles ``rows`` behind their leaders and the standing vehicles ``block`` m ahead."""
        stands = acceleration(self._speed[rows], self._target[rows], block, np.zeros(len(rows)))
        return np.minimum(self._acceleration(rows, gap, leader), stands)

    def _leads_on(
        self, beside: IntArray, k: IntArray, way: int, needed: FloatArray, stretch: FloatArray
    ) -> BoolArray:
        """Whether the lanes beside lead on along the route without a needed change soon."""
        lane = self._road.graph.node_lane[beside]
        changes, room = (
            np.array(
                [getattr(self._routes[i], name)[j] for i, j in zip(k.tolist(), lane.tolist(), strict=True)]
            )
            for name in ("changes", "room")
        )
        room = room - (beside - self._road.first[lane])
        soon = (changes > 0) & (changes >= needed) & (room < (changes + 1.0) * stretch)
        astray = changes > needed if way == RIGHT else ~np.isfinite(changes)
        return np.isfinite(changes) & ~soon & ~astray
