"""Taking vehicles over from SUMO: which, when, and what SUMO is told about it."""

from __future__ import annotations

import contextlib
from collections.abc import Container, Iterator

import numpy as np

from phase_sumo.bridge.fleet.drivers import Drivers, Member
from phase_sumo.bridge.fleet.occupancy import Occupancy, overall_length, standing_rooms
from phase_sumo.bridge.fleet.parameters import TARGET_SPEEDS, Choice, Parameters
from phase_sumo.bridge.fleet.plans import Plans, stops_soon
from phase_sumo.bridge.fleet.right_of_way import RightOfWay
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import curve_speed, remaining
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.errors import PhaseError

ADOPT_ROOM = 150.0  # m of observed road ahead below which a vehicle is left to SUMO
# rad and m/s sideways that a vehicle may drive out of line with its lane: SUMO's turn off at any speed
ALIGNED, DRIFT = 0.1, 0.8
TOO_FAST = 4.0  # m/s above what the curves ahead allow with gentle braking
QUEUE_TIME, QUEUE_ROOM = 5.0, 60.0  # s of driving, at least m, to one who stands: SUMO's until it goes on
STOP_MARGIN = 1.5  # times the room before a stop, or a vehicle would be given back at once
REST = 5.0  # s for which a vehicle that was given back stays SUMO's
ADOPT_EASE = 1.3  # times the room in which a vehicle would be given back, see `RightOfWay`
SPEED_MODE, LANE_MODE = 96, 0  # SUMO checks nothing while we drive


