"""Which lanes lead along a route, how many lane changes are still needed, and until where.

The same idea as SUMO's best lanes, worked out once per stretch of route and kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.fleet.class_rules import ClassRules
from phase_sumo.bridge.fleet.drivers import Member
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.sim.curve_speed import BRAKING, FASTEST, braked_to, exit_speeds

LIMIT_AHEAD = 500.0  # m within which lower speed limits matter


@dataclass(frozen=True)
class Place:
    """A point ahead: position in m, direction in rad, and its lane."""

    x: float
    y: float
    yaw: float
    lane: int


def kept_stretch(
    road: Road, edges: Sequence[str], at: int, rules: ClassRules | None = None
) -> tuple[str, ...]:
    """The part of a route from index ``at`` on that stays on the observed road without a break.

    With ``rules`` it ends before an edge on which these allow no lane.
    """
    stretch = []
    for edge in edges[at:]:
        if edge not in road.edges or (rules and not rules.allowed[road.lanes_of[edge]].any()):
            break
        stretch.append(edge)
    return tuple(stretch)


def route_lanes(
    road: Road,
    edges: Sequence[str],
    truck: bool,
    rules: ClassRules | None = None,
    leave: Mapping[int, float] | None = None,
) -> RouteLanes:
    """Work backwards from the last edge of a stretch, on which every lane that is allowed counts as arrived.

    Where the route goes on, that are the lanes which lead on (``leave``, see `RouteLanes`), if there are any.

    A lane that is closed to the vehicle is no way on: who is in it must leave it at once, for a lane beside.

    Args:
        edges: consecutive edges of the observed road.
        truck: curves are driven as trucks do.
        rules: what the lanes allow the vehicle's class; as the network file says it by default.
    """
    rules = rules or ClassRules.of_network(road.network, truck)
    leave = {i: speed for i, speed in (leave or {}).items() if rules.allowed[i]}
    size = len(road.network.lanes)
    changes, room, rest = np.full(size, np.inf), np.zeros(size), road.metres.copy()
    onward, side = np.full(size, -1, np.int64), np.zeros(size, np.int64)
    for k, edge in enumerate(reversed(edges)):
        here = road.lanes_of.get(edge, [])
        for i in here:
            if not rules.allowed[i]:
                continue
            if k == 0 and (not leave or i in leave):
                changes[i], room[i] = 0.0, np.inf
            elif k == 0:
                room[i] = road.metres[i]
            else:
                _extend(road, i, changes, room, onward, rules)
        _sideways(road, here, changes, side, rules)
        _add_up(road, here, onward, rest)
    view = road.views.of(onward, np.isfinite(changes))
    speeds = _exit_speeds(road, onward, truck, leave)
    return RouteLanes(changes, room, onward, side, speeds, rest, view, rules, leave)


def follow_lanes(road: Road) -> RouteLanes:
    """Stay in lane, take the first way on: for a vehicle that has lost its route."""
    size = len(road.network.lanes)
    onward = np.array([f[0] if f else -1 for f in road.following], np.int64).reshape(-1)
    speed = _exit_speeds(road, onward, True, {})
    return RouteLanes(
        np.zeros(size),
        np.full(size, np.inf),
        onward,
        np.zeros(size, np.int64),
        speed,
        np.array([_way_out(road, onward, i) for i in range(size)]),
        np.zeros((size, 3), np.int64),
        ClassRules.of_network(road.network, truck=True),
    )


def _exit_speeds(road: Road, onward: IntArray, truck: bool, leave: Mapping[int, float]) -> FloatArray:
    last = np.full(len(onward), FASTEST)
    last[list(leave)] = list(leave.values())
    return exit_speeds(road.curve_speed[int(truck), road.first], road.metres, onward, last)


def _extend(
    road: Road, i: int, changes: FloatArray, room: FloatArray, onward: IntArray, rules: ClassRules
) -> None:
    """Value of lane i from the lanes that follow it; connectors get theirs on the way.

    Lanes of later edges have their values; all others still hold inf.
    """
    lanes = road.network.lanes
    best = (np.inf, 0.0, -1)
    for j in road.following[i]:
        if lanes[j].connector:
            if not rules.allowed[j] and rules.allowed[road.following[j]].any():
                continue  # the way is closed, not what lies behind it
            targets = [k for k in road.following[j] if np.isfinite(changes[k])]
            if not targets:
                continue
            k = targets[0]
            changes[j], onward[j] = changes[k], k
            room[j] = road.metres[j] + room[k]
        if np.isfinite(changes[j]):
            best = min(best, (float(changes[j]), -float(room[j]), j))
    changes[i] = best[0]
    onward[i] = best[2]
    room[i] = road.metres[i] - best[1] if best[2] >= 0 else road.metres[i]


def _sideways(road: Road, here: list[int], changes: FloatArray, side: IntArray, rules: ClassRules) -> None:
    """Let lanes profit from their neighbours: one change more than the better one."""
    beside: dict[int, list[tuple[int, int]]] = {i: [] for i in here}
    for sign, may, abreast in ((1, rules.left, road.abreast[0]), (-1, rules.right, road.abreast[1])):
        for i in here:
            if may[i] and abreast[i] >= 0:
                beside[i].append((sign, int(abreast[i])))
    for _ in here:
        for i in here:
            for sign, j in beside[i]:
                if changes[j] + 1.0 < changes[i]:
                    changes[i], side[i] = changes[j] + 1.0, sign
    for i in here:  # where staying is as good, the side is still worth knowing
        if side[i] == 0 and changes[i] > 0:
            for sign, j in beside[i]:
                if changes[j] < changes[i]:
                    side[i] = sign


def _add_up(road: Road, here: list[int], onward: IntArray, rest: FloatArray) -> None:
    """Metres to the end of the route: a lane that ends before (an acceleration lane) is left in time."""
    for i in here:
        j = int(onward[i])
        if j >= 0:
            if road.network.lanes[j].connector:
                rest[j] = road.metres[j] + rest[onward[j]]
            rest[i] = road.metres[i] + rest[j]
    going_on = [rest[i] for i in here if onward[i] >= 0]
    if going_on:
        rest[[i for i in here if onward[i] < 0]] = max(going_on)


def _way_out(road: Road, onward: IntArray, lane: int) -> float:
    """Metres from a lane's start until the way ``onward`` ends."""
    total, seen = 0.0, set[int]()
    while lane >= 0 and lane not in seen:
        seen.add(lane)
        total, lane = total + float(road.metres[lane]), int(onward[lane])
    return total


