"""A driver that does nothing, and vehicles in each other for it."""

from __future__ import annotations

import torch

from phase_sumo.config import ActionConfig, SimConfig
from tests.helpers.standin import liking

VEHICLE = (
    '<vehicle id="{}" type="car" depart="0" departLane="{}" departPos="{}" departSpeed="{}" '
    'departPosLat="{}" insertionChecks="none"><route edges="main0 main1 main2"/></vehicle>'
)
# Side by side and in each other; behind one who stands SUMO would drive
ASTRIDE = (("a", 0, 60, 0, 1.2), ("b", 1, 62, 0, -1.2))


class Unmoved:
    """Neither accelerates nor steers."""

    sim, actions = SimConfig(), ActionConfig()

    def scores(self, observation):
        jerk, rate = self.actions.jerk, self.actions.steering_rate
        still = jerk.index(0.0) * len(rate) + rate.index(0.0)
        return liking(torch.full((len(observation.ego),), still), self.actions)
