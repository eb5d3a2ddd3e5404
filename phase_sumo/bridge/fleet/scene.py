"""The traffic of a running simulation: who is there, and where SUMO's own vehicles are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from phase_sumo.bridge.fleet.event_log import EventLog
from phase_sumo.bridge.fleet.parameters import Parameters
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.sumo.conventions import ShapeRow, reference_from_front, yaw_from_angle
from phase_sumo.bridge.sumo.session import Simulation, bare
from phase_sumo.sim.dimensions import Kind

MIRRORED = ("LaneID", "Position", "Angle", "Speed", "Acceleration")
REMOVED_BY_SUMO = "by SUMO"


@dataclass
class Trip:
    """One vehicle's way through the simulation.

    Attributes:
        vehicle, type: ids.
        depart, delay: s, of the insertion as in SUMO's tripinfo, and how much later than wanted that was.
        arrive: s, as in SUMO's tripinfo, NaN while it runs or when it was removed.
        removed: reason, "" if it was not.
        policy_seconds, freeway_seconds, seconds: under the policy, on the observed road, and in total.
        policy_metres: driven under the policy.
        after_hand_back: collisions up to 10 s after the policy gave it back.
        guard_leader, guard_beside, guard_road_edge, guard_standing: decisions in which the guard did not let
            the policy do what it wanted, by reason (see `sim.hazards.Reason`).
        guard_unsafe: those in which nothing was safe.
        guard_seconds: their time.
        guard_jerk: m/s^2, the differences between the jerks taken and those wanted, summed over their time.
        adopted, finished: the policy drove it at some time; the policy drove it to its arrival.
    """

    vehicle: str
    type: str
    depart: float
    delay: float = 0.0
    arrive: float = float("nan")
    removed: str = ""
    policy_seconds: float = 0.0
    freeway_seconds: float = 0.0
    seconds: float = 0.0
    policy_metres: float = 0.0
    after_hand_back: int = 0
    guard_leader: int = 0
    guard_beside: int = 0
    guard_road_edge: int = 0
    guard_standing: int = 0
    guard_unsafe: int = 0
    guard_seconds: float = 0.0
    guard_jerk: float = 0.0
    adopted: bool = False
    finished: bool = False


@dataclass
class VehicleFacts:
    """Constants of a vehicle, read once."""

    type: str
    vehicle_class: str
    shape: ShapeRow
    kind: Kind | None


class Scene:
    """Follows SUMO's vehicle list and mirrors the vehicles on the observed road in a table.

    Attributes:
        table: rows of the vehicles on the observed road.
        trips: every vehicle that was ever inserted.
        facts: type and shape of the present vehicles.
        types: vehicle id -> vType id of the present vehicles.
        lane_of: lane id of the SUMO-driven vehicles in the table.
        departed: ids inserted in the last step.
        teleported: ids that SUMO took off the road in the last step, to put them back elsewhere.
        teleports: how often it did so.
        events: what happened.
    """

    def __init__(
        self,
        session: Simulation,
        observed_edges: frozenset[str] | None,
        origin: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``observed_edges`` None observes every road; ``origin`` as in `VehicleTable`."""
        self.session = session
        self.api = session.api
        self.table = VehicleTable(origin=origin)
        self.trips: dict[str, Trip] = {}
        self.facts: dict[str, VehicleFacts] = {}
        self.types: dict[str, str] = {}
        self.lane_of: dict[str, str] = {}
        self.departed: tuple[str, ...] = ()
        self.teleported: tuple[str, ...] = ()
        self.teleports = 0
        self.events = EventLog(session, self.table, self.types)
        self._observed = observed_edges
        self._edge_of: dict[str, str] = {}
        self._crossings: dict[str, bool] = {}  # whether each junction's edge that was asked for is observed
        self._getters = [bare(self.api, "vehicle", f"get{name}") for name in MIRRORED]
        for vehicle in self.api.vehicle.getIDList():  # of a simulation that runs already
            self._enter(vehicle, float(self.api.vehicle.getDeparture(vehicle)))

    def update(self) -> None:
        """Read what the last step of SUMO changed; rows of controlled vehicles are left alone."""
        time = self.events.now
        self.departed = tuple(self.api.simulation.getDepartedIDList())
        for vehicle in self.departed:
            self._enter(vehicle, time)
        for vehicle in self.api.simulation.getArrivedIDList():
            if vehicle in self.facts:
                self.trips[vehicle].arrive = time
                self.forget(vehicle)
        self.teleported = tuple(self.api.simulation.getStartingTeleportIDList())
        self.teleports += len(self.teleported)
        for vehicle in self.teleported:
            row = self.table.row_of.get(vehicle)
            if row is not None and not self.table.controlled[row]:
                self.leave(vehicle)
        present = self.api.vehicle.getIDList()
        if len(present) != len(self.facts):
            for vehicle in set(self.facts) - set(present):
                if not self._exists(vehicle):
                    self.take_out(vehicle, REMOVED_BY_SUMO)
        self._mirror(present)
        for vehicle in self.facts:
            trip = self.trips[vehicle]
            trip.seconds += self.session.step_length
            if vehicle in self.table.row_of:
                trip.freeway_seconds += self.session.step_length

    def take_out(self, vehicle: str, reason: str) -> None:
        """The vehicle leaves the simulation before its arrival."""
        self.events.record("removal", vehicle, reason)
        self.trips[vehicle].removed = reason
        self.forget(vehicle)

    def forget(self, vehicle: str) -> None:
        """The vehicle left the simulation."""
        del self.facts[vehicle], self.types[vehicle]
        self.leave(vehicle)

    def leave(self, vehicle: str) -> None:
        """The vehicle left the observed road."""
        self.lane_of.pop(vehicle, None)
        if vehicle in self.table.row_of:
            self.table.remove(vehicle)

    def edge(self, lane: str) -> str:
        """Edge of a lane id, cached; lane ids may hold any character."""
        edge = self._edge_of.get(lane)
        if edge is None:
            edge = self._edge_of[lane] = lane.rpartition("_")[0]
        return edge

    def accounts(self) -> dict[str, int]:
        """Where all inserted vehicles are now: inserted = arrived + running + removed."""
        trips = self.trips.values()
        removed: dict[str, int] = {}
        for trip in trips:
            if trip.removed:
                removed[trip.removed] = removed.get(trip.removed, 0) + 1
        return {
            "inserted": len(self.trips),
            "arrived": sum(math.isfinite(t.arrive) for t in trips),
            "running": len(self.facts),
            **{f"removed: {reason}": count for reason, count in sorted(removed.items())},
        }

    def _exists(self, vehicle: str) -> bool:
        """SUMO does not list a vehicle that is on no lane, but still knows it."""
        try:
            self.api.vehicle.getRouteIndex(vehicle)
        except self.session.refused:
            return False
        return True

    def _enter(self, vehicle: str, time: float) -> None:
        kind = self.api.vehicle.getTypeID(vehicle)
        own = str(self.api.vehicle.getVehicleClass(vehicle))
        facts = VehicleFacts(kind, own, *Parameters(self.api, vehicle, kind).shape())
        self.facts[vehicle] = facts
        self.types[vehicle] = kind
        self.trips[vehicle] = Trip(vehicle, kind, time, float(self.api.vehicle.getDepartDelay(vehicle)))

    def _mirror(self, present: tuple[str, ...]) -> None:
        table = self.table
        lane_id, place, heading, velocity, acceleration = self._getters
        rows, x, y, angle, speed, accel, overhang = [], [], [], [], [], [], []
        fresh: list[int] = []
        for vehicle in present:
            row = table.row_of.get(vehicle)
            if row is not None and table.controlled[row]:
                continue
            lane = lane_id(vehicle)
            if not self._is_observed(vehicle, lane, row is not None):
                if row is not None:
                    self.leave(vehicle)
                continue
            if row is None:
                row = table.add(vehicle, self.facts[vehicle].shape)
                fresh.append(len(rows))
            self.lane_of[vehicle] = lane
            position = place(vehicle)
            rows.append(row)
            x.append(position[0])
            y.append(position[1])
            angle.append(heading(vehicle))
            speed.append(velocity(vehicle))
            accel.append(acceleration(vehicle))
            overhang.append(self.facts[vehicle].shape.front_overhang)
        if not rows:
            return
        index = np.array(rows)
        yaw = yaw_from_angle(angle)
        table["yaw"][index[fresh]] = yaw[fresh]  # a trailer starts out straight
        left, below = table.origin
        back_x, back_y = reference_from_front(np.array(x) - left, np.array(y) - below, yaw, overhang)
        table.follow(index, back_x, back_y, yaw, np.array(speed), np.array(accel), self.session.step_length)

    def _is_observed(self, vehicle: str, lane: str, before: bool) -> bool:
        """A way across a junction belongs to the one road that it leads on from."""
        if self._observed is None:
            return bool(lane)
        edge = self.edge(lane)
        if not lane.startswith(":"):
            return edge in self._observed
        if before:
            return True
        if edge not in self._crossings:
            route, at = self.api.vehicle.getRoute(vehicle), self.api.vehicle.getRouteIndex(vehicle)
            self._crossings[edge] = route[at] in self._observed
        return self._crossings[edge]
