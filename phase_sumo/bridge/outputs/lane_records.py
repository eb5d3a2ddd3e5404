"""Lane changes and driven lengths of vehicles under the policy, along SUMO's lanes.

SUMO records no lane change for a vehicle that is moved. It adds up the lanes that a vehicle leaves. A moved
vehicle also leaves lanes sideways, and those that SUMO drove it onto before it was put elsewhere in the same
step, and each counts in full.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.event_log import EventLog
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.sumo.session import Simulation, bare

HOPS = 6  # lanes, internal ones counted, that a vehicle may pass within one step of SUMO


class LaneWays:
    """Asks SUMO about lanes when they are first met; what is known outlives the simulation.

    Attributes:
        length: m, of the lanes that were asked about.
    """

    def __init__(self, api: Any) -> None:
        self.length: dict[str, float] = {}
        self._lane = api.lane
        self._known: dict[str, dict[str, dict[str, float]]] = {}

    def ahead(self, lane: str) -> dict[str, dict[str, float]]:
        """Edge -> lanes of it that ``lane`` leads to -> m from its start to theirs; its own edge included."""
        if lane not in self._known:
            found, front = {edge_of(lane): {lane: 0.0}}, {lane: 0.0}
            for _ in range(HOPS - 1):
                reached: dict[str, float] = {}
                for other, metres in front.items():
                    for link in self._lane.getLinks(other):
                        if edge_of(link[4] or link[0]) not in found:
                            reached.setdefault(link[4] or link[0], metres + self._lane.getLength(other))
                for other, metres in reached.items():
                    found.setdefault(edge_of(other), {})[other] = metres
                front = reached
            self._known[lane], self.length[lane] = found, float(self._lane.getLength(lane))
        return self._known[lane]

    def towards(self, last: str, lane: str) -> tuple[str, float] | None:
        """The lane that ``last`` leads to nearest beside ``lane``, maybe itself, and m between the starts."""
        reached = self.ahead(last).get(edge_of(lane))
        if reached is None:
            return None
        source = min(reached, key=lambda other: (abs(index_of(other) - index_of(lane)), other))
        return source, reached[source]


def edge_of(lane: str) -> str:
    return lane.rpartition("_")[0]


def index_of(lane: str) -> int:
    return int(lane.rpartition("_")[2])


NEAR = 1000.0  # m within which a leader or follower is named


@dataclass(frozen=True)
class LaneChange:
    """One lane change, with what SUMO's lanechange-output says of it.

    Attributes:
        time: s, the time stamp of SUMO's outputs.
        vehicle, type: ids.
        source, target: lanes of one edge.
        direction: lanes to the left.
        speed, position: m/s and m on the target lane.
        gaps: of leader, follower and origLeader where there is one: net gap and safe gap in m, speed in m/s.
    """

    time: float
    vehicle: str
    type: str
    source: str
    target: str
    direction: int
    speed: float
    position: float
    gaps: dict[str, tuple[float, float, float]] = field(default_factory=dict)


class LaneChanges:
    """Watches SUMO's lane of every vehicle under the policy."""

    def __init__(
        self,
        session: Simulation,
        table: VehicleTable,
        types: dict[str, str],
        events: EventLog,
        ways: LaneWays,
    ) -> None:
        self._api, self._table, self._types, self._events = session.api, table, types, events
        self._ways = ways
        self._lane: dict[str, str] = {}
        self.changes: list[LaneChange] = []

    def update(self) -> None:
        """After a step: what changed since the last one."""
        before, self._lane = self._lane, {}
        for row in np.flatnonzero(self._table.controlled).tolist():
            vehicle = self._table.ids[row]
            last = before.get(vehicle, "")
            lane = self._api.vehicle.getLaneID(vehicle) or last
            self._lane[vehicle] = lane
            if last and lane != last:
                found = self._ways.towards(last, lane)
                if found and found[0] != lane:
                    self.changes.append(self._change(vehicle, row, found[0], lane))

    def _change(self, vehicle: str, row: int, source: str, lane: str) -> LaneChange:
        api = self._api
        return LaneChange(
            time=self._events.now,
            vehicle=vehicle,
            type=self._types[vehicle],
            source=source,
            target=lane,
            direction=index_of(lane) - index_of(source),
            speed=float(self._table["speed"][row]),
            position=float(api.vehicle.getLanePosition(vehicle)),
            gaps=self._gaps(vehicle, left=index_of(lane) > index_of(source)),
        )

    def _gaps(self, vehicle: str, left: bool) -> dict[str, tuple[float, float, float]]:
        api = self._api.vehicle
        behind = api.getRightLeaders(vehicle) if left else api.getLeftLeaders(vehicle)
        found = {
            "leader": api.getLeader(vehicle, NEAR),
            "follower": api.getFollower(vehicle, NEAR),
            "origLeader": min(behind, key=lambda other: other[1], default=None),
        }
        gaps = {}
        for name, other in found.items():
            if other and other[0]:
                pair = (other[0], vehicle) if name == "follower" else (vehicle, other[0])
                gaps[name] = (*self._gap(float(other[1]), *pair), float(api.getSpeed(other[0])))
        return gaps

    def _gap(self, beyond: float, follower: str, leader: str) -> tuple[float, float]:
        """Net and safe gap of a pair; SUMO gives the gap ``beyond`` the follower's minGap."""
        api: Any = self._api.vehicle
        safe = api.getSecureGap(
            follower, api.getSpeed(follower), api.getSpeed(leader), api.getDecel(leader), leader
        )
        return beyond + float(api.getMinGap(follower)), float(safe)


