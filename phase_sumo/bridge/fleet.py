"""The vehicles that PHASE drives: taken over from SUMO, moved, and given back."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import torch

from phase_sumo.bridge.choice import Choice
from phase_sumo.bridge.controller import Controller, Driver
from phase_sumo.bridge.conventions import angle_from_yaw
from phase_sumo.bridge.goals import GoalPlanner
from phase_sumo.bridge.member import Member
from phase_sumo.bridge.pose import PoseWriter
from phase_sumo.bridge.road import Road
from phase_sumo.bridge.route import RouteLanes, follow_lanes, kept_stretch, remaining, route_lanes
from phase_sumo.bridge.scene import Scene
from phase_sumo.errors import PhaseError
from phase_sumo.sim.events import road_contacts
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.vehicles import boxes

ADOPT_ROOM = 150.0  # m of observed road ahead below which a vehicle is left to SUMO
HAND_BACK_ROOM = 100.0  # m before the end of the observed road at which SUMO takes over again
KEEP_ON_LANE = 2.0  # s for which a vehicle that SUMO lost is told to be nearer to a lane
OFF_ROAD_SECONDS = 4.0  # s without a lane after which a vehicle is taken out
EDGE_CONTACT_APART = 1.0  # s without touching the road edge that end one contact
MIN_TARGET_SPEED, MAX_TARGET_SPEED = 3.0, 40.0  # m/s
SPEED_MODE, LANE_MODE = 96, 0  # SUMO checks nothing while we drive
SUMO_SPEED_MODE, SUMO_LANE_MODE = 31, 1621  # SUMO's defaults
VAPORIZED = 3


class Fleet:
    """Owns the poses of its vehicles; SUMO is told about them after every step."""

    def __init__(
        self, scene: Scene, network: LaneNetwork, driver: Driver, choice: Choice, publish_hitch: bool = False
    ) -> None:
        """``publish_hitch`` keeps the hitch angle in rad in each trailer's parameter ``phase.hitch``."""
        self._scene, self._table, self._api = scene, scene.table, scene.api
        self._driver, self._choice = driver, choice
        self._road = Road(network)
        self._planner = GoalPlanner(self._road, scene.table)
        self._controller = Controller(self._road, scene.table, driver, self._planner)
        self._members: dict[str, Member] = {}
        self._left_to_sumo: set[str] = set()
        self._node = np.full(len(scene.table), -1, np.int64)
        self._routes: dict[tuple[tuple[str, ...], bool], RouteLanes] = {}
        self._follow = follow_lanes(self._road)
        self._writer = PoseWriter(self._api, self._road, scene.table)
        self._substeps = 1
        self._publish_hitch = publish_hitch

    @property
    def cpu_per_decision(self) -> float:
        """CPU microseconds per vehicle and policy step."""
        return 1e6 * self._controller.cpu / max(self._controller.decisions, 1)

    def report(self) -> dict[str, Any]:
        """Counts beyond the common ones."""
        happened = self._scene.events.counts()
        return {
            "wrong_exits": happened["wrong exit"],
            "reroutes": happened["reroute"],
            "hand_backs": happened["hand-back"],
            "lane_change_goals": self._planner.changes_wanted,
            "decisions": self._controller.decisions,
        }

    def check_step(self, step_length: float) -> None:
        """SUMO's step must hold a whole number of ours."""
        dt = self._driver.sim.dt
        self._substeps = round(step_length / dt)
        if self._substeps < 1 or abs(self._substeps * dt - step_length) > 1e-6:
            raise PhaseError(
                f"option step-length {step_length:g} s: PHASE moves in steps of {dt:g} s; "
                f"pass -- --step-length {max(self._substeps, 1) * dt:g}"
            )

    def check_calibrators(self) -> None:
        """SUMO crashes when a calibrator takes out a vehicle that was told to move."""
        calibrator = self._api.calibrator
        for name in calibrator.getIDList():
            if calibrator.getEdgeID(name) in self._road.edges:
                raise PhaseError(
                    f"calibrator {name} on edge {calibrator.getEdgeID(name)}: SUMO crashes when it takes out "
                    "a vehicle that PHASE moves; leave it out of the additional files, or pass --share 0"
                )

    def follow_sumo(self, time: float) -> None:
        """After SUMO's step: take over, give back, watch the road edge."""
        for vehicle in set(self._members) - set(self._scene.facts):
            self._drop(vehicle)
        self._locate()
        self._adopt()
        for vehicle in list(self._members):
            self._check(vehicle, time)
        self._watch_road_edge(time)

    def publish_motion(self) -> None:
        """Between SUMO's moves and its outputs: the model's speeds and accelerations.

        SUMO derives both from the way along its lanes, which is not ours in curves and lane changes, and
        holds the speed to its limits.
        """
        api, speed, accel = self._api.vehicle, self._table["speed"], self._table["accel"]
        for vehicle in self._members:
            row = self._table.row_of[vehicle]
            with contextlib.suppress(self._api.TraCIException):  # SUMO took it out in this step
                api.setPreviousSpeed(vehicle, float(speed[row]), float(accel[row]))

    def drive(self, time: float) -> None:
        """Move the vehicles and tell SUMO where they will be after its next step."""
        routes = {vehicle: member.route for vehicle, member in self._members.items()}
        x, y = self._table["x"].copy(), self._table["y"].copy()
        nodes = self._controller.drive(time, self._substeps, self._node, routes)
        moved = np.hypot(self._table["x"] - x, self._table["y"] - y)
        front_x, front_y = self._table.front
        angle = angle_from_yaw(self._table["yaw"])
        seconds = self._substeps * self._driver.sim.dt
        for vehicle in list(self._members):
            row = self._table.row_of[vehicle]
            member = self._members[vehicle]
            if self._arrives(member, int(self._node[row]), front_x[row], front_y[row]):
                self._finish(vehicle, member)
                continue
            trip = self._scene.trips[vehicle]
            trip.policy_seconds += seconds
            trip.policy_metres += float(moved[row])
            if self._publish_hitch and self._table["trailer_length"][row] > 0:
                self._api.vehicle.setParameter(vehicle, "phase.hitch", f"{self._table['hitch'][row]:.6f}")
            front = (float(front_x[row]), float(front_y[row]))
            self._writer.write(vehicle, member, int(nodes[row]), front, float(angle[row]), time)
        self._node = nodes

    def _locate(self) -> None:
        """Nodes of all rows; empty rows and rows that changed hands start anew."""
        size = len(self._table)
        if len(self._node) < size:
            self._node = np.r_[self._node, np.full(size - len(self._node), -1, np.int64)]
        self._node[~self._table.active] = -1
        rows = np.flatnonzero(self._table.active)
        if len(rows):
            self._node = self._controller.track(self._node, rows)

    def _adopt(self) -> None:
        for vehicle, lane in list(self._scene.lane_of.items()):
            if vehicle in self._left_to_sumo or vehicle in self._members or lane.startswith(":"):
                continue
            facts = self._scene.facts[vehicle]
            if facts.kind is None or not self._wanted(vehicle, facts.type):
                self._left_to_sumo.add(vehicle)
                continue
            row = self._table.row_of[vehicle]
            if self._node[row] < 0:
                continue
            route = tuple(self._api.vehicle.getRoute(vehicle))
            at = self._api.vehicle.getRouteIndex(vehicle)
            edges = kept_stretch(self._road, route, at)
            if not edges:
                continue
            lanes = self._lanes(edges, bool(facts.shape.truck))
            leads_off = at + len(edges) < len(route)
            if leads_off and remaining(self._road, lanes, int(self._node[row])) < ADOPT_ROOM:
                continue
            self._take(vehicle, row, Member(lanes, edges, leads_off, 1.0, MAX_TARGET_SPEED))

    def _wanted(self, vehicle: str, kind: str) -> bool:
        if self._api.vehicletype.getParameter(kind, "has.phase.device").lower() in ("false", "0", "no"):
            return False
        return self._choice.chosen(vehicle, kind)

    def _take(self, vehicle: str, row: int, member: Member) -> None:
        api, table = self._api.vehicle, self._table
        member.speed_factor = member.set_factor = float(api.getSpeedFactor(vehicle))
        member.max_speed = float(api.getMaxSpeed(vehicle))
        member.target_speed = self._parameter(vehicle, "phase.target_speed")
        api.setSpeedMode(vehicle, SPEED_MODE)
        api.setLaneChangeMode(vehicle, LANE_MODE)
        table.controlled[row] = True
        table["alpha"][row] = self._parameter(vehicle, "phase.alpha") or self._choice.alpha_of(vehicle)
        low, high = self._accel_bounds(row)
        table["accel"][row] = np.clip(table["accel"][row], low, high)
        table["accel_history"][row] = table["accel"][row]
        self._members[vehicle] = member
        self._scene.lane_of.pop(vehicle, None)
        self._scene.trips[vehicle].adopted = True
        self._set_target_speed(member, row, int(self._node[row]))
        fresh = vehicle in self._scene.session.departed
        self._scene.events.record("adoption", vehicle, "departed" if fresh else "reached the observed road")

    def _accel_bounds(self, row: int) -> tuple[float, float]:
        sim = self._driver.sim
        return sim.truck_accel_bounds if self._table["truck"][row] else sim.accel_bounds

    def _parameter(self, vehicle: str, key: str) -> float | None:
        """A number that the vehicle or its vType carries as a generic parameter."""
        text = self._api.vehicle.getParameter(vehicle, key)
        text = text or self._api.vehicletype.getParameter(self._scene.types[vehicle], key)
        if not text:
            return None
        try:
            return float(text)
        except ValueError:
            raise PhaseError(
                f"vehicle {vehicle}: parameter {key}={text!r} is no number; correct it"
            ) from None

    def _check(self, vehicle: str, time: float) -> None:
        """Keep the target speed current; give back, reroute or take out where needed."""
        member, row = self._members[vehicle], self._table.row_of[vehicle]
        node = int(self._node[row])
        if not self._api.vehicle.getLaneID(vehicle):
            member.off_lane_until = time + KEEP_ON_LANE
        if node < 0:
            member.lost_since = time if member.lost_since is None else member.lost_since
            if time - member.lost_since >= OFF_ROAD_SECONDS:
                self._remove(vehicle, "off road")
            return
        member.lost_since = None
        lane = int(self._road.graph.node_lane[node])
        if not np.isfinite(member.route.changes[lane]):
            self._lost_route(vehicle, member)
            return
        self._set_target_speed(member, row, node)
        room = remaining(self._road, member.route, node)
        if member.leads_off and room < HAND_BACK_ROOM and not self._road.network.lanes[lane].connector:
            self._hand_back(vehicle, member)
        elif not member.edges and room < 2.0 + self._table["speed"][row] * self._scene.session.step_length:
            self._remove(vehicle, "wrong exit")

    def _lost_route(self, vehicle: str, member: Member) -> None:
        """Off its route: let SUMO look for another way, else follow the lane."""
        goal = member.edges[-1] if member.edges else ""
        if not member.wrong:
            member.wrong = True
            self._scene.events.record("wrong exit", vehicle, f"off the way to {goal}" if goal else "")
        lane = self._api.vehicle.getLaneID(vehicle)
        if lane.startswith(":"):
            return
        route: tuple[str, ...] = ()
        with contextlib.suppress(self._api.TraCIException):
            self._api.vehicle.changeTarget(vehicle, goal)
            route = tuple(self._api.vehicle.getRoute(vehicle))
            route = route[self._api.vehicle.getRouteIndex(vehicle) :]
        edges = kept_stretch(self._road, route, 0)
        truck = bool(self._table["truck"][self._table.row_of[vehicle]])
        lanes = self._lanes(edges, truck) if edges and edges[-1] == goal else None
        node = int(self._node[self._table.row_of[vehicle]])
        if lanes is not None and np.isfinite(lanes.changes[self._road.graph.node_lane[node]]):
            member.route, member.edges, member.wrong = lanes, edges, False
            self._scene.events.record("reroute", vehicle, f"another way to {goal}")
        else:
            member.route, member.edges, member.leads_off = self._follow, (), False

    def _lanes(self, edges: tuple[str, ...], truck: bool) -> RouteLanes:
        key = (edges, truck)
        if key not in self._routes:
            self._routes[key] = route_lanes(self._road, edges, truck)
        return self._routes[key]

    def _set_target_speed(self, member: Member, row: int, node: int) -> None:
        limit = self._road.network.lanes[int(self._road.graph.node_lane[node])].speed_limit
        speed = member.target_speed or min(limit * member.speed_factor, member.max_speed)
        self._table["goal_speed"][row] = min(max(speed, MIN_TARGET_SPEED), MAX_TARGET_SPEED)

    def _arrives(self, member: Member, node: int, front_x: float, front_y: float) -> bool:
        """The new pose is past the end of the last lane of the route."""
        if member.leads_off or node < 0:
            return False
        lane = int(self._road.graph.node_lane[node])
        if not member.edges or self._road.network.lanes[lane].edge != member.edges[-1]:
            return False
        end = int(self._road.first[lane] + self._road.count[lane] - 1)
        yaw = float(self._road.graph.node_yaw[end])
        dx, dy = front_x - self._road.graph.node_xy[end, 0], front_y - self._road.graph.node_xy[end, 1]
        return bool(dx * np.cos(yaw) + dy * np.sin(yaw) > -0.3)

    def _finish(self, vehicle: str, member: Member) -> None:
        """SUMO takes the last step of the trip, so that the vehicle arrives in its records."""
        self._scene.trips[vehicle].finished = True
        self._release(vehicle, member)

    def _hand_back(self, vehicle: str, member: Member) -> None:
        api = self._api.vehicle
        self._scene.events.record("hand-back", vehicle, "the observed road ends")
        lane = api.getLaneID(vehicle)
        if lane and not lane.startswith(":"):
            api.moveTo(vehicle, lane, api.getLanePosition(vehicle))
        self._release(vehicle, member)

    def _release(self, vehicle: str, member: Member) -> None:
        api = self._api.vehicle
        api.setSpeedMode(vehicle, SUMO_SPEED_MODE)
        api.setLaneChangeMode(vehicle, SUMO_LANE_MODE)
        api.setSpeed(vehicle, -1.0)
        if member.set_factor != member.speed_factor:
            api.setSpeedFactor(vehicle, member.speed_factor)
        self._drop(vehicle)
        self._table.controlled[self._table.row_of[vehicle]] = False

    def _remove(self, vehicle: str, reason: str) -> None:
        self._scene.take_out(vehicle, reason)
        self._api.vehicle.remove(vehicle, VAPORIZED)
        self._drop(vehicle)

    def _drop(self, vehicle: str) -> None:
        del self._members[vehicle]
        self._left_to_sumo.add(vehicle)
        self._planner.forget(vehicle)

    def _watch_road_edge(self, time: float) -> None:
        rows = np.flatnonzero(self._table.controlled)
        if not len(rows):
            return
        box = boxes(self._table.shape(), self._table.state())[..., torch.from_numpy(rows)]
        touching, _ = road_contacts(box, self._road.map, torch.zeros(1, dtype=torch.long), len(rows))
        for row in rows[touching[0].numpy()].tolist():
            member = self._members[self._table.ids[row]]
            if member.edge_event is None or time - member.edge_contact > EDGE_CONTACT_APART:
                off = "off the road" if self._node[row] < 0 else "contact"
                member.edge_event = self._scene.events.record("road edge", self._table.ids[row], off)
                member.edge_begin = time
            member.edge_contact = time
            member.edge_event.seconds = round(time - member.edge_begin, 3)
