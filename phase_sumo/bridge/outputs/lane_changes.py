"""Lane changes of the vehicles under the policy; SUMO records none for a vehicle that is moved."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.event_log import EventLog
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.outputs.lane_ways import LaneWays, index_of
from phase_sumo.bridge.sumo.session import Simulation

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
