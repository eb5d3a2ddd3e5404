"""Where the files lie that the tools write."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NETWORKS = ROOT / "networks"
HELD_OUT = NETWORKS / "held_out"
SCENARIOS = ROOT / "scenarios"
RESULTS = ROOT / "results"
