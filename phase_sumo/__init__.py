"""PHASE: one self-play policy for cars and articulated trucks on highways, in torch and in SUMO."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phase_sumo.policy.checkpoint import load_policy as load_policy

try:
    __version__ = version("phase-sumo")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__", "load_policy"]


def __getattr__(name: str) -> Any:
    """Import torch only when a policy is really wanted, so that `--help` stays quick."""
    if name == "load_policy":
        from phase_sumo.policy.checkpoint import load_policy

        return load_policy
    raise AttributeError(f"module 'phase_sumo' has no attribute {name!r}")
