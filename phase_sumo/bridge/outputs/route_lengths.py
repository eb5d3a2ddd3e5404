"""How far vehicles came along SUMO's lanes that the policy drove at some time.

SUMO adds up the lanes that a vehicle leaves. A moved vehicle also leaves lanes sideways, and those that SUMO
drove it onto before it was put elsewhere in the same step, and each counts in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.outputs.lane_ways import LaneWays, edge_of
from phase_sumo.bridge.sumo.session import bare


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
        """Position at which a trip to ``position`` ended: the policy drives past it, to the lane's end."""
        way = self._ways.get(vehicle)
        passed = way is not None and edge_of(way.lane) == edge_of(lane) and position < way.position - 0.1
        return self._lanes.length[way.lane] if way is not None and passed else position

    def _between(self, way: _Way, lane: str, position: float) -> float | None:
        found = self._lanes.towards(way.lane, lane)
        return None if found is None else found[1] + position - way.position
