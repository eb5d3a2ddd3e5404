"""The vehicles that PHASE drives: taken over from SUMO, moved, and given back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.fleet.adoption import Adoption
from phase_sumo.bridge.fleet.contacts import RoadEdgeMonitor
from phase_sumo.bridge.fleet.controller import Controller, Steps
from phase_sumo.bridge.fleet.drivers import Drivers, Member
from phase_sumo.bridge.fleet.event_log import Event
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.guarded import Guarding
from phase_sumo.bridge.fleet.hand_back import HandBack
from phase_sumo.bridge.fleet.lane_rules import LaneRules
from phase_sumo.bridge.fleet.occupancy import STANDING, Occupancy, standing_rooms
from phase_sumo.bridge.fleet.parameters import TARGET_SPEEDS, Choice
from phase_sumo.bridge.fleet.plans import Plans, stops_soon
from phase_sumo.bridge.fleet.pose import PoseWriter
from phase_sumo.bridge.fleet.restrictions import restrictions
from phase_sumo.bridge.fleet.right_of_way import RightOfWay
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import past_end, remaining
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.fleet.target_speeds import TargetSpeeds
from phase_sumo.bridge.sumo.session import bare

HAND_BACK_TIME, HAND_BACK_ROOM = 3.5, 30.0  # s, at least m, before the observed road's end: SUMO takes over
KEEP_ON_LANE = 2.0  # s for which a vehicle that SUMO lost is told to be nearer to a lane
OFF_ROAD_SECONDS = 4.0  # s without a lane after which a vehicle is taken out
EDGE_SECONDS = 0.5  # s since the last contact with the road edge
EXTRA_SPEED = 2.0  # m/s^2 by which a vehicle may be faster after a step of SUMO
VAPORIZED = 3


class Fleet:
    """Owns the poses of its vehicles; SUMO is told about them after every step. ``guarding`` watches them."""

    def __init__(
        self,
        scene: Scene,
        road: Road,
        drivers: Drivers,
        choice: Choice,
        publish_hitch: bool = False,
    ) -> None:
        """``publish_hitch`` keeps the hitch angle in rad in each trailer's parameter ``phase.hitch``.

        Raises:
            PhaseError: SUMO's step and the policy's do not fit into each other.
        """
        self._steps = Steps.fit(scene.session.step_length, drivers.dt)
        self._scene, self._table, self._api = scene, scene.table, scene.api
        self._road = road
        # SUMO crashes when a calibrator takes out a vehicle that was told to move: SUMO drives there
        calibrator = self._api.calibrator
        self._road.edges -= {calibrator.getEdgeID(name) for name in calibrator.getIDList()}
        self._planner = GoalPlanner(self._road, scene.table)
        self._rules = LaneRules(self._api, self._road, restrictions(self._api))
        self._ways = RightOfWay(self._api, self._road)
        self._speeds = TargetSpeeds(self._road, scene.table, self._ways.yields)
        self.guarding = Guarding(scene.table, scene.trips)
        self._controller = Controller(
            self._road, scene.table, drivers, self._steps, self._speeds, self._planner, self.guarding
        )
        self._members: dict[str, Member] = {}
        self._released: set[str] = set()
        self._node = np.full(len(scene.table), -1, np.int64)
        self._plans = Plans(scene, self._road, self._rules)
        self._hand_backs = HandBack(scene.session)
        self._adoption = Adoption(scene, self._road, choice, drivers, self._plans, self._ways)
        self._edge = RoadEdgeMonitor(self._road, scene.table, scene.events)
        self._writer = PoseWriter(self._api, self._road, scene.table, publish_hitch)
        self._lane_id = bare(self._api, "vehicle", "getLaneID")

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

    def take(self, vehicle: str) -> None:
        """Drive it from the next step on, or once its road is observed."""
        self._released.discard(vehicle)
        self._adoption.left_to_sumo.discard(vehicle)

    def release(self, vehicle: str) -> None:
        """Give it back to SUMO with the next step."""
        self._released.add(vehicle)
        self._adoption.left_to_sumo.add(vehicle)

    def read_context(self, vehicle: str) -> None:
        """Drive by what the vehicle's ``phase.*`` parameters say now."""
        member = self._members.get(vehicle)
        if member:
            self._adoption.read_context(vehicle, self._table.row_of[vehicle], member)

    def follow_sumo(self, time: float) -> None:
        """After SUMO's step: take over, give back, set target speeds, watch the road edge."""
        for vehicle in set(self._members) - set(self._scene.facts):
            trip = self._scene.trips[vehicle]
            trip.finished = math.isfinite(trip.arrive)
            self._drop(vehicle)
        for vehicle in [v for v in self._scene.teleported if v in self._members]:
            self._node[self._table.row_of[vehicle]] = -1
            self._hand_back(vehicle, "SUMO teleports it")
            self._scene.leave(vehicle)
        self._adoption.forget_absent()
        self._ways.update()
        self._locate()
        self._follow_rules(time)
        fresh = self._adopt()
        for vehicle in [v for v in self._members if v in self._released]:
            self._hand_back(vehicle, "released", again=False)
        self._released.clear()
        if self._plans.due(time):
            self._follow_plans()
        self._check(time)
        if fresh or self._steps.decides(time):  # nobody is ours without a target speed
            occupancy = Occupancy(self._road, self._table, self._node)
            self._speeds.update(self._node, self._planner.beside(self._node), occupancy, self._members)
        self._edge.update(time, self._node, self._members)

    def clear(self, wrecks: list[Event]) -> None:
        """Take out one vehicle of each wreck, that at fault if it is ours: the policy stays where it is."""
        for wreck in wrecks:
            pair = (wreck.vehicle, wreck.other)
            ours = [vehicle for vehicle in pair if vehicle in self._members]
            if ours and all(vehicle in self._scene.facts for vehicle in pair):
                self._remove(ours[0], "crashed")

    def drive(self, time: float) -> None:
        """Move the vehicles and tell SUMO where they will be after its next step."""
        before, table = self._node, self._table
        x, y = table["x"].copy(), table["y"].copy()
        self._node = self._controller.drive(time, before, self._members)
        metres = np.hypot(table["x"] - x, table["y"] - y)
        front_x, front_y = table.front
        rows = self._rows()
        front = np.stack((front_x[rows], front_y[rows]), -1)
        past = past_end(self._road, list(self._members.values()), before[rows], front)
        for vehicle in [vehicle for vehicle, ends in zip(self._members, past, strict=True) if ends]:
            self._finish(vehicle)
        rows = self._rows()
        self._count(metres[rows])
        front = np.stack((front_x[rows], front_y[rows]), -1)
        self._writer.write(self._members, rows, self._node[rows], front, time)
        self._hand_backs.settle()

    def _rows(self) -> IntArray:
        """Table rows of the members, in their order."""
        row_of = self._table.row_of
        return np.fromiter((row_of[vehicle] for vehicle in self._members), np.int64, len(self._members))

    def _count(self, metres: FloatArray) -> None:
        """Add the step, of ``metres`` [n] for each member, to the trips."""
        trips, seconds = self._scene.trips, self._scene.session.step_length
        for vehicle, driven in zip(self._members, metres.tolist(), strict=True):
            trip = trips[vehicle]
            trip.policy_seconds += seconds
            trip.policy_metres += driven

    def _locate(self) -> None:
        """Nodes of all rows; empty rows and rows that changed hands start anew."""
        size = len(self._table)
        if len(self._node) < size:
            self._node = np.r_[self._node, np.full(size - len(self._node), -1, np.int64)]
        self._node[~self._table.active] = -1
        # PHASE vehicles are where they were found after their move
        rows = np.flatnonzero(self._table.active & ~(self._table.controlled & (self._node >= 0)))
        if len(rows):
            self._node = self._controller.track(self._node, rows, self._pieces(rows))

    def _pieces(self, rows: IntArray) -> IntArray:
        """Where SUMO says that vehicles are which are not found yet, -1 for any place."""
        result = np.full(len(rows), -1)
        for k in np.flatnonzero((self._node[rows] < 0) & ~self._table.controlled[rows]).tolist():
            vehicle = self._table.ids[rows[k]]
            position = float(self._api.vehicle.getLanePosition(vehicle))
            result[k] = self._road.levels.of_lane(self._scene.lane_of.get(vehicle, ""), position)
        return result

    def piece(self, vehicle: str) -> int:
        """The piece of road, see `Levels`, that one of our vehicles is on; -1 for others."""
        node = int(self._node[self._table.row_of[vehicle]]) if vehicle in self._members else -1
        return int(self._road.piece[node]) if node >= 0 else -1

    def _adopt(self) -> bool:
        """Whether there are new members."""
        before = len(self._members)
        for vehicle, member in self._adoption.take_over(self._node, self._members):
            self._members[vehicle] = member
            self._hand_backs.forget(vehicle)
        return len(self._members) > before

    def _follow_plans(self) -> None:
        """Heed new routes and stops, and that SUMO's lists of leaders are in order."""
        lanes: list[str] = []
        for vehicle, member in list(self._members.items()):
            lanes.append(self._lane_id(vehicle))
            self._plans.restore(vehicle, member)
            if self._plans.changed(vehicle, member):
                self._scene.events.record("reroute", vehicle, f"a new route to {member.trip[-1]}")
                if not self._plans.take(vehicle, member):
                    self._hand_back(vehicle, "the new route leaves the observed road")
                    continue
            speed = float(self._table["speed"][self._table.row_of[vehicle]])
            if stops_soon(self._plans.stop_room(vehicle, member.edges), speed):
                self._hand_back(vehicle, "a stop ahead")
        self._hand_backs.order({lane for lane in lanes if lane})

    def _check(self, time: float) -> None:
        """Give back, reroute or take out where needed."""
        members, rows = list(self._members.items()), self._rows()
        on_route = self._on_route([member for _, member in members], rows)
        node = self._node[rows]
        rooms = np.full((2, len(rows)), np.inf)  # in the own lane and those beside
        k = np.flatnonzero(on_route)
        if len(k) and (self._table.active & (self._table["speed"] <= STANDING)).any():
            routes = [members[i][1].route for i in k.tolist()]
            occupancy = Occupancy(self._road, self._table, self._node)
            rooms[:, k] = standing_rooms(self._road, occupancy, node[k], rows[k], routes)
        lane_id, wide = self._lane_id, self._road.beyond_lane(node, *(at[rows] for at in self._table.front))
        for (vehicle, member), on, at, out, (own, beside) in zip(
            members, on_route.tolist(), node.tolist(), wide.tolist(), rooms.T.tolist(), strict=True
        ):
            if not lane_id(vehicle):
                member.off_lane_until = time + KEEP_ON_LANE
            elif on and out and time - member.edge_contact < EDGE_SECONDS:
                self._hand_back(vehicle, "it runs off the road")
                continue
            if on:
                member.lost_since = None
                self._check_way(vehicle, member, at, own)
                ends = member.leads_off or not member.edges or min(own, beside) < np.inf
                if ends and vehicle in self._members:
                    self._check_end(vehicle, member, at, own, beside)
            elif at < 0:
                member.lost_since = time if member.lost_since is None else member.lost_since
                if time - member.lost_since >= OFF_ROAD_SECONDS:
                    self._remove(vehicle, "off road")
            else:
                member.lost_since = None
                self._plans.find_way(vehicle, member, at)

    def _on_route(self, members: list[Member], rows: IntArray) -> BoolArray:
        """Whether each vehicle is on a lane of its route, or also on one, which then becomes its own."""
        node = self._node[rows]
        lane = np.where(node >= 0, self._road.graph.node_lane[node], -1)
        changes = np.array([m.route.changes[k] for m, k in zip(members, lane, strict=True)])
        on_route = (node >= 0) & np.isfinite(changes)
        x, y = self._table.front
        for k in np.flatnonzero((node >= 0) & ~on_route).tolist():
            lanes, at = np.isfinite(members[k].route.changes), (float(x[rows[k]]), float(y[rows[k]]))
            beside = self._road.overlapping(int(node[k]), *at, lanes)
            if beside >= 0:
                self._node[rows[k]], on_route[k] = beside, True
        return on_route

    def _check_end(self, vehicle: str, member: Member, node: int, own: float, beside: float) -> None:
        """Give back or take out who comes to the road's end, or to one who stands in some m in a lane."""
        room = remaining(self._road, member.route, node)
        connector = self._road.network.lanes[int(self._road.graph.node_lane[node])].connector
        speed = float(self._table["speed"][self._table.row_of[vehicle]])
        needed = max(HAND_BACK_TIME * speed, HAND_BACK_ROOM)
        ends = member.leads_off and room < needed and not connector
        if ends and not self._plans.way_off.is_free(vehicle, member.route, node, room, speed):
            self._hand_back(vehicle, "the observed road ends")
        elif min(own, beside) < needed and not connector:
            where = "ahead" if own < needed else "beside the way"
            self._hand_back(vehicle, f"somebody stands {where}", passing=own >= needed)
        elif not member.edges and room < 2.0 + speed * self._scene.session.step_length:
            self._remove(vehicle, "wrong exit")

    def _check_way(self, vehicle: str, member: Member, node: int, queue: float) -> None:
        """Leave a vehicle to SUMO where it may have to stop, until it is behind that place."""
        row = self._table.row_of[vehicle]
        speed = float(self._table["speed"][row]) + EXTRA_SPEED * self._scene.session.step_length
        bar = self._ways.bar(vehicle, member.route, member.leads_off, node, speed, member.speed_factor, queue)
        if bar:
            self._hand_back(vehicle, bar.reason, edges=bar.edges)
        elif member.max_speed < TARGET_SPEEDS[0]:
            self._hand_back(vehicle, "slower than the policy drives")

    def _follow_rules(self, time: float) -> None:
        """Heed what the lanes allow now."""
        lane = self._road.graph.node_lane[self._node[self._table.controlled & (self._node >= 0)]]
        here = {self._road.network.lanes[i].edge for i in np.unique(lane).tolist()}
        changed = self._rules.update(time, here)
        for vehicle in self._plans.follow_rules(changed, self._members):
            self._hand_back(vehicle, "the road is closed")

    def _finish(self, vehicle: str) -> None:
        """SUMO takes the last step of the trip, so that the vehicle arrives in its records."""
        self._scene.trips[vehicle].finished = True
        self._release(vehicle)

    def _hand_back(
        self,
        vehicle: str,
        reason: str,
        again: bool = True,
        passing: bool = False,
        edges: frozenset[str] = frozenset(),
    ) -> None:
        """SUMO drives it from the next step on; ``again`` says until when PHASE may drive on.

        On ``edges`` it stays SUMO's in any case; see `HandBack` for ``passing``.
        """
        self._scene.events.record("hand-back", vehicle, reason)
        node = int(self._node[self._table.row_of[vehicle]])
        if node >= 0 and not self._lane_id(vehicle):
            self._hand_backs.place(vehicle, self._road, node)
        self._release(vehicle, passing)
        if again:
            self._adoption.wait(vehicle, edges)

    def _release(self, vehicle: str, passing: bool = False) -> None:
        self._plans.restore(vehicle, self._members[vehicle])
        self._hand_backs.give(vehicle, passing)
        self._drop(vehicle)
        self._table.controlled[self._table.row_of[vehicle]] = False

    def _remove(self, vehicle: str, reason: str) -> None:
        self._scene.take_out(vehicle, reason)
        self._api.vehicle.remove(vehicle, VAPORIZED)
        self._drop(vehicle)

    def _drop(self, vehicle: str) -> None:
        del self._members[vehicle]
        self._adoption.left_to_sumo.add(vehicle)
        self._planner.forget(vehicle)
