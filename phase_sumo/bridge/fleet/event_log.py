"""What happened in a run: one record per event, one file for all of them."""

from __future__ import annotations

import csv
import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.sumo.conventions import front_from_reference
from phase_sumo.bridge.sumo.session import Simulation

Kind = Literal["collision", "road edge", "wrong exit", "reroute", "adoption", "hand-back", "removal"]


AFTER_HAND_BACK = 10.0  # s for which what happens to a vehicle that was given back is still the policy's


@dataclass
class Event:
    """Something that happened to a vehicle, or to two in a collision.

    Attributes:
        time: s, the time stamp that SUMO's outputs give that state.
        kind: collision (boxes touch), road edge (touched it or went over it), wrong exit (left its route),
            reroute (SUMO found another way), adoption (the policy takes over), hand-back (SUMO takes over),
            removal (taken out of the simulation).
        vehicle, other: ids; in a collision the vehicle is at fault, and the other too when neither is clearly
            behind.
        lane, position: SUMO's lane and the position in m of the vehicle's front bumper on it; "" and NaN on
            none.
        x, y: m, middle between the two boxes in a collision, else the vehicle's front bumper.
        speed, other_speed: m/s.
        type, other_type: their vTypes.
        phase, other_phase: driven by the policy.
        fault, other_fault: the paper's rule.
        after_hand_back: the policy drives neither, but gave one back up to `AFTER_HAND_BACK` before.
        box, other_box: part that touched: body, or tractor or trailer of an articulated vehicle.
        seconds: how long a contact lasted.
        reason: why.
    """

    time: float
    kind: Kind
    vehicle: str
    other: str = ""
    lane: str = ""
    position: float = math.nan
    x: float = math.nan
    y: float = math.nan
    speed: float = math.nan
    other_speed: float = math.nan
    type: str = ""
    other_type: str = ""
    phase: bool = False
    other_phase: bool = False
    fault: bool = False
    other_fault: bool = False
    after_hand_back: bool = False
    box: str = ""
    other_box: str = ""
    seconds: float = 0.0
    reason: str = ""

    @property
    def with_phase(self) -> bool:
        """A vehicle under the policy is part of it."""
        return self.phase or self.other_phase

    @property
    def phase_at_fault(self) -> bool:
        """A vehicle under the policy is to blame."""
        return (self.phase and self.fault) or (self.other_phase and self.other_fault)


class EventLog:
    """The events of a run, in order; where a vehicle is on SUMO's lanes is read when something happens."""

    def __init__(self, session: Simulation, table: VehicleTable, types: dict[str, str]) -> None:
        self._session, self._table, self._types = session, table, types
        self.events: list[Event] = []
        self._given_back: dict[str, float] = {}

    @property
    def now(self) -> float:
        """The time stamp that SUMO's outputs give the present state: its clock is a step ahead of it."""
        return round(self._session.time - self._session.step_length, 3)

    def record(self, kind: Kind, vehicle: str, reason: str = "") -> Event:
        """Something happened to one vehicle, here and now."""
        event = Event(self.now, kind, vehicle, type=self._types.get(vehicle, ""), reason=reason)
        row = self._table.row_of.get(vehicle)
        if row is not None:
            table = self._table
            at = front_from_reference(
                table["x"][row],
                table["y"][row],
                table["yaw"][row],
                table["length"][row] - table["rear_overhang"][row],
            )
            event.x, event.y = map(float, table.origin + at)
            event.speed = float(table["speed"][row])
            event.phase = bool(table.controlled[row])
        return self.add(event)

    def add(self, event: Event) -> Event:
        """Keep an event, with the place of its vehicle on SUMO's lanes."""
        api = self._session.api
        try:
            event.lane = api.vehicle.getLaneID(event.vehicle)
            event.position = api.vehicle.getLanePosition(event.vehicle) if event.lane else math.nan
        except self._session.refused:  # SUMO took it out
            event.lane, event.position = "", math.nan
        if event.kind == "hand-back":
            self._given_back[event.vehicle] = event.time
        elif event.kind == "adoption":
            self._given_back.pop(event.vehicle, None)
        elif event.kind == "collision" and not event.with_phase:
            event.after_hand_back = self.given_back(event.vehicle) or self.given_back(event.other)
        self.events.append(event)
        return event

    def given_back(self, vehicle: str) -> bool:
        """Whether the policy gave the vehicle back up to `AFTER_HAND_BACK` ago."""
        return self.now - self._given_back.get(vehicle, -math.inf) <= AFTER_HAND_BACK

    def of(self, kind: Kind) -> list[Event]:
        """The events of one kind."""
        return [event for event in self.events if event.kind == kind]

    def turns(self) -> defaultdict[str, list[Event]]:
        """Vehicle -> its hand-overs to and from the policy, in order."""
        found: defaultdict[str, list[Event]] = defaultdict(list)
        for event in self.events:
            if event.kind in ("adoption", "hand-back"):
                found[event.vehicle].append(event)
        return found

    def counts(self) -> Counter[str]:
        """How many of each kind."""
        return Counter(event.kind for event in self.events)


def under_policy(turns: list[Event], time: float) -> bool:
    """Whether the policy drove a vehicle at some time, from its hand-overs."""
    before = [event for event in turns if event.time <= time]
    return bool(before) and before[-1].kind == "adoption"


def write_events(path: Path, events: Iterable[Event]) -> None:
    """One CSV line per event; empty cells where something does not apply."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(field.name for field in fields(Event))
        writer.writerows([_cell(value) for value in asdict(event).values()] for event in events)


def read_events(path: Path) -> list[Event]:
    """Inverse of `write_events`."""
    kinds = {field.name: str(field.type) for field in fields(Event)}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [Event(**{name: _value(kinds[name], text) for name, text in row.items()}) for row in rows]


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.3f}".rstrip("0").rstrip(".")
    return str(value)


def _value(kind: str, text: str) -> Any:
    if kind == "bool":
        return text == "1"
    if kind == "float":
        return float(text) if text else math.nan
    return text
