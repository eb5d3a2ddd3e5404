"""What is asked of vehicles while PHASE drives them: other routes, and stops.

A new route shows in the name that SUMO gives it. moveToXY gives one, too, to a vehicle that it finds off its
route: the one or two edges where it is. That is nobody's wish, and SUMO is told the real route again as soon
as the vehicle is back on it. Stops are SUMO's: a vehicle is given back in time to change lanes and to brake,
and taken over again behind them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np

from phase_sumo.bridge.fleet.drivers import Member
from phase_sumo.bridge.fleet.lane_rules import LaneRules
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import follow_lanes, kept_stretch, route_lanes
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.fleet.way_off import WayOff
from phase_sumo.bridge.sumo.session import bare

ROUTES_KEPT = 1000  # whose lanes are remembered for vehicles to come
PERIOD = 0.5  # s between two looks
STOP_TIME, STOP_ROOM = 12.0, 150.0  # s of driving, at least m, before a stop: SUMO takes over


class Plans:
    """Compares what SUMO holds of each vehicle's route and stops with what PHASE drives by.

    Attributes:
        way_off: the ends of the observed road.
    """

    def __init__(self, scene: Scene, road: Road, rules: LaneRules) -> None:
        self._scene, self._api, self._road, self._rules = scene, scene.api.vehicle, road, rules
        self._routes: dict[tuple[tuple[str, ...], str, str, bool], RouteLanes] = {}
        self._follow = follow_lanes(road)
        self.way_off = WayOff(scene.api, road)
        self._name = bare(scene.api, "vehicle", "getRouteID")
        self._next = -np.inf

    def due(self, time: float) -> bool:
        """Whether it is time for the next look."""
        due = time >= self._next - 1e-6
        if due:
            self._next = time + PERIOD
        return due

    def remember(self, vehicle: str, member: Member) -> None:
        """SUMO's route is what the vehicle drives by."""
        member.route_id, member.displaced = self._name(vehicle), False
        member.trip = self.ahead(vehicle)

    def ahead(self, vehicle: str) -> tuple[str, ...]:
        """Edges of SUMO's route from where SUMO sees the vehicle."""
        return tuple(self._api.getRoute(vehicle))[max(self._api.getRouteIndex(vehicle), 0) :]

    def changed(self, vehicle: str, member: Member) -> bool:
        """Whether somebody gave the vehicle another route, which is its `Member.trip` from now on."""
        if self._name(vehicle) == member.route_id:
            return False
        member.route_id = self._name(vehicle)
        trip = self.ahead(vehicle)
        if self._is_of_move(vehicle, trip, member):
            member.displaced = True
            return False
        same = trip and trip == member.trip[-len(trip) :]
        member.trip, member.displaced = trip, False
        return not same

    def restore(self, vehicle: str, member: Member) -> None:
        """Give SUMO the route back that moveToXY took, where the vehicle is on it again."""
        if not member.displaced:
            return
        edge = self._scene.edge(self._api.getLaneID(vehicle))
        if edge in member.trip:
            with contextlib.suppress(self._scene.session.refused):
                self._api.setRoute(vehicle, member.trip[member.trip.index(edge) :])
                member.route_id, member.displaced = self._name(vehicle), False

    def take(self, vehicle: str, member: Member) -> bool:
        """Drive by the member's trip from now on; False, and nothing new, where that cannot be."""
        edges, lanes = self.stretch(vehicle, member.trip)
        if not edges or len(set(member.trip)) < len(member.trip):
            return False
        member.route = lanes
        member.edges, member.leads_off, member.wrong = edges, len(edges) < len(member.trip), False
        return True

    def find_way(self, vehicle: str, member: Member, node: int) -> None:
        """For a vehicle off its route: let SUMO look for another way, else follow the lane."""
        goal = member.trip[-1]
        if not member.wrong:
            member.wrong = True
            self._scene.events.record("wrong exit", vehicle, f"off the way to {goal}")
        if self._api.getLaneID(vehicle).startswith(":"):
            return
        trip: tuple[str, ...] = ()
        with contextlib.suppress(self._scene.session.refused):
            self._api.changeTarget(vehicle, goal)
            trip = self.ahead(vehicle)
        edges, lanes = self.stretch(vehicle, trip)
        if trip[-1:] == (goal,) and np.isfinite(lanes.changes[self._road.graph.node_lane[node]]):
            member.route, member.edges, member.wrong = lanes, edges, False
            member.leads_off = len(edges) < len(trip)
            self.remember(vehicle, member)
            self._scene.events.record("reroute", vehicle, f"another way to {goal}")
        else:
            member.route, member.edges, member.leads_off = self._follow, (), False

    def stretch(self, vehicle: str, route: Sequence[str], at: int = 0) -> tuple[tuple[str, ...], RouteLanes]:
        """The next edges of a route, from index ``at`` on, that PHASE may drive on, and what lanes mean.

        The latter is made once for all vehicles of a class.
        """
        facts = self._scene.facts[vehicle]
        rules = self._rules.of(facts.vehicle_class)
        edges = kept_stretch(self._road, route, at, rules)
        onto = "".join(route[at + len(edges) : at + len(edges) + 1]) if edges else ""
        key = (edges, onto, facts.vehicle_class, bool(facts.shape.truck))
        if key not in self._routes:
            if len(self._routes) == ROUTES_KEPT:
                del self._routes[next(iter(self._routes))]  # the oldest
            leave = self.way_off.lanes(edges[-1], onto) if onto else None
            self._routes[key] = route_lanes(self._road, edges, key[3], rules, leave)
        return edges, self._routes[key]

    def follow_rules(self, changed: set[str], members: dict[str, Member]) -> list[str]:
        """Look again at the routes over edges on which lanes were closed or opened.

        Returns:
            vehicles that may not drive on.
        """
        if not changed:
            return []
        self._routes.clear()
        stuck = []
        for vehicle, member in members.items():
            if changed.isdisjoint(member.edges):
                continue
            here = self.ahead(vehicle)[:1]
            at = member.trip.index(here[0]) if here and here[0] in member.trip else 0
            edges, lanes = self.stretch(vehicle, member.trip, at)
            if edges:
                member.edges, member.route = edges, lanes
                member.leads_off = len(edges) < len(member.trip) - at
            else:
                stuck.append(vehicle)
        return stuck

    def stop_room(self, vehicle: str, edges: tuple[str, ...]) -> float:
        """m to the next stop if that is on one of some edges, inf if not."""
        stops = self._api.getStops(vehicle, 1)
        if not stops:
            return np.inf
        edge, _, index = stops[0].lane.rpartition("_")
        if edge not in edges:
            return np.inf
        return float(self._api.getDrivingDistance(vehicle, edge, stops[0].endPos, int(index)))

    def _is_of_move(self, vehicle: str, trip: tuple[str, ...], member: Member) -> bool:
        if len(trip) > 2 or trip == member.trip[-len(trip) :]:
            return False
        lane = self._api.getLaneID(vehicle)
        return not lane or lane.startswith(":") or self._scene.edge(lane) not in member.trip


def stops_soon(room: float, speed: float) -> bool:
    """Whether SUMO must see to a stop ``room`` m ahead at a speed in m/s."""
    return room < max(STOP_TIME * speed, STOP_ROOM)
