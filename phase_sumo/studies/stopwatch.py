"""CPU time of the parts of a step of the bridge, taken from outside: a run without it pays nothing."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from functools import wraps
from typing import Any

from phase_sumo.bridge.fleet import controller
from phase_sumo.bridge.fleet.contacts import ContactMonitor, RoadEdgeMonitor
from phase_sumo.bridge.fleet.controller import Controller
from phase_sumo.bridge.fleet.fleet import Fleet
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.guarded import Guarding
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.outputs.recorder import Recorder
from phase_sumo.bridge.sumo.session import Simulation
from phase_sumo.policy.checkpoint import Policy

# What each part does; time within another part's function counts for that one
PARTS: dict[str, tuple[Any, str]] = {
    "sumo": (Simulation, "step"),
    "read": (Scene, "update"),
    "check": (Fleet, "follow_sumo"),
    "track": (Road, "track"),
    "road_edge": (RoadEdgeMonitor, "update"),
    "contacts": (ContactMonitor, "update"),
    "record": (Recorder, "sample"),
    "goals": (GoalPlanner, "update"),
    "neighbours": (Controller, "_neighbours"),
    "observe": (controller, "observe"),
    "policy": (Policy, "scores"),
    "guard": (Guarding, "correct"),
    "kinematics": (Controller, "_move"),
    "write": (Fleet, "drive"),
}


class Stopwatch:
    """Times `PARTS` of every run of the bridge in this process while it is open (a context manager).

    Times are those after the first ``warm_up`` steps of SUMO.

    Attributes:
        cpu, wall: s in each part.
        steps, decisions, vehicle_steps: of SUMO, calls of the policy, and vehicles driven in all of those.
        total_cpu, total_wall: s from the end of the warm-up to the end of the last step.
    """

    def __init__(self, warm_up: int) -> None:
        self._left = warm_up
        self._open: list[str] = []
        self._last = (0.0, 0.0)
        self._began = (0.0, 0.0)
        self._originals: dict[str, Callable[..., Any]] = {}
        self.cpu = dict.fromkeys(PARTS, 0.0)
        self.wall = dict.fromkeys(PARTS, 0.0)
        self.steps = self.decisions = self.vehicle_steps = 0

    def __enter__(self) -> Stopwatch:
        for part, (owner, name) in PARTS.items():
            self._originals[part] = getattr(owner, name)
            setattr(owner, name, self._timed(part, self._originals[part]))
        return self

    def __exit__(self, *_: object) -> None:
        for part, (owner, name) in PARTS.items():
            setattr(owner, name, self._originals[part])

    @property
    def total_cpu(self) -> float:
        return self._last[0] - self._began[0]

    @property
    def total_wall(self) -> float:
        return self._last[1] - self._began[1]

    def _timed(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(work)
        def run(*args: Any, **options: Any) -> Any:
            if part == "sumo":
                self._next_step()
            self._book()
            self._open.append(part)
            try:
                result = work(*args, **options)
            finally:
                self._book()
                self._open.pop()
            if part == "policy" and self._left < 0:
                self.decisions += 1
                self.vehicle_steps += len(result)
            return result

        return run

    def _next_step(self) -> None:
        self._left -= 1
        self.steps += self._left < 0
        if self._left == -1:
            self._began = self._last = (clock.process_time(), clock.perf_counter())

    def _book(self) -> None:
        """The time since the last call belongs to the innermost open part."""
        now = (clock.process_time(), clock.perf_counter())
        if self._open and self._left < 0:
            self.cpu[self._open[-1]] += now[0] - self._last[0]
            self.wall[self._open[-1]] += now[1] - self._last[1]
        self._last = now
