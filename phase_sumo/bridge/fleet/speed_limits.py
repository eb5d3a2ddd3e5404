"""Speed limits as they are now: variable speed signs and users change them during a run."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from phase_sumo.sim.lanes import LaneNetwork

PERIOD = 1.0  # s between two looks


class SpeedLimits:
    """The present limit of every lane.

    Attributes:
        values: [L] m/s.
    """

    def __init__(self, api: ModuleType, network: LaneNetwork) -> None:
        self._api = api
        self._lanes = [(i, lane.id) for i, lane in enumerate(network.lanes) if not lane.connector]
        self._next = -np.inf
        self.values = np.array([lane.speed_limit for lane in network.lanes])

    def update(self, time: float) -> None:
        """Read them again from time to time; connectors keep what the network says."""
        if time < self._next - 1e-6:
            return
        self._next = time + PERIOD
        read = self._api.lane.getMaxSpeed
        for i, name in self._lanes:
            self.values[i] = read(name)
