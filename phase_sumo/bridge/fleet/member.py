"""What is remembered of a vehicle while the policy drives it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.bridge.fleet.event_log import Event
from phase_sumo.bridge.fleet.route import RouteLanes


@dataclass
class Member:
    """A vehicle under the policy.

    Attributes:
        route: lanes of the stretch of its route on the observed road.
        edges: that stretch; empty when the route was lost.
        leads_off: the route goes on to roads that SUMO drives.
        speed_factor: of the vehicle, on speed limits.
        max_speed: of the vType, m/s.
        min_gap: of the vType, m.
        target_speed: set by the parameter ``phase.target_speed``, m/s; 0 follows the speed limit.
        time_gap: s to the leader, see `target_speed`; 0 takes no heed of leaders.
        lost_since: time since when the front bumper is on no lane, or None.
        off_lane_until: time until which SUMO is told a position on a lane, see `PoseWriter`.
        edge_event, edge_begin, edge_contact: its last contact with the road edge, first and last time of it.
        wrong: already counted as being off its route.
    """

    route: RouteLanes
    edges: tuple[str, ...]
    leads_off: bool
    speed_factor: float
    max_speed: float
    min_gap: float
    target_speed: float = 0.0
    time_gap: float = 0.0
    lost_since: float | None = None
    off_lane_until: float = -np.inf
    edge_event: Event | None = None
    edge_begin: float = -np.inf
    edge_contact: float = -np.inf
    wrong: bool = False