@dataclass
class _Way:
    """Where a vehicle was seen last: m driven, lane, m on it, and m under the policy until then."""

    metres: float
    lane: str
    position: float
    policy_metres: float


class RouteLengths:
    """Sums the progress along lanes step by step, from SUMO's own distance at the first take-over on."""

    def __init__(self, scene: Scene, ways: LaneWays) -> None:
        self._scene, self._lanes = scene, ways
        self._ways: dict[str, _Way] = {}
        self._present: set[str] = set()
        self._lane_of, self._position_of = (
            bare(scene.api, "vehicle", f"get{name}") for name in ("LaneID", "LanePosition")
        )

    def update(self) -> None:
        """After a step."""
        table = self._scene.table
        self._present |= {table.ids[row] for row in np.flatnonzero(table.controlled).tolist()}
        self._present &= self._scene.facts.keys()
        for vehicle in self._present:
            lane = self._lane_of(vehicle)
            if not lane:
                continue  # on no lane: the next one tells
            position, under_policy = self._position_of(vehicle), self._scene.trips[vehicle].policy_metres
            way = self._ways.get(vehicle)
            if way is None:
                metres = float(self._scene.api.vehicle.getDistance(vehicle))
            else:
                further = self._between(way, lane, position)
                metres = way.metres + (under_policy - way.policy_metres if further is None else further)
            self._ways[vehicle] = _Way(metres, lane, position, under_policy)
            self._lanes.ahead(lane)  # for the rest of its way, should this be SUMO's last step

    def until(self, vehicle: str, lane: str, position: float) -> float | None:
        """Metres from the departure to a place soon after the vehicle was seen last, None if not known."""
        way = self._ways.get(vehicle)
        if way is None:
            return None
        return way.metres + (self._between(way, lane, position) or 0.0 if lane else 0.0)

    def driven_to(self, vehicle: str, lane: str, position: float) -> float:
        """Position at which a trip to ``position`` ended: the policy drives past it, up to the lane's end."""
        way = self._ways.get(vehicle)
        if way is None or edge_of(way.lane) != edge_of(lane) or position >= way.position - 0.1:
            return position
        last = self._scene.trips[vehicle].policy_metres - way.policy_metres  # 0 if it drove to the end
        return (
            min(way.position + last, self._lanes.length[way.lane]) if last else self._lanes.length[way.lane]
        )

    def _between(self, way: _Way, lane: str, position: float) -> float | None:
        found = self._lanes.towards(way.lane, lane)
        return None if found is None else found[1] + position - way.position
