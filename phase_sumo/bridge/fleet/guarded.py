"""The guard in a simulation: `sim.guard` on the rows of a table, and what it did, counted."""

from __future__ import annotations

import time as clock
from collections.abc import Iterable
from dataclasses import fields

import numpy as np
import torch
from torch import Tensor

from phase_sumo.arrays import IntArray
from phase_sumo.bridge.fleet.drivers import Driver
from phase_sumo.bridge.fleet.scene import Trip
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.config import GuardConfig
from phase_sumo.sim.guard import Decision, guarded
from phase_sumo.sim.hazards import Reason
from phase_sumo.sim.path import Sight

OFTEN = 0.01  # share of the decisions from which on the traffic is the guard's as much as the policy's
COUNTED = {
    Reason.LEADER: "guard_leader",
    Reason.BESIDE: "guard_beside",
    Reason.ROAD_EDGE: "guard_road_edge",
    Reason.STANDING: "guard_standing",
}


def tally(trips: Iterable[Trip], decisions: int) -> dict[str, float]:
    """What the guard did in all trips, by the names of the JSON, of ``decisions`` looked at."""
    names = [field.name for field in fields(Trip) if field.name.startswith("guard_")]
    sums = {name: sum(getattr(trip, name) for trip in trips) for name in names}
    count = sum(sums[name] for name in COUNTED.values())
    share = count / decisions if decisions else 0.0
    return {"guard_interventions": count, "guard_share_of_decisions": share, **sums}


def warning(share: float) -> list[str]:
    """A line where the guard stepped in often."""
    if share <= OFTEN:
        return []
    return [
        f"the guard changed {100.0 * share:.1f} % of the decisions, for the reasons that guard_* count: "
        "the policy alone drives otherwise, as --guard off shows"
    ]


class Guarding:
    """Decides for the vehicles that have a guard, and notes in their trips where it stepped in.

    Attributes:
        cpu, decisions: CPU seconds spent, and decisions that were looked at.
    """

    def __init__(self, table: VehicleTable, trips: dict[str, Trip]) -> None:
        self._table, self._trips = table, trips
        self._config = GuardConfig()
        self.cpu = 0.0
        self.decisions = 0

    @property
    def cpu_per_decision(self) -> float:
        """CPU microseconds per decision that was looked at."""
        return 1e6 * self.cpu / max(self.decisions, 1)

    def correct(
        self,
        scores: Tensor,
        command: tuple[Tensor, Tensor],
        rows: IntArray,
        index: Tensor,
        mask: Tensor,
        sight: Sight,
        driver: Driver,
    ) -> tuple[Tensor, Tensor]:
        """Jerk and steering rate of rows [R], those of vehicles with a guard made safe.

        Args:
            scores: [R, A] of the policy.
            command: jerk and steering rate [R] that it wants.
            index, mask: [R, K] their neighbours.
            sight: the road as all rows of the table see it.
            driver: of all these rows.
        """
        some = np.flatnonzero(self._table.guarded[rows])
        if not len(some):
            return command
        begin = clock.process_time()
        at, own = torch.from_numpy(some), torch.from_numpy(rows[some])
        shape, state, alpha = self._table.shape(), self._table.state(), self._table.task().alpha
        decision = guarded(
            scores[at].float(),
            alpha[0, own],
            shape.map(lambda values: values[0]),
            state.map(lambda values: values[0]),
            own,
            index[at],
            mask[at],
            sight,
            driver.actions,
            driver.sim,
            self._config,
        )
        jerk, rate = (values.clone() for values in command)
        self._note(rows[some], decision, jerk[at], driver.sim.dt)
        jerk[at], rate[at] = decision.jerk, decision.rate
        self.decisions += len(some)
        self.cpu += clock.process_time() - begin
        return jerk, rate

    def _note(self, rows: IntArray, decision: Decision, wanted: Tensor, dt: float) -> None:
        """Add the decisions [R] that are not what was ``wanted`` (jerk in m/s^3) to the trips."""
        at = decision.reason.nonzero().squeeze(1)
        cost = (decision.jerk - wanted)[at].abs() * dt
        columns = (rows[at.numpy()], decision.reason[at], decision.unsafe[at], cost)
        for row, reason, unsafe, brake in zip(*(values.tolist() for values in columns), strict=True):
            trip = self._trips[self._table.ids[row]]
            name = COUNTED[Reason(reason)]
            setattr(trip, name, getattr(trip, name) + 1)
            trip.guard_unsafe += unsafe
            trip.guard_seconds += dt
            trip.guard_jerk += brake
