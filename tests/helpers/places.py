"""Where files lie that tests read."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NETWORKS = ROOT / "networks"
HELD_OUT = NETWORKS / "held_out"
SHARED = ROOT.parent / "shared"  # real networks and recorded traffic that are not shipped
NOT_SHARED = "not beside the repository: ../shared"  # why a test that reads there is skipped
