"""What the lanes of a network allow one class of vehicles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray
from phase_sumo.sim.lanes import LaneNetwork


@dataclass(frozen=True)
class ClassRules:
    """What the lanes allow one vehicle class, all [L]; `LaneRules` keeps the values current.

    Attributes:
        allowed: it may drive there.
        left, right: it may change to the lane on that side.
        limit: m/s that speed factors apply to.
        cap: m/s whatever the speed factor, inf for none.
        least: m/s, the lowest of the limits and caps there and on the next lanes.
        barred: it is closed or its limit near what the policy drives at least, or one of the next lanes'.
    """

    allowed: BoolArray
    left: BoolArray
    right: BoolArray
    limit: FloatArray
    cap: FloatArray
    least: FloatArray
    barred: BoolArray

    @staticmethod
    def of_size(lanes: int) -> ClassRules:
        """Room for what is read later."""
        flags, speeds = np.zeros((4, lanes), bool), np.zeros((3, lanes))
        return ClassRules(flags[0], flags[1], flags[2], speeds[0], speeds[1], speeds[2], flags[3])

    @staticmethod
    def of_network(network: LaneNetwork, truck: bool) -> ClassRules:
        """As the network file says it for cars or trucks."""
        lanes = network.lanes
        return ClassRules(
            np.array([lane.allows_truck if truck else lane.allows_car for lane in lanes], bool),
            np.array([lane.left >= 0 for lane in lanes], bool),
            np.array([lane.right >= 0 for lane in lanes], bool),
            np.array([lane.speed_limit for lane in lanes], np.float64),
            np.full(len(lanes), np.inf),
            np.zeros(len(lanes)),
            np.zeros(len(lanes), bool),
        )
