"""The eight reward terms (paper: Rewards) and their curriculum multipliers (paper: Curricula)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import RewardConfig, SimConfig
from phase_sumo.sim.events import Events
from phase_sumo.sim.geometry import wrap_angle
from phase_sumo.sim.vehicles import Task, VehicleState


@dataclass(frozen=True)
class Multipliers:
    """Curriculum multipliers at a progress rho in [0, 1]."""

    rho: float | Tensor
    penalty: float | Tensor  # m_f = m_e = m_t = 1 + (lambda - 1) rho
    progress: float | Tensor  # m_p = 1 - rho

    @staticmethod
    def at(rho: float | Tensor, config: RewardConfig) -> Multipliers:
        return Multipliers(rho, 1.0 + (config.penalty_growth - 1.0) * rho, 1.0 - rho)

    def goal(self, quality: Tensor) -> Tensor:
        """m_g = 1 - rho (1 - w_s w_a) with ``quality`` = w_s w_a."""
        return 1.0 - self.rho * (1.0 - quality)


def rewards(
    before: VehicleState,
    after: VehicleState,
    task: Task,
    events: Events,
    multipliers: Multipliers,
    config: RewardConfig,
    sim: SimConfig,
) -> dict[str, Tensor]:
    """The signed terms of R_i by name, each [W, N]; their sum is the reward.

    R = R_g + R_l - R_f - R_e - R_t - R_a - R_s + R_p. All in SI units, except
    that R_t counts the distance to the goal in ``config.distance_unit``. The weights that the paper does not
    have are 0 by default, or equal one of its own: see `RewardConfig`.
    """
    distance = _distance(after, task)
    safe_speed = after.speed.clamp_min(sim.min_speed)
    too_fast = after.speed - task.goal_speed
    return {
        "goal": config.goal * multipliers.goal(goal_quality(after, task, config)) * events.goal,
        "lane": config.lane * (~events.lane_boundary).float(),
        "collision": -multipliers.penalty * collision(events, config),
        "road_edge": -multipliers.penalty * config.road_edge * events.road_edge,
        "termination": -config.termination
        * multipliers.penalty
        * events.unrecoverable
        * distance
        / config.distance_unit,
        "alignment": -config.alignment * alignment(after, task, distance, safe_speed, config),
        "speed": -config.speed * too_fast.clamp_min(0.0) - config.speed_below * (-too_fast).clamp_min(0.0),
        "progress": config.progress
        * multipliers.progress
        * progress(_distance(before, task), distance, safe_speed, config),
    }


def collision(events: Events, config: RewardConfig) -> Tensor:
    """Weight of a step's contacts: whose fault it is pays in full, the other one ``config.not_at_fault``."""
    return config.collision * torch.where(events.at_fault, 1.0, config.not_at_fault * events.collision)


def _distance(state: VehicleState, task: Task) -> Tensor:
    return torch.hypot(task.goal_x - state.x, task.goal_y - state.y)


def goal_quality(state: VehicleState, task: Task, config: RewardConfig) -> Tensor:
    """w_s w_a: 1 or 0.1 each, for target speed and for lane direction met at the goal."""
    below, above = config.goal_speed_tolerance
    speed_met = (state.speed >= task.goal_speed - below) & (state.speed <= task.goal_speed + above)
    yaw_met = wrap_angle(state.yaw - task.goal_yaw).abs() <= config.goal_yaw_tolerance
    return torch.where(speed_met, 1.0, 0.1) * torch.where(yaw_met, 1.0, 0.1)


def alignment(
    state: VehicleState, task: Task, distance: Tensor, safe_speed: Tensor, config: RewardConfig
) -> Tensor:
    """r_alignment = d_theta clip(1 - d / (v T_ramp), 0, 1), d_theta the bearing of the goal in rad.

    ``safe_speed`` is v kept off zero: at v = 0 time-to-go is infinite and the term vanishes.
    """
    bearing = torch.atan2(task.goal_y - state.y, task.goal_x - state.x) - state.yaw
    ramp = (1.0 - distance / (safe_speed * config.ramp_horizon)).clamp(0.0, 1.0)
    return wrap_angle(bearing).abs() * ramp


def progress(distance_before: Tensor, distance: Tensor, safe_speed: Tensor, config: RewardConfig) -> Tensor:
    """r_progress = clip((d' - kappa d) / v psi(d), -0.5, 0.5) in s, psi(d) = exp(-d / progress_decay)."""
    gained = distance_before - config.kappa * distance
    decay = torch.exp(-distance / config.progress_decay)
    return (gained / safe_speed * decay).clamp(-0.5, 0.5)
