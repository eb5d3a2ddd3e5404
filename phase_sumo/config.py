"""Every constant of the package, as frozen dataclasses; defaults are the paper's tables.

Where the paper gives no value the field's comment says ``choice``; PAPER.md lists and explains them.
All values are SI: metres, seconds, radians.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from typing import Any, TypeVar

from phase_sumo.errors import PhaseError

C = TypeVar("C")


@dataclass(frozen=True)
class ActionConfig:
    """Jerk x steering-rate lattice (paper: Action Space) and the prior's spread (Eq. kl_action_reg)."""

    jerk: tuple[float, ...] = (-8.0, -4.0, -1.5, 0.0, 1.5, 3.0, 5.0)  # m/s^3, choice
    # choice: non-uniform, so that 30 m/s (0.005 rad/s matters) and 3 m/s (0.3 rad/s) are both smooth
    steering_rate: tuple[float, ...] = (-0.3, -0.08, -0.02, -0.005, 0.0, 0.005, 0.02, 0.08, 0.3)  # rad/s
    prior_jerk: float = 2.5  # sigma_j of the prior, m/s^3, choice
    prior_steering_rate: float = 0.03  # sigma of the prior's steering rate, rad/s, choice

    @property
    def axes(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return self.jerk, self.steering_rate

    @property
    def prior(self) -> tuple[float, float]:
        """Standard deviations of the prior along the axes."""
        return self.prior_jerk, self.prior_steering_rate

    @property
    def count(self) -> int:
        return len(self.jerk) * len(self.steering_rate)


@dataclass(frozen=True)
class DirectActionConfig:
    """Acceleration x steering-angle lattice of the GPUDrive baseline (Cornelisse et al. 2025)."""

    accel: tuple[float, ...] = tuple(round(4.0 * k / 3, 6) for k in range(-3, 4))  # m/s^2
    steer: tuple[float, ...] = tuple(round(math.pi * k / 6, 6) for k in range(-6, 7))  # rad

    @property
    def axes(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return self.accel, self.steer

    @property
    def prior(self) -> tuple[float, float]:
        """The uniform one: KL to it is the entropy bonus but for a constant."""
        return math.inf, math.inf

    @property
    def count(self) -> int:
        return len(self.accel) * len(self.steer)


Actions = ActionConfig | DirectActionConfig


@dataclass(frozen=True)
class SimConfig:
    """World model (paper: Kinematic Model, Simulation Mechanisms, Observation Space)."""

    dt: float = 0.1
    horizon: int = 91  # steps of an episode (GPUDrive's)
    goal_radius: float = 2.0  # m, swept between two positions
    early_termination: bool = True  # of agents that have their goal behind them
    max_speed: float = 40.0  # m/s
    accel_bounds: tuple[float, float] = (-8.0, 4.0)  # m/s^2, cars, choice
    truck_accel_bounds: tuple[float, float] = (-6.0, 1.8)  # m/s^2, choice
    max_steer: float = 0.7  # rad, choice
    lateral_accel: float = 5.0  # m/s^2, grip that bounds v^2 tan(steer)/wheelbase, choice
    truck_lateral_accel: float = 3.0  # m/s^2, below a laden semi's roll-over threshold, choice
    neighbours: int = 16  # K
    neighbour_range: float = 150.0  # m, choice
    position_noise: float = 0.05  # m, sigma on partner and road positions while training, choice
    speed_noise: float = 0.1  # m/s, choice
    yaw_noise: float = 0.005  # rad, choice
    min_speed: float = 1.0  # m/s, guard of the two rewards that divide by speed, choice


@dataclass(frozen=True)
class GuardConfig:
    """What `sim.guard` assumes and keeps. Values are for cars and for trucks, where there are two."""

    # Others brake no harder than this, m/s^2: our own vehicles' bounds, and SUMO's vehicles up to their decel
    others_braking: tuple[float, float] = (8.0, 6.0)
    # ... and it builds up with this, m/s^3, from how they brake now: our own emergency jerk. SUMO's vehicles,
    # whose braking needs no time, are within it up to 4.5 m/s^2, the decel of SUMO's cars
    others_jerk: float = 30.0
    # Brakes in an emergency build up with this, m/s^3: hydraulic ones reach 8 m/s^2 in about 0.25 s, of air
    # brakes UN Regulation 13 asks for 75 % of their effect in 0.6 s
    emergency_jerk: tuple[float, float] = (30.0, 10.0)
    gap: float = 0.5  # m kept to those ahead, choice
    aside: float = 0.1  # m kept to those beside, choice
    approach: float = 0.4  # m up to which a vehicle may steer towards them, choice
    followers_jerk: float = 5.0  # m/s^3 with which those behind may speed up for one more step, our lattice's
    steering_rate: float = 0.3  # rad/s, our lattice's
    straighten: float = 0.3  # s, time constant with which an evading vehicle turns along its lane, choice
    settle: float = 1.8  # s after which it runs along its lane or stands, choice
    approach_edge: float = 0.3  # m up to which it may steer towards the road's edge, choice
    grip: float = 0.9  # share of the grip that curves ahead may take, choice
    drift: float = 0.5  # s for which others are expected to go on moving sideways, choice
    wobble: float = 0.4  # m/s sideways: who is faster is taken to change lanes, choice
    crossing: float = 1.5  # s for which those are expected to go on, choice
    improbable: float = 7.0  # nats below the likeliest action: braking by the guard comes first then, choice


@dataclass(frozen=True)
class RewardConfig:
    """Reward weights (paper: Table reward_constants) and goal-quality tolerances."""

    goal: float = 3.3  # w_g
    lane: float = 0.005  # w_l
    collision: float = 1.0  # w_f
    road_edge: float = 0.9  # w_e
    termination: float = 8.3  # w_t
    alignment: float = 0.09  # w_a
    speed: float = 0.07  # w_s, of a speed above the target speed
    progress: float = 0.25  # w_p
    penalty_growth: float = 2.69  # lambda
    kappa: float = 1.01
    ramp_horizon: float = 5.0  # s, T_ramp
    progress_decay: float = 100.0  # m, psi(d) = exp(-d / progress_decay), choice
    goal_speed_tolerance: tuple[float, float] = (2.0, 2.0)  # m/s below, above: w_s is 1, else 0.1, choice
    goal_yaw_tolerance: float = 0.1  # rad within which w_a is 1, else 0.1, choice
    # Unit of ||g|| in the termination term. Most goals are missed by a lane's width: in metres that costs 29,
    # nine goals, in kilometres 0.03, nothing; so it costs 1.5, beside w_f = 1.0 and w_e = 0.9.
    distance_unit: float = 20.0  # m, choice
    # Not in the paper; with these values the terms are the paper's
    speed_below: float = 0.07  # of a speed below the target speed
    # The first contact at its fault, or with the road edge, ends an agent's episode. Else one that is stuck
    # pays in every step, and a few such agents make up nearly all of the advantages' variance.
    contacts_end: bool = False
    not_at_fault: float = 0.0  # share of a collision's weight that the one who is not at fault pays


@dataclass(frozen=True)
class Regime:
    """One traffic regime (paper: Table scenario_stats); path bounds scale so that ~6 s of driving fit."""

    name: str
    path_bounds: tuple[float, float]  # D_min, D_max in m
    base_speed: float  # v_base in m/s
    agents: tuple[int, int]  # N before the curriculum switch
    agents_late: tuple[int, int]  # N after it
    lane_change_ratio: float  # P_lc before
    lane_change_ratio_late: float  # P_lc after
    tuples: int  # share of the 77 (map, pool) tuples
    spread: float = 0.4  # eps_init ~ U(-spread, spread): Table scenario_stats read as half-ranges


REGIMES = (
    Regime("jammed", (22.0, 58.0), 6.7, (96, 256), (144, 256), 0.4, 0.5, 22),
    Regime("dense", (50.0, 130.0), 15.0, (64, 96), (96, 144), 0.4, 0.5, 22),
    Regime("moderate", (78.0, 202.0), 23.3, (32, 64), (64, 96), 0.4, 0.5, 22),
    Regime("free", (106.0, 274.0), 31.6, (1, 32), (1, 64), 0.4, 0.6, 11),
)
# not in the paper: stop and go, from standstill on
CRAWLING = Regime("crawling", (6.0, 30.0), 2.5, (96, 256), (144, 256), 0.25, 0.3, 11, spread=1.0)
POOLS = (*REGIMES, CRAWLING)  # the regimes that every map has start-goal pairs for


@dataclass(frozen=True)
class ScriptConfig:
    """Scripted vehicles of training (`sim.scripted`): none in the paper. Values are choices."""

    standing_worlds: float = 0.0  # share of the worlds in which vehicles stand on lanes
    scripted_worlds: float = 0.0  # share in which some follow their lanes and give way to nobody
    slots: float = 0.1  # share of the agents' slots that they may take
    most_standing: int = 4  # vehicles of a world
    brake: tuple[float, float] = (4.0, 8.0)  # m/s^2, how hard a scripted leader brakes; every second one does
    brake_from: tuple[float, float] = (0.5, 5.0)  # s of the scenario
    brake_for: tuple[float, float] = (1.0, 4.0)  # s
    accel: float = 1.5  # m/s^2, IDM's a
    comfortable: float = 2.0  # m/s^2, IDM's b
    time_gap: float = 1.2  # s, IDM's T
    least_gap: float = 2.0  # m, IDM's s0


@dataclass(frozen=True)
class ScenarioConfig:
    """Online generator (paper: Synthetic Scenario Generation)."""

    regimes: tuple[Regime, ...] = REGIMES
    max_lane_changes: int = 3  # K
    truck_ratio: float = 0.15  # P_truck, choice
    rigid_truck_ratio: float = 0.3  # share of the trucks without a trailer, choice
    goal_speed_bounds: tuple[float, float] = (-0.25, 0.5)  # eps_goal ~ U, choice: merging speeds up most
    alpha_bounds: tuple[float, float] = (0.1, 1.0)
    agent_scale: float = 1.0  # multiplies every regime's agent counts (small machines)
    time_gap: tuple[float, float] = (0.6, 1.8)  # s ahead of vehicles at the start, per world, choice
    least_time_gap: float = 0.4  # s to which dense worlds shorten it before they drive slower, choice
    least_gap: float = 1.5  # m at standstill, choice
    horizon_share: float = 0.85  # a path must be drivable in this share of the horizon, choice
    # not in the paper, and 0 there:
    astray: float = 0.0  # share of the agents that begin out of line with their lane
    rolling_worlds: float = 0.0  # share of the worlds in which agents at their goal get the next one
    rolling_horizon: int = 300  # steps of those
    rolling_speed: tuple[float, float] = (0.8, 2.0)  # target speed there, by the initial speed
    script: ScriptConfig = ScriptConfig()


@dataclass(frozen=True)
class NetworkConfig:
    """Policy network (paper: Model); 670 K parameters with the defaults, which are choices."""

    width: int = 32  # of every partner's and road point's embedding
    hidden: int = 64  # of the encoders; the ego state's embedding too
    heads: int = 2
    feedforward: int = 64
    seeds: int = 8  # of each attention pooling
    trunk: int = 512
    head: int = 320


@dataclass(frozen=True)
class LateFusionConfig:
    """The GPUDrive baseline's network (Cornelisse et al. 2025): 51,228 parameters on its own features."""

    embedding: int = 64  # of ego, and of every partner and road point
    hidden: int = 128  # of all three together
    dropout: float = 0.01


Network = NetworkConfig | LateFusionConfig


@dataclass(frozen=True)
class TaskConfig:
    """What agents have to do: the world's rules, its scenarios, what is rewarded, and how agents act."""

    sim: SimConfig = SimConfig()
    actions: Actions = ActionConfig()
    reward: RewardConfig = RewardConfig()
    scenarios: ScenarioConfig = ScenarioConfig()


@dataclass(frozen=True)
class TrainConfig(TaskConfig):
    """Self-play training (paper: Training); values the paper leaves open follow PPO practice."""

    scenarios: ScenarioConfig = ScenarioConfig(agent_scale=0.5)
    network: Network = NetworkConfig()
    worlds: int = 77  # one for every (map, regime) tuple
    slots: int = 96  # agent slots per world
    total_steps: int = 36_000_000  # agent steps
    rollout: int = 16  # steps per world and update
    minibatch: int = 1024
    epochs: int = 1
    learning_rate: float = 1e-3
    final_learning_rate: float = 0.05  # share of it that is left at the end, after an even decay
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2  # epsilon
    dclamp_alpha: float = 3.0  # 1 is plain PPO
    dclamp_beta: float = 0.2
    value_weight: float = 0.5
    prior_weight: float = 3e-3  # lambda_KL
    gradient_norm: float = 0.5
    reweight: bool = True  # 1 / N_w
    learn_share: float = 0.5  # of the samples, those with the largest |advantage|, are learnt from
    curriculum: tuple[float, float] = (0.3, 0.8)  # shares of training at which rho starts and ends
    bf16: bool = True  # matrix products of the network
    compiled: bool = True  # worlds step through torch.compile, if there is a C++ compiler
    held_out_every: int = 2_500_000  # agent steps between evaluations on the held-out maps
    checkpoint_every: int = 1_000_000  # agent steps
    seed: int = 0


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON types."""
    return dataclasses.asdict(config)


def from_dict(cls: type[C], data: dict[str, Any]) -> C:
    """Inverse of `to_dict`; unknown keys and wrong shapes are refused by name."""
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(data) - set(hints))
    if unknown:
        raise PhaseError(f"{cls.__name__} has no setting {unknown[0]!r}; known: {', '.join(sorted(hints))}")
    return cls(**{key: restore(hints[key], value) for key, value in data.items()})


def restore(hint: Any, value: Any) -> Any:
    """A value of an annotated type from JSON types; a union's first config with all the settings is meant."""
    if isinstance(hint, types.UnionType):
        members = typing.get_args(hint)
        hint = next((m for m in members if set(value) <= set(typing.get_type_hints(m))), members[0])
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_dict(hint, value)
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)[0]
        return tuple(restore(inner, item) for item in value)
    return value
