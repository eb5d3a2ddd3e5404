"""The policies of a run: one for all, and those that vehicles name in ``phase.policy``.

And what is remembered of a vehicle while a policy drives it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from torch import Tensor

from phase_sumo.bridge.fleet.event_log import Event
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.config import Actions, SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.observation import Observation


class Driver(Protocol):
    """What drives: `phase_sumo.policy.checkpoint.Policy`, or a stand-in in tests."""

    @property
    def sim(self) -> SimConfig: ...

    @property
    def actions(self) -> Actions: ...

    def scores(self, observation: Observation) -> Tensor:
        """Logits [A, actions] of the observing agents; the vehicle takes the action with the highest."""
        ...


class Drivers:
    """Policies by number; the run's common one is number 0."""

    def __init__(self, common: Driver, folder: Path = Path()) -> None:
        """``folder`` is what relative file names in ``phase.policy`` start from."""
        self._drivers = [common]
        self._folder = folder
        self._number: dict[str, int] = {}

    def __getitem__(self, number: int) -> Driver:
        return self._drivers[number]

    def __iter__(self) -> Iterator[Driver]:
        return iter(self._drivers)

    @property
    def dt(self) -> float:
        """Step of all the policies in s."""
        return self._drivers[0].sim.dt

    def number(self, policy: str | None) -> int:
        """Number of a policy file, read when it is first asked for; None is the common one."""
        if policy is None:
            return 0
        if policy not in self._number:
            driver = load_policy(self._folder / policy)
            if driver.sim.dt != self.dt:
                raise PhaseError(
                    f"{policy}: drives in steps of {driver.sim.dt:g} s, the run's policy in steps of "
                    f"{self.dt:g} s; run them apart"
                )
            self._drivers.append(driver)
            self._number[policy] = len(self._drivers) - 1
        return self._number[policy]


@dataclass
class Member:
    """A vehicle under the policy.

    Attributes:
        route: lanes of the stretch of its route on the observed road.
        edges: that stretch; empty when the route was lost.
        leads_off: the route goes on to roads that SUMO drives.
        speed_factor: of the vehicle, on speed limits.
        max_speed: of the vType, m/s.
        min_gap: of the vType, m.
        target_speed: set by the parameter ``phase.target_speed``, m/s; 0 follows the speed limit.
        time_gap: s to the leader, see `target_speeds`; 0 takes no heed of leaders.
        lost_since: time since when the front bumper is on no lane, or None.
        off_lane_until: time until which SUMO is told a position on a lane, see `PoseWriter`.
        edge_event, edge_begin, edge_contact: its last contact with the road edge, first and last time of it.
        wrong: already counted as being off its route.
        trip: edges of its route from where it was last looked at, all the way to its destination.
        route_id: SUMO's name of that route.
        displaced: SUMO was made to forget the route, see `plans`.
    """

    route: RouteLanes
    edges: tuple[str, ...]
    leads_off: bool
    speed_factor: float
    max_speed: float
    min_gap: float
    target_speed: float = 0.0
    time_gap: float = 0.0
    lost_since: float | None = None
    off_lane_until: float = -np.inf
    edge_event: Event | None = None
    edge_begin: float = -np.inf
    edge_contact: float = -np.inf
    wrong: bool = False
    trip: tuple[str, ...] = ()
    route_id: str = ""
    displaced: bool = False