def ahead(road: Road, route: RouteLanes, node: int, distance: float) -> Place:
    """The lane node ``distance`` m further along the route; straight on beyond the last lane's end."""
    graph = road.graph
    lane = int(graph.node_lane[node])
    target = road.offset(node) + distance
    while target > road.count[lane] - 1 and route.onward[lane] >= 0:
        target -= road.count[lane]
        lane = int(route.onward[lane])
    beyond = max(target - (road.count[lane] - 1), 0.0)
    at = int(road.first[lane] + min(max(round(target), 0), road.count[lane] - 1))
    x, y, yaw = (float(v) for v in (*graph.node_xy[at], graph.node_yaw[at]))
    return Place(x + beyond * np.cos(yaw), y + beyond * np.sin(yaw), yaw, lane)


def curve_speed(
    road: Road, routes: Sequence[RouteLanes], node: IntArray, truck: BoolArray, lead: FloatArray
) -> FloatArray:
    """[n] m/s at which nodes may be passed for the curves ahead on their routes [n].

    Args:
        truck: [n].
        lead: [n] m by which the speed must be reached earlier.
    """
    lane = road.graph.node_lane[node]
    leave = np.array([route.exit_speed[i] for route, i in zip(routes, lane.tolist(), strict=True)])
    left = road.graph.lane_end[node] - node  # nodes, which are about 1 m apart
    sooner = node + np.minimum(np.round(lead).astype(np.int64), left)
    kind = truck.astype(np.int64)
    within = np.minimum(road.curve_speed[kind, node], road.curve_speed[kind, sooner])
    speed = np.minimum(within, braked_to(leave, np.maximum(left - lead, 0.0)))
    for k in np.flatnonzero((lead > left) & (leave < FASTEST)).tolist():
        behind = _speed_behind(road, routes[k], int(lane[k]), int(kind[k]), float(lead[k] - left[k]))
        speed[k] = min(speed[k], behind)
    return speed