class Adoption:
    """Looks at SUMO's vehicles on the observed road and takes over those that are chosen.

    Attributes:
        left_to_sumo: vehicles that were looked at or driven and stay with SUMO.
    """

    def __init__(
        self,
        scene: Scene,
        road: Road,
        choice: Choice,
        drivers: Drivers,
        plans: Plans,
        ways: RightOfWay,
    ) -> None:
        self._scene, self._api, self._table = scene, scene.api, scene.table
        self._road = road
        self._choice, self._drivers, self._plans, self._ways = choice, drivers, plans, ways
        self.left_to_sumo: set[str] = set()
        self._waiting: set[str] = set()  # chosen, but not where they can be taken over
        self._occupancy: Occupancy | None = None
        self._rests: dict[str, float] = {}
        self._held: dict[str, frozenset[str]] = {}  # edges on which a vehicle stays with SUMO for now
        self._asked = 0

    def take_over(self, node: np.ndarray, driven: Container[str]) -> Iterator[tuple[str, Member]]:
        """Vehicles that are the policy's from now on.

        Args:
            node: [N] node of each row's front bumper, -1 off the road.
            driven: ids of those that it drives already.
        """
        self._occupancy = None
        for vehicle, lane in list(self._scene.lane_of.items()):
            if vehicle in self.left_to_sumo or vehicle in driven or lane.startswith(":"):
                continue
            facts = self._scene.facts[vehicle]
            if vehicle not in self._waiting:
                if facts.kind is None or self._serves(vehicle) or not self._wanted(vehicle, facts.type):
                    self.left_to_sumo.add(vehicle)
                    continue
                self._waiting.add(vehicle)
            row = self._table.row_of[vehicle]
            if self._rests and self._rests.get(vehicle, 0.0) > self._scene.session.time:
                continue
            if self._held and self._scene.edge(lane) in self._held.get(vehicle, ()):
                continue
            found = self._stretch(vehicle, int(node[row]))
            if found and not self._queues(node, row, found[0]):
                self._waiting.remove(vehicle)
                self._steer(row, int(node[row]))
                self._held.pop(vehicle, None)
                yield vehicle, self._take(vehicle, row, *found)

    def wait(self, vehicle: str, edges: frozenset[str] = frozenset()) -> None:
        """A vehicle that was given back may be taken over again after a while, but not on these edges."""
        self.left_to_sumo.discard(vehicle)
        self._waiting.add(vehicle)
        self._rests[vehicle] = self._scene.session.time + REST
        self._held[vehicle] = edges

    def forget_absent(self) -> None:
        """Keep nothing of vehicles that left the simulation."""
        for vehicle in self._rests.keys() - self._scene.facts.keys():
            del self._rests[vehicle]
            self._held.pop(vehicle, None)
        self.left_to_sumo.intersection_update(self._scene.facts)
        self._waiting.intersection_update(self._scene.facts)

    def _stretch(self, vehicle: str, node: int) -> tuple[RouteLanes, tuple[str, ...], bool] | None:
        """Lanes and edges of the route's next stretch on the observed road, and whether it leads off it."""
        if node < 0:
            return None
        route = tuple(self._api.vehicle.getRoute(vehicle))
        at = self._api.vehicle.getRouteIndex(vehicle)
        edges, lanes = self._plans.stretch(vehicle, route, at)
        if not edges or self._stops_soon(vehicle, edges) or len(set(route)) < len(route):
            return None  # on a route that uses an edge twice, SUMO finds moved vehicles on the first lap
        row, here = self._table.row_of[vehicle], np.array([node])
        if not self._in_line(row, node):
            return None
        truck_here = self._table["truck"][row : row + 1]
        fastest = curve_speed(self._road, [lanes], here, truck_here, np.zeros(1))
        if self._table["speed"][row] > fastest + TOO_FAST:
            return None  # SUMO's vehicles take any curve at any speed
        lane = int(self._road.graph.node_lane[node])
        leads_off = at + len(edges) < len(route)
        if not lanes.rules.allowed[lane] or self._barred(vehicle, lanes, leads_off, node):
            return None
        if leads_off and remaining(self._road, lanes, node) < ADOPT_ROOM:
            return None
        return lanes, edges, leads_off

    def _in_line(self, row: int, node: int) -> bool:
        """Whether a vehicle is on the observed road as a whole, and drives as its lane leads."""
        road, table = self._road, self._table
        lane, passed = int(road.graph.node_lane[node]), road.offset(node)
        if passed < overall_length(table)[row] - 1.0 and not road.preceding[lane]:
            return False
        axle = node - min(round(float(table["length"][row] - table["rear_overhang"][row])), passed)
        turn = float(table["yaw"][row] - road.graph.node_yaw[axle])
        return np.cos(turn) >= np.cos(min(ALIGNED, DRIFT / max(float(table["speed"][row]), 1.0)))

    def _barred(self, vehicle: str, lanes: RouteLanes, leads_off: bool, node: int) -> bool:
        """Whether it would have to be given back soon, or is slower than the policy can drive."""
        api, speed = self._api.vehicle, float(self._table["speed"][self._table.row_of[vehicle]])
        if api.getMaxSpeed(vehicle) < TARGET_SPEEDS[0]:
            return True
        factor = float(api.getSpeedFactor(vehicle))
        return self._ways.bar(vehicle, lanes, leads_off, node, speed, factor, ease=ADOPT_EASE) is not None

    def _stops_soon(self, vehicle: str, edges: tuple[str, ...]) -> bool:
        """Whether it has a stop ahead or under way there: SUMO drives until it is done."""
        room = self._plans.stop_room(vehicle, edges)
        speed = float(self._table["speed"][self._table.row_of[vehicle]])
        return np.isfinite(room) and stops_soon(room / STOP_MARGIN, speed)

    def _queues(self, node: np.ndarray, row: int, lanes: RouteLanes) -> bool:
        """Whether somebody stands before the vehicle, or beside its way."""
        if self._occupancy is None:
            self._occupancy = Occupancy(self._road, self._table, node)
        rooms = standing_rooms(self._road, self._occupancy, node[[row]], np.array([row]), [lanes])
        return min(float(room[0]) for room in rooms) < max(
            QUEUE_TIME * float(self._table["speed"][row]), QUEUE_ROOM
        )

    def _serves(self, vehicle: str) -> bool:
        """Whether it is a taxi or runs on a line, whose stops and passengers are SUMO's."""
        api, taxi = self._api.vehicle, ""
        with contextlib.suppress(self._scene.session.refused):
            taxi = api.getParameter(vehicle, "has.taxi.device")
        return taxi == "true" or bool(api.getLine(vehicle))

    def _wanted(self, vehicle: str, kind: str) -> bool:
        marks = Parameters(self._api, vehicle, kind).marks()
        certain = self._choice.certain(vehicle, marks)
        if certain is not None:
            return certain
        self._asked += 1
        return self._choice.drawn(vehicle, kind, self._asked - 1, marks.share)

    def _steer(self, row: int, node: int) -> None:
        """Wheels, and a trailer that was never seen to move, as the road bends: SUMO knows neither."""
        table = self._table
        back = int(table["length"][row] - table["rear_overhang"][row])  # m from the bumper to the rear axle
        at = max(node - back, int(self._road.graph.lane_start[node]))
        curvature = float(self._road.graph.node_curvature[at])
        table["steer"][row] = np.arctan(table["wheelbase"][row] * curvature)
        table["steer_history"][row] = table["steer"][row]
        if table["hitch"][row] == 0.0:
            table["hitch"][row] = np.arcsin(np.clip(table["trailer_base"][row] * curvature, -0.9, 0.9))

    def _take(
        self, vehicle: str, row: int, lanes: RouteLanes, edges: tuple[str, ...], leads_off: bool
    ) -> Member:
        api, table = self._api.vehicle, self._table
        factor = float(api.getSpeedFactor(vehicle))
        highest, least = float(api.getMaxSpeed(vehicle)), float(api.getMinGap(vehicle))
        member = Member(lanes, edges, leads_off, factor, highest, least)
        api.setSpeedMode(vehicle, SPEED_MODE)
        api.setLaneChangeMode(vehicle, LANE_MODE)
        table.controlled[row] = True
        self.read_context(vehicle, row, member)
        sim = self._drivers[int(table.driver[row])].sim
        bounds = sim.truck_accel_bounds if table["truck"][row] else sim.accel_bounds
        table["accel"][row] = np.clip(table["accel"][row], *bounds)
        table["accel_history"][row] = table["accel"][row]
        self._plans.remember(vehicle, member)
        self._scene.lane_of.pop(vehicle, None)
        self._scene.trips[vehicle].adopted = True
        fresh = vehicle in self._scene.departed
        reason = "departed" if fresh else "reached the observed road"
        self._scene.events.record("adoption", vehicle, "taken back" if vehicle in self._rests else reason)
        return member

    def read_context(self, vehicle: str, row: int, member: Member) -> None:
        """Alpha, target speed, time gap, policy and guard as the vehicle's parameters say now."""
        context = Parameters(self._api, vehicle, self._scene.types[vehicle]).context()
        try:
            self._table.driver[row] = self._drivers.number(context.policy)
        except PhaseError as error:
            raise PhaseError(f"vehicle {vehicle!r}: parameter phase.policy: {error}") from None
        self._table.guarded[row] = self._choice.guard if context.guard is None else context.guard
        alpha = context.alpha
        self._table["alpha"][row] = self._choice.alpha_of(vehicle) if alpha is None else alpha
        member.target_speed = context.target_speed or 0.0
        time_gaps = (context.time_gap, self._choice.time_gap, float(self._api.vehicle.getTau(vehicle)))
        member.time_gap = next(gap for gap in time_gaps if gap is not None)
