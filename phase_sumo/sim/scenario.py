"""Online generator: samples agents, geometry, kinematics and start-goal pairs for worlds that reset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from phase_sumo.config import Regime, ScenarioConfig, SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.sim.curve_speed import SIDEWAYS, SIDEWAYS_TRUCK
from phase_sumo.sim.dimensions import sample_shape
from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.pool import StartGoalPool
from phase_sumo.sim.vehicles import HISTORY, Task, VehicleShape, VehicleState, boxes

PLACEMENT_ROUNDS = 8  # proposals for a slot before it stays empty
LATERAL_SIGMA = 0.15  # m, spread of the start across the lane
YAW_SIGMA = 0.01  # rad
ASTRAY_LATERAL_SIGMA, ASTRAY_YAW_SIGMA = 0.6, 0.15  # m, and rad up to ASTRAY_SPEED; faster ones less
ASTRAY_SPEED = 8.0  # m/s
LONGEST_PATH = 400  # m, size of the count tables


@dataclass
class Scenario:
    """Fresh agents for B worlds; axes B x N.

    Attributes:
        active: [B, N] bool, slots that hold an agent.
        goal_node: [B, N] node of each goal in the pair table.
    """

    shape: VehicleShape
    state: VehicleState
    task: Task
    active: Tensor
    goal_node: Tensor


class PairTable:
    """The pools of many (map, regime) tuples as flat tensors, ready to be drawn from in one gather.

    A list holds the pairs of one tuple, one kind (same lane or lane change) and one permission (any
    vehicle, trucks), sorted by path length, so that "uniform among the pairs up to a length" is one
    random number times one table entry.
    """

    def __init__(self, tuples: list[tuple[LaneGraph, StartGoalPool]], device: torch.device | str) -> None:
        nodes, starts, goals, limits, first, counts = [], [], [], [], [], []
        node_offset = pair_offset = 0
        for graph, pool in tuples:
            nodes.append(
                np.column_stack((graph.node_xy, graph.node_yaw, graph.node_curvature)).astype(np.float32)
            )
            for changes in (False, True):
                for trucks in (False, True):
                    chosen = np.flatnonzero(
                        ((pool.lane_changes != 0) == changes) & (pool.truck | (not trucks))
                    )
                    chosen = chosen[np.argsort(pool.path_length[chosen], kind="stable")]
                    lengths = np.ceil(pool.path_length[chosen]).astype(np.int64).clip(0, LONGEST_PATH)
                    starts.append(pool.start[chosen] + node_offset)
                    goals.append(pool.goal[chosen] + node_offset)
                    limits.append(
                        (pool.path_length[chosen], pool.start_speed[chosen], pool.goal_speed[chosen])
                    )
                    first.append(pair_offset)
                    counts.append(np.searchsorted(lengths, np.arange(LONGEST_PATH + 1), side="right"))
                    pair_offset += len(chosen)
            node_offset += len(graph.node_xy)
        if pair_offset == 0:
            raise PhaseError("the maps hold no start-goal pairs: convert longer networks")
        self.node = torch.from_numpy(np.concatenate(nodes)).to(device)
        self.start = torch.from_numpy(np.concatenate(starts)).long().to(device)
        self.goal = torch.from_numpy(np.concatenate(goals)).long().to(device)
        self.length, self.start_speed, self.goal_speed = (
            torch.from_numpy(np.concatenate(part)).to(device) for part in zip(*limits, strict=True)
        )
        self.first = torch.tensor(first).view(-1, 2, 2).to(device)
        self.count = torch.from_numpy(np.stack(counts)).view(-1, 2, 2, LONGEST_PATH + 1).to(device)

    def draw(
        self, tuple_index: Tensor, change: Tensor, truck: Tensor, longest: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor]:
        """One pair per slot.

        Args:
            tuple_index: [B, N] (map, regime) tuple.
            change, truck: [B, N] bool, wanted kind and permission.
            longest: [B, N] m, no longer path than this (the shortest there is, if none is that short).
            uniform: [B, N] in [0, 1).

        Returns:
            index of the pair [B, N] and whether the tuple has any such pair [B, N] bool.
        """
        change, truck = change.long(), truck.long()
        # where a map has no pairs of the wanted kind (one lane, say) the other kind serves
        total = self.count[tuple_index, change, truck, LONGEST_PATH]
        change = torch.where(total > 0, change, 1 - change)
        total = self.count[tuple_index, change, truck, LONGEST_PATH]
        limit = longest.long().clamp(0, LONGEST_PATH)
        count = self.count[tuple_index, change, truck, limit].clamp_min(1)
        pair = self.first[tuple_index, change, truck] + (uniform * count).long().clamp_max(count - 1)
        return torch.where(total > 0, pair, 0), total > 0


@dataclass(frozen=True)
class RegimeTable:
    """Per-tuple regime constants, each [tuples]; agent counts and P_lc before and after the switch."""

    base_speed: Tensor
    low: Tensor
    high: Tensor
    low_late: Tensor
    high_late: Tensor
    change: Tensor
    change_late: Tensor

    @staticmethod
    def of(regimes: list[Regime], scale: float, slots: int, device: torch.device | str) -> RegimeTable:
        def column(value) -> Tensor:
            return torch.tensor([float(value(r)) for r in regimes], device=device)

        def agents(value) -> Tensor:
            return (column(value) * scale).round().clamp(1, slots)

        return RegimeTable(
            base_speed=column(lambda r: r.base_speed),
            low=agents(lambda r: r.agents[0]),
            high=agents(lambda r: r.agents[1]),
            low_late=agents(lambda r: r.agents_late[0]),
            high_late=agents(lambda r: r.agents_late[1]),
            change=column(lambda r: r.lane_change_ratio),
            change_late=column(lambda r: r.lane_change_ratio_late),
        )


def sample(
    pairs: PairTable,
    regimes: RegimeTable,
    tuple_index: Tensor,
    slots: int,
    late: bool,
    config: ScenarioConfig,
    sim: SimConfig,
    braking_jerk: float,
    generator: torch.Generator,
) -> Scenario:
    """Fresh agents for the worlds of ``tuple_index`` [B] (paper: Synthetic Scenario Generation, online).

    v_init = v_base (1 + eps_init), v_goal = v_init (1 + eps_goal), alpha ~ U, where curves ask for no less;
    starts and goals from the pool, subject to collision checking; a slot whose every proposal collides, or
    is too long for the vehicle, stays empty.

    Args:
        tuple_index: [B] (map, regime) tuple of each world.
        slots: N.
        late: after the curriculum switch.
        braking_jerk: hardest braking of the action lattice in m/s^3, > 0.
    """
    device, worlds = tuple_index.device, tuple_index.shape[0]
    size = (worlds, slots)

    def uniform(low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(size, generator=generator, device=device)

    low = (regimes.low_late if late else regimes.low)[tuple_index]
    high = (regimes.high_late if late else regimes.high)[tuple_index]
    change_ratio = (regimes.change_late if late else regimes.change)[tuple_index]
    count = low + torch.floor((high - low + 1) * torch.rand(worlds, generator=generator, device=device))
    wanted = torch.arange(slots, device=device) < count.unsqueeze(-1)

    shape = sample_shape(count, slots, config, generator)
    base = regimes.base_speed[tuple_index].unsqueeze(-1)
    spread = config.init_speed_spread
    speed = (base * (1.0 + uniform(-spread, spread))).clamp(0.0, sim.max_speed)
    goal_speed = (speed * (1.0 + uniform(*config.goal_speed_bounds))).clamp(0.0, sim.max_speed)
    alpha = uniform(*config.alpha_bounds)
    time = config.horizon_share * sim.horizon * sim.dt
    longest = _way(speed, goal_speed, time)

    active = torch.zeros(size, dtype=torch.bool, device=device)
    pair = torch.zeros(size, dtype=torch.long, device=device)
    tuples = tuple_index.unsqueeze(-1).expand(size)
    astray = uniform() < config.astray if config.astray else active
    state = _state_at(pairs, pair, shape, speed, astray, generator)
    for _ in range(PLACEMENT_ROUNDS):
        change = uniform() < change_ratio.unsqueeze(-1)
        proposal, exists = pairs.draw(tuples, change, shape.truck, longest, uniform())
        begin, arrive = _slowed(pairs, proposal, shape.truck, speed, goal_speed)
        proposed = _state_at(pairs, proposal, shape, begin, astray, generator)
        trial = proposed.where(~active, state)
        accepted = (
            wanted
            & exists
            & (pairs.length[proposal] <= _way(begin, arrive, time))
            & ~active
            & ~_conflicts(shape, trial, braking_jerk * alpha, active, wanted, config)
        )
        pair = torch.where(accepted, proposal, pair)
        state = proposed.where(accepted, state)
        active = active | accepted
        if bool((active == wanted).all()):
            break
    goal_node = pairs.goal[pair]
    x, y, yaw, _ = pairs.node[goal_node].unbind(-1)
    _, goal_speed = _slowed(pairs, pair, shape.truck, speed, goal_speed)
    return Scenario(shape, state, Task(x, y, yaw, goal_speed, alpha), active, goal_node)


def _slowed(
    pairs: PairTable, pair: Tensor, truck: Tensor, speed: Tensor, goal_speed: Tensor
) -> tuple[Tensor, Tensor]:
    """The speeds at start and goal, less where the curves of a pair ask for it; trucks take them slower."""
    share = torch.where(truck, (SIDEWAYS_TRUCK / SIDEWAYS) ** 0.5, 1.0)
    return (
        torch.minimum(speed, share * pairs.start_speed[pair]),
        torch.minimum(goal_speed, share * pairs.goal_speed[pair]),
    )


def _way(speed: Tensor, goal_speed: Tensor, time: float) -> Tensor:
    """Metres driven in ``time`` s; no speeding up is counted on, since a small alpha may never do so."""
    return 0.5 * time * (speed + torch.minimum(speed, goal_speed))


def _state_at(
    pairs: PairTable,
    pair: Tensor,
    shape: VehicleShape,
    speed: Tensor,
    astray: Tensor,
    generator: torch.Generator,
) -> VehicleState:
    """Vehicles settled on the lane at the start of their pair: steering and hitch follow its curvature.

    Args:
        astray: [B, N] bool, further from the lane's centre and direction than others.
    """
    x, y, yaw, curvature = pairs.node[pairs.start[pair]].unbind(-1)
    device = x.device
    turned = ASTRAY_YAW_SIGMA * (ASTRAY_SPEED / speed.clamp_min(ASTRAY_SPEED))
    aside = torch.where(astray, ASTRAY_LATERAL_SIGMA, LATERAL_SIGMA)
    aside = aside * torch.randn(x.shape, generator=generator, device=device)
    yaw_error = torch.where(astray, turned, YAW_SIGMA)
    yaw_error = yaw_error * torch.randn(x.shape, generator=generator, device=device)
    steer = torch.atan(shape.wheelbase * curvature)
    history = (*x.shape, HISTORY)
    return VehicleState(
        x=x - aside * torch.sin(yaw),
        y=y + aside * torch.cos(yaw),
        yaw=yaw + yaw_error,
        speed=speed,
        accel=torch.zeros_like(x),
        steer=steer,
        hitch=torch.asin((shape.trailer_base * curvature).clamp(-0.9, 0.9)),
        accel_history=torch.zeros(history, device=device),
        steer_history=steer.unsqueeze(-1).expand(history).clone(),
    )


def _conflicts(
    shape: VehicleShape,
    trial: VehicleState,
    braking: Tensor,
    active: Tensor,
    wanted: Tensor,
    config: ScenarioConfig,
) -> Tensor:
    """Slots whose trial position is too close to a placed agent or to an earlier proposal.

    Each vehicle claims its boxes and the road ahead of it: a gap, a time headway, and the distance that
    it closes on a slower one while it brakes, so that no collision is unavoidable from the start. With
    jerk -J alpha the speed difference D is gone after t = sqrt(2 D / (J alpha)), and 2/3 D t is closed.

    Args:
        braking: [B, N] J alpha in m/s^3.
    """
    box = boxes(shape, trial)
    gap = config.spawn_gap + config.spawn_time_headway * trial.speed
    reach = shape.reach + gap + _closing(trial.speed, braking)
    pending = wanted & ~active
    world, slot = pending.nonzero(as_tuple=True)
    earlier = torch.arange(active.shape[1], device=active.device) < slot.unsqueeze(-1)
    against = active[world] | (pending[world] & earlier)  # [P, N] whom each of the P proposals must avoid
    distance = torch.hypot(*(c[world] - c[world, slot].unsqueeze(-1) for c in (trial.x, trial.y)))
    claims = against & (distance < reach[world, slot].unsqueeze(-1) + shape.reach[world])
    claimed = against & (distance < reach[world] + shape.reach[world, slot].unsqueeze(-1))
    (p, other), (q, claimant) = claims.nonzero(as_tuple=True), claimed.nonzero(as_tuple=True)
    # both directions in one list of pairs: who claims the road, and who might be on it
    loser = torch.cat((p, q))
    mine, theirs = torch.cat((slot[p], claimant)), torch.cat((other, slot[q]))
    world = world[loser]
    faster = (trial.speed[world, mine] - trial.speed[world, theirs]).clamp_min(0.0)
    ahead = 0.5 * (gap[world, mine] + _closing(faster, braking[world, mine]))
    x, y, cos, sin, half_length, half_width = box[:, :, world, mine].unsqueeze(2)
    claim = (x + ahead * cos, y + ahead * sin, cos, sin, half_length + ahead, half_width)
    hit = boxes_overlap(claim, box[:, :, world, theirs].unsqueeze(1)).flatten(0, 1).any(0)
    loses = torch.zeros(len(slot), dtype=torch.bool, device=active.device)
    loses[loser[hit]] = True
    conflict = torch.zeros_like(active)
    conflict[pending] = loses
    return conflict


def _closing(faster: Tensor, jerk: Tensor) -> Tensor:
    """Metres that a vehicle closes on one slower by ``faster`` m/s while it brakes with -``jerk`` m/s^3."""
    return faster * torch.sqrt(2.0 * faster / jerk) * (2.0 / 3.0)
