"""The collisions of a run, from its events file."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from phase_sumo.bridge.fleet.event_log import read_events


def read_collisions(path: Path) -> list[dict[str, Any]]:
    """The fields of `Event` of every collision."""
    return [asdict(event) for event in read_events(path) if event.kind == "collision"]


def at_fault(collision: dict[str, Any], phase: bool) -> bool:
    """Whether a vehicle under PHASE (or, with ``phase`` False, under SUMO) is to blame."""
    return (collision["fault"] and collision["phase"] == phase) or (
        collision["other_fault"] and collision["other_phase"] == phase
    )
