"""Contacts from exact boxes, tractor and trailer alike: one event per contact.

Between vehicles, and of PHASE vehicles with the road edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.bridge.fleet.drivers import Member
from phase_sumo.bridge.fleet.event_log import Event, EventLog
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.events import at_fault, road_contacts
from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.near import pairs_within
from phase_sumo.sim.vehicles import boxes

APART = 1.0  # s without overlap, or off the road edge, that end a contact
STANDING = 0.5  # m/s, at most, of vehicles that have come to rest
WRECK_SECONDS = 10.0  # s at rest in each other after which two vehicles are a wreck


@dataclass
class _Contact:
    """A contact that may go on: its event, when it began, the last overlap and the last movement in s."""

    event: Event
    begin: float
    last: float
    moved: float


class ContactMonitor:
    """Finds overlaps of all vehicles in a table and joins them into contacts.

    The network is flat: vehicles on roads that cross without a common junction do not touch.
    """

    def __init__(self, log: EventLog, touching: Callable[[str, str], bool] | None = None) -> None:
        """``touching`` tells of two vehicle ids whether their roads lie on one level there."""
        self._log, self._touching = log, touching
        self._open: dict[tuple[str, str], _Contact] = {}

    def update(self, table: VehicleTable, time: float, types: dict[str, str]) -> list[Event]:
        """Contacts that begin now; they are in the log."""
        new: list[Event] = []
        for i, j, event in _overlaps(table, self._log.now, types):
            pair = (table.ids[i], table.ids[j])
            contact = self._open.get(pair)
            if contact is None:
                if self._touching and not self._touching(*pair):
                    continue
                new.append(self._log.add(event))
                contact = self._open[pair] = _Contact(event, time, time, time)
            contact.last = time
            if max(event.speed, event.other_speed) > STANDING:
                contact.moved = time
            contact.event.seconds = round(time - contact.begin, 3)
        self._open = {k: c for k, c in self._open.items() if time - c.last <= APART}
        return new

    def wrecks(self, time: float) -> list[Event]:
        """Collisions whose vehicles have stood in each other for `WRECK_SECONDS` at the last update."""
        at_rest = WRECK_SECONDS - 1e-6
        return [c.event for c in self._open.values() if c.last == time and time - c.moved >= at_rest]


def _overlaps(table: VehicleTable, time: float, types: dict[str, str]):
    rows = np.flatnonzero(table.active)
    if len(rows) < 2:
        return []
    every = boxes(table.shape(), table.state())[:, :, 0]  # [6, 2, N]
    box = every[:, :, torch.from_numpy(rows)].flatten(1)
    real = np.flatnonzero(box[4].numpy() > 0)
    owner, towed, box = rows[real % len(rows)], real >= len(rows), box[:, torch.from_numpy(real)]
    radius = torch.hypot(box[4], box[5]).numpy()
    centre = box[:2].T.numpy()
    first, second = pairs_within(centre, centre, 2.0 * float(radius.max()))
    near = np.hypot(*(centre[first] - centre[second]).T) <= radius[first] + radius[second]
    near &= owner[first] < owner[second]
    first, second = torch.from_numpy(first[near]), torch.from_numpy(second[near])
    a, b = box[:, first], box[:, second]
    found: dict[tuple[int, int], Event] = {}
    for k in torch.nonzero(boxes_overlap(a, b)).flatten().tolist():
        i, j = int(owner[first[k]]), int(owner[second[k]])
        if (i, j) not in found:
            middle = table.origin + 0.5 * (a[:2, k] + b[:2, k]).double().numpy()
            parts = bool(towed[first[k]]), bool(towed[second[k]])
            found[i, j] = _event(table, (i, j), parts, middle, every[:, 0], time, types)
    return [(i, j, event) for (i, j), event in found.items()]


def _event(
    table: VehicleTable,
    pair: tuple[int, int],
    towed: tuple[bool, bool],
    middle: FloatArray,
    body: torch.Tensor,
    time: float,
    types: dict[str, str],
) -> Event:
    """Rows and the boxes that touch -> event; the vehicle at fault comes first."""
    i, j = pair
    if not at_fault(body[:, i], body[:, j]):
        i, j, towed = j, i, (towed[1], towed[0])
    a, b = table.ids[i], table.ids[j]
    return Event(
        time=time,
        kind="collision",
        vehicle=a,
        other=b,
        x=float(middle[0]),
        y=float(middle[1]),
        speed=float(table["speed"][i]),
        other_speed=float(table["speed"][j]),
        type=types.get(a, ""),
        other_type=types.get(b, ""),
        phase=bool(table.controlled[i]),
        other_phase=bool(table.controlled[j]),
        fault=True,
        other_fault=bool(at_fault(body[:, j], body[:, i])),
        box=_box(table, i, towed[0]),
        other_box=_box(table, j, towed[1]),
    )


def _box(table: VehicleTable, row: int, towed: bool) -> str:
    if towed:
        return "trailer"
    return "tractor" if table["trailer_length"][row] > 0 else "body"


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

        def own(values: torch.Tensor) -> torch.Tensor:
            return values[0, torch.from_numpy(rows), None]

        box = boxes(self._table.shape().map(own), self._table.state().map(own))
        layer = torch.from_numpy(np.where(node[rows] >= 0, self._road.layer[node[rows]], 0))
        touching, _ = road_contacts(box, self._road.map, layer, int(towing.any()))
        for row in rows[touching[:, 0].numpy()].tolist():
            member = members[self._table.ids[row]]
            if member.edge_event is None or time - member.edge_contact > APART:
                off = "off the road" if node[row] < 0 else "contact"
                member.edge_event = self._log.record("road edge", self._table.ids[row], off)
                member.edge_begin = time
            member.edge_contact = time
            member.edge_event.seconds = round(time - member.edge_begin, 3)