def limits_ahead(
    road: Road, routes: Sequence[RouteLanes], node: IntArray, factor: FloatArray, lead: FloatArray
) -> FloatArray:
    """[n] m/s that the lanes allow at nodes, less before lanes that allow less.

    Args:
        factor: [n] on the limits.
        lead: [n] m by which the speed must be reached earlier.
    """
    lane = road.graph.node_lane[node].tolist()
    limit, cap, least = (
        np.array([getattr(r.rules, name)[i] for r, i in zip(routes, lane, strict=True)])
        for name in ("limit", "cap", "least")
    )
    speed = np.minimum(factor * limit, cap)
    for k in np.flatnonzero(factor * least < speed - 0.1).tolist():
        route, at = routes[k], lane[k]
        metres = float(road.count[at] - 1 - road.offset(int(node[k])) - lead[k])
        while metres < LIMIT_AHEAD and (at := int(route.onward[at])) >= 0:
            there = min(factor[k] * route.rules.limit[at], route.rules.cap[at])
            speed[k] = min(speed[k], np.sqrt(there**2 + 2.0 * BRAKING * max(metres, 0.0)))
            metres += float(road.count[at])
    return speed


def _speed_behind(road: Road, route: RouteLanes, lane: int, kind: int, metres: float) -> float:
    """m/s at ``metres`` behind the end of a lane, for the curves from there on."""
    while (lane := int(route.onward[lane])) >= 0:
        left = int(road.count[lane]) - 1 - round(metres)
        if left >= 0:
            node = road.first[lane] + round(metres)
            onward = braked_to(route.exit_speed[lane : lane + 1], np.array([left]))[0]
            return min(float(road.curve_speed[kind, node]), float(onward))
        metres -= int(road.count[lane])
    return FASTEST


def path(road: Road, route: RouteLanes, node: int, length: float) -> IntArray:
    """Nodes along the route from ``node`` over ``length`` m, or to the end of the last lane."""
    lane, parts, wanted = int(road.graph.node_lane[node]), [], round(length) + 1
    start = node
    while wanted > 0 and lane >= 0:
        end = min(int(road.first[lane] + road.count[lane]), start + wanted)
        parts.append(np.arange(start, end))
        wanted -= end - start
        lane = int(route.onward[lane])
        start = int(road.first[lane])
    return np.concatenate(parts)


def remaining(road: Road, route: RouteLanes, node: int) -> float:
    """m from the node to the end of the stretch, lane changes included."""
    lane = int(road.graph.node_lane[node])
    return float(route.rest[lane]) - 1.0 - road.offset(node)


def past_end(road: Road, members: Sequence[Member], node: IntArray, front: FloatArray) -> list[bool]:
    """Whether each member's new pose is past the end of the last lane of its route.

    Args:
        node: [n] of the members before the move, -1 off the road.
        front: [n, 2] front bumper centres in m after it.
    """
    graph = road.graph
    lane = graph.node_lane[np.maximum(node, 0)]
    end = road.first[lane] + road.count[lane] - 1
    yaw = graph.node_yaw[end].astype(np.float64)
    dx, dy = (front - graph.node_xy[end]).T
    past = (node >= 0) & (dx * np.cos(yaw) + dy * np.sin(yaw) > -0.3)
    for k in np.flatnonzero(past).tolist():
        member = members[k]
        last = not member.leads_off and bool(member.edges)
        past[k] = last and road.network.lanes[int(lane[k])].edge == member.edges[-1]
    return past.tolist()
