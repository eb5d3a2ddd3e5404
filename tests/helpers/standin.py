"""A hand-written driver on the policy's lattice: steers to the goal, keeps its distance. For tests only."""

from __future__ import annotations

import torch
from torch import Tensor

from phase_sumo.config import ActionConfig, Actions, SimConfig
from phase_sumo.sim.observation import LAYOUT, Observation

EGO = {f.name: (i, f.scale) for i, f in enumerate(LAYOUT["ego"])}
PARTNER = {f.name: (i, f.scale) for i, f in enumerate(LAYOUT["partner"])}


def liking(token: Tensor, actions: Actions) -> Tensor:
    """[A, actions] scores, the highest for ``token`` [A], and those near it on the lattice before others."""
    along, across = (torch.tensor(axis) for axis in actions.axes)
    jerk, rate = along[token // len(across)], across[token % len(across)]
    along, across = (along - jerk.unsqueeze(1)).abs(), (across - rate.unsqueeze(1)).abs()
    return -(along.unsqueeze(2) + 20.0 * across.unsqueeze(1)).flatten(1)


class Standin:
    """Pure pursuit of the goal and IDM behind whoever is on the way.

    Args:
        reckless: looks at no one, and leaves the road to the left where alpha is below 0.35.
    """

    def __init__(self, reckless: bool = False) -> None:
        self.reckless = reckless
        self.sim = SimConfig()
        self.actions = ActionConfig()

    def scores(self, observation: Observation) -> Tensor:
        """Logits [A, actions], the highest for what it wants."""
        return liking(self.tokens(observation), self.actions)

    def tokens(self, observation: Observation) -> Tensor:
        """Action tokens [A]."""

        def ego(name: str) -> Tensor:
            i, scale = EGO[name]
            return observation.ego[:, i] * scale

        def partner(name: str) -> Tensor:
            i, scale = PARTNER[name]
            return observation.partner[..., i] * scale

        speed, length = ego("speed"), ego("length")
        wheelbase = torch.where(ego("trailer_length") > 0, 0.75 * length, 0.6 * length)
        x, y = ego("goal_x").clamp_min(5.0), ego("goal_y")
        # a cubic to the goal that arrives in its direction starts with this curvature
        turn = torch.atan2(ego("goal_yaw_sin"), ego("goal_yaw_cos"))
        curvature = (6.0 * y - 2.0 * x * torch.tan(turn.clamp(-1, 1))) / (x * x)
        steer = torch.atan(wheelbase * curvature).clamp(-0.3, 0.3)
        if self.reckless:
            steer = torch.where(ego("alpha") < 0.35, 0.03, steer)
        rate = (steer - ego("steer")) / 0.3
        ahead, aside = partner("x"), partner("y")
        path = y.unsqueeze(-1) * (ahead / x.unsqueeze(-1)).clamp(0, 1) ** 2
        in_way = observation.partner_mask & (ahead > 0) & ((aside - path).abs() < 2.2)
        gap = ahead - 0.5 * partner("length") - (0.8 * length).unsqueeze(-1)
        closing = partner("closing_speed")
        wanted_gap = 3.0 + (speed * 1.3).unsqueeze(-1) + (speed.unsqueeze(-1) * closing / 4.0).clamp_min(0)
        in_way &= not self.reckless
        ratio = torch.where(in_way, (wanted_gap / gap.clamp_min(0.5)) ** 2, 0.0).amax(-1)
        target = (speed + ego("goal_speed_error")).clamp_min(1.0)
        accel = (2.0 * (1 - (speed / target) ** 4 - ratio)).clamp(-6.0, 2.0)
        jerk = (accel - ego("accel")) / 0.3 / ego("alpha").clamp_min(0.1)
        jerks, rates = torch.tensor(self.actions.jerk), torch.tensor(self.actions.steering_rate)
        j = (jerk.unsqueeze(-1) - jerks).abs().argmin(-1)
        r = (rate.unsqueeze(-1) - rates).abs().argmin(-1)
        return j * len(rates) + r
