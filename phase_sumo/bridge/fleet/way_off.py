"""Where routes leave the observed road: which lanes lead on, how fast, and how far PHASE may drive.

SUMO takes over early where it may have to brake or to change lanes, else just before the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.sumo.session import bare

LAST_TIME, LAST_ROOM = 0.7, 5.0  # s of driving, at least m, to the end: SUMO must see its next junction
BRAKING = 2.5  # m/s^2 that SUMO may need
REACTION, FREE = 0.7, 4.0  # s and m more to those ahead


class WayOff:
    """Looks from the last lanes of the observed road onto the roads behind."""

    def __init__(self, api: Any, road: Road) -> None:
        self._api, self._road = api, road
        self._limit = bare(api, "lane", "getMaxSpeed")
        self._known: dict[tuple[str, str], dict[int, float]] = {}

    def lanes(self, last: str, following: str) -> Mapping[int, float]:
        """Lanes of the edge ``last`` that lead on to the edge ``following``, with the m/s allowed there.

        Empty where PHASE would drive there, too, if it were allowed to.
        """
        key = (last, following)
        if key not in self._known:
            self._known[key] = found = {}
            for i in self._road.lanes_of[last] if following not in self._road.edges else ():
                for target, _, _, _, inside, *_ in self._api.lane.getLinks(self._road.network.lanes[i].id):
                    if target.rpartition("_")[0] == following:
                        found[i] = min(map(self._limit, filter(None, (inside, target))))
        return self._known[key]

    def is_free(self, vehicle: str, route: RouteLanes, node: int, room: float, speed: float) -> bool:
        """Whether a vehicle may drive on to the end ``room`` m ahead: its lane leads on and is free."""
        lane = int(self._road.graph.node_lane[node])
        while route.onward[lane] >= 0:
            lane = int(route.onward[lane])
        if lane not in route.leave or room < max(LAST_TIME * speed, LAST_ROOM):
            return False
        braking = speed * speed / (2.0 * BRAKING)
        if braking - route.leave[lane] ** 2 / (2.0 * BRAKING) > room:
            return False
        needed = braking + REACTION * speed + FREE
        leader, gap = self._api.vehicle.getLeader(vehicle, needed) or ("", np.inf)
        if not leader:
            return True
        theirs = float(self._api.vehicle.getSpeed(leader))
        return needed - theirs * theirs / (2.0 * BRAKING) < gap
