"""The collisions of a run, with their place on the road, from its events file."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from phase_sumo.bridge.lane_position import LanePositions


def read_collisions(path: Path, lanes: LanePositions) -> list[dict[str, Any]]:
    """One dict per contact: time, vehicle, other, their type, speed, phase and fault, place and duration."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [_collision(row, lanes) for row in rows]


def at_fault(collision: dict[str, Any], phase: bool) -> bool:
    """Whether a vehicle under PHASE (or, with ``phase`` False, under SUMO) is to blame."""
    return (collision["fault"] and collision["phase"] == phase) or (
        collision["other_fault"] and collision["other_phase"] == phase
    )


def _collision(row: dict[str, str], lanes: LanePositions) -> dict[str, Any]:
    x, y = float(row["x"]), float(row["y"])
    lane, position, _ = lanes.locate(np.array([[x, y]]))
    return {
        "time": float(row["time"]),
        "seconds": float(row["seconds"]),
        "lane": lane[0],
        "position": round(float(position[0]), 1),
        "x": x,
        "y": y,
        "vehicle": row["a"],
        "other": row["b"],
        "type": row["type_a"],
        "other_type": row["type_b"],
        "speed": float(row["speed_a"]),
        "other_speed": float(row["speed_b"]),
        "phase": row["phase_a"] == "1",
        "other_phase": row["phase_b"] == "1",
        "fault": row["fault_a"] == "1",
        "other_fault": row["fault_b"] == "1",
    }
