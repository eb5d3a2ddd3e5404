"""The events file holds what happened, to the digit that is written."""

from __future__ import annotations

import dataclasses
import math

from phase_sumo.bridge.fleet.event_log import Event, read_events, write_events


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
