"""The events file holds what happened, to the digit that is written."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

from phase_sumo.bridge.fleet.event_log import Event, EventLog, Kind, read_events, write_events


def test_events_come_back_from_their_file(tmp_path):
    events = [
        Event(13.7, "collision", "a,1", 'b "two"', "e_0", 63.25, 1.5, -2.0, 20.0, 0.0, "car", "semi",
              phase=True, fault=True, box="body", other_box="trailer", seconds=0.9),
        Event(14.0, "removal", "c", reason="off road"),
    ]  # fmt: skip
    write_events(tmp_path / "events.csv", events)
    first, second = read_events(tmp_path / "events.csv")
    assert first == events[0]
    assert math.isnan(second.x) and math.isnan(second.position)
    assert dataclasses.replace(second, x=0, y=0, position=0, speed=0, other_speed=0) == dataclasses.replace(
        events[1], x=0, y=0, position=0, speed=0, other_speed=0
    )
    header = (tmp_path / "events.csv").read_text().splitlines()[0]
    assert header.startswith("time,kind,vehicle,other,lane,position,x,y")


def test_blame_needs_fault_and_policy():
    event = Event(0.0, "collision", "a", "b", phase=False, other_phase=True, fault=True, other_fault=False)
    assert event.with_phase and not event.phase_at_fault
    event.other_fault = True
    assert event.phase_at_fault


def test_collisions_soon_after_a_hand_back_are_marked():
    clock = SimpleNamespace(time=0.1, step_length=0.1, refused=KeyError)
    clock.api = SimpleNamespace(
        vehicle=SimpleNamespace(getLaneID=lambda _: "", getLanePosition=lambda _: 0.0)
    )
    log = EventLog(clock, SimpleNamespace(row_of={}), {})  # type: ignore[arg-type]
    found = []
    happened: tuple[tuple[float, Kind, bool], ...] = (
        (0.0, "collision", False),
        (1.0, "hand-back", False),
        (10.0, "collision", False),
        (10.0, "collision", True),
        (11.5, "collision", False),
        (20.0, "hand-back", False),
        (21.0, "adoption", False),
        (22.0, "collision", False),
    )
    for time, kind, phase in happened:
        clock.time = time + 0.1
        event = log.add(Event(time, kind, "x" if kind == "collision" else "a", "a", phase=phase))
        found += [event.after_hand_back] * (kind == "collision")
    assert found == [False, True, False, False, False]
