"""PHASE: one self-play policy for cars and articulated trucks on highways, in torch and in SUMO."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phase_sumo.bridge.live import PhaseFleet as PhaseFleet
    from phase_sumo.bridge.sumo.options import SUMO_OPTIONS as SUMO_OPTIONS
    from phase_sumo.policy.checkpoint import load_policy as load_policy

try:
    __version__ = version("phase-sumo")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["SUMO_OPTIONS", "PhaseFleet", "__version__", "load_policy"]

_HOME = {
    "PhaseFleet": "phase_sumo.bridge.live",
    "SUMO_OPTIONS": "phase_sumo.bridge.sumo.options",
    "load_policy": "phase_sumo.policy.checkpoint",
}


def __getattr__(name: str) -> Any:
    """Import torch and SUMO only when they are really wanted, so that `--help` stays quick."""
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'phase_sumo' has no attribute {name!r}")
