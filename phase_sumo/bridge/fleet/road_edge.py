"""Contacts of PHASE vehicles with the road edge from exact boxes: one event per contact."""

from __future__ import annotations

import numpy as np
import torch

from phase_sumo.bridge.fleet.event_log import EventLog
from phase_sumo.bridge.fleet.member import Member
from phase_sumo.bridge.fleet.road import IntArray, Road
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.events import road_contacts
from phase_sumo.sim.vehicles import boxes

APART = 1.0  # s without touching the road edge that end one contact


class RoadEdgeMonitor:
    """Finds vehicles under the policy that touch the road edge and joins that into contacts."""

    def __init__(self, road: Road, table: VehicleTable, log: EventLog) -> None:
        self._road, self._table, self._log = road, table, log

    def update(self, time: float, node: IntArray, members: dict[str, Member]) -> None:
        """Log contacts that begin, and how long those that go on have lasted.

        Args:
            node: [N] node of each row's front bumper, -1 off the road.
        """
        rows = np.flatnonzero(self._table.controlled)
        if not len(rows):
            return
        towing = self._table["trailer_length"][rows] > 0
        rows = np.r_[rows[towing], rows[~towing]]  # those with a second box to test come first

        def own(values: torch.Tensor) -> torch.Tensor:
            return values[:, torch.from_numpy(rows)]

        box = boxes(self._table.shape().map(own), self._table.state().map(own))
        touching, _ = road_contacts(box, self._road.map, torch.zeros(1, dtype=torch.long), int(towing.sum()))
        for row in rows[touching[0].numpy()].tolist():
            member = members[self._table.ids[row]]
            if member.edge_event is None or time - member.edge_contact > APART:
                off = "off the road" if node[row] < 0 else "contact"
                member.edge_event = self._log.record("road edge", self._table.ids[row], off)
                member.edge_begin = time
            member.edge_contact = time
            member.edge_event.seconds = round(time - member.edge_begin, 3)
