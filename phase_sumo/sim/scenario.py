"""Online generator: samples agents, geometry, kinematics and start-goal pairs for worlds that reset."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import Regime, ScenarioConfig, SimConfig
from phase_sumo.sim.curve_speed import SIDEWAYS, SIDEWAYS_TRUCK
from phase_sumo.sim.dimensions import mean_length, sample_shape, truck_slots
from phase_sumo.sim.pairs import PairTable
from phase_sumo.sim.placement import Placement, anywhere, conflicts, place
from phase_sumo.sim.scripted import Script
from phase_sumo.sim.vehicles import HISTORY, Task, VehicleShape, VehicleState

FULL = 0.92  # share of the lanes that vehicles and the gaps ahead of them may take
ROUNDS = 8  # proposals for a vehicle that found no room in its lane before its slot stays empty
SPEED_JITTER = 0.06  # by which the speeds of vehicles that follow each other differ, as a share
LATERAL_SIGMA = 0.15  # m, spread of the start across the lane
YAW_SIGMA = 0.01  # rad
ASTRAY_LATERAL_SIGMA, ASTRAY_YAW_SIGMA = 0.6, 0.15  # m, and rad up to ASTRAY_SPEED; faster ones less
ASTRAY_SPEED = 8.0  # m/s
LEAST_WISH = 0.6  # share of the regime's speed that target speeds come from at least, where traffic stands
HARMONIES = 4  # passes in which vehicles slow down to what they can brake for behind the one ahead
FAIR = 10.0  # m
STEADY_JERK = 1.0  # m/s^3, times alpha, with which speeding up is counted on
WORLD_KINDS = ("plain", "standing", "scripted")  # what there is in a world besides agents
PLAIN, STANDING, SCRIPTED = range(3)


@dataclass
class Scenario:
    """Fresh agents for B worlds; axes B x N.

    Attributes:
        active: [B, N] bool, slots that hold a vehicle.
        goal_node: [B, N] node of each goal in the pair table.
        script: of the vehicles among them that no policy drives.
        desired_speed: [B, N] m/s that target speeds return to where goals roll on.
        rolling: [B] bool, agents at their goal get the next one.
        kind: [B] `PLAIN`, `STANDING` or `SCRIPTED`.
    """

    shape: VehicleShape
    state: VehicleState
    task: Task
    active: Tensor
    goal_node: Tensor
    script: Script
    desired_speed: Tensor
    rolling: Tensor
    kind: Tensor


@dataclass(frozen=True)
class RegimeTable:
    """Per-tuple regime constants, each [tuples]; agent counts and P_lc before and after the switch."""

    base_speed: Tensor
    spread: Tensor
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
            spread=column(lambda r: r.spread),
            low=agents(lambda r: r.agents[0]),
            high=agents(lambda r: r.agents[1]),
            low_late=agents(lambda r: r.agents_late[0]),
            high_late=agents(lambda r: r.agents_late[1]),
            change=column(lambda r: r.lane_change_ratio),
            change_late=column(lambda r: r.lane_change_ratio_late),
        )


def capacity(pairs: PairTable, regimes: RegimeTable, config: ScenarioConfig) -> Tensor:
    """[tuples] vehicles that the lanes of a (map, regime) tuple hold at the lowest speed and least gaps."""
    slowest = regimes.base_speed * (1.0 - regimes.spread)
    room = mean_length(config) + config.least_gap + config.least_time_gap * slowest
    return torch.floor(FULL * pairs.lines.length.float() / room)


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

    v_init = v_base (1 + eps_init) is the speed of the world's traffic, from which single vehicles differ by
    `SPEED_JITTER`; v_goal = v_init (1 + eps_goal), alpha ~ U; less where curves or the vehicle ahead ask for
    it. Worlds hold as many vehicles as their regime asks for, up to `capacity`: gaps shrink, then speeds.

    Args:
        tuple_index: [B] (map, regime) tuple of each world.
        slots: N.
        late: after the curriculum switch.
        braking_jerk: hardest braking of the action lattice in m/s^3, > 0.
    """
    device, worlds = tuple_index.device, tuple_index.shape[0]
    size = (worlds, slots)

    def uniform(low: float = 0.0, high: float = 1.0, of: tuple[int, ...] = size) -> Tensor:
        return low + (high - low) * torch.rand(of, generator=generator, device=device)

    low = (regimes.low_late if late else regimes.low)[tuple_index]
    high = (regimes.high_late if late else regimes.high)[tuple_index]
    count = low + torch.floor((high - low + 1) * uniform(of=(worlds,)))
    count = torch.minimum(count, capacity(pairs, regimes, config)[tuple_index])
    wanted = torch.arange(slots, device=device) < count.unsqueeze(-1)
    shape = sample_shape(count, pairs.lines.truck_count[tuple_index] > 0, slots, config, generator)

    base, spread = (v[tuple_index].unsqueeze(-1) for v in (regimes.base_speed, regimes.spread))
    speed = base * (1.0 + spread * uniform(-1.0, 1.0, (worlds, 1)))
    speed = speed * (1.0 + SPEED_JITTER * uniform(-1.0, 1.0))
    speed = speed.clamp(base * (1.0 - spread), base * (1.0 + spread)).clamp_max(sim.max_speed)
    alpha = uniform(*config.alpha_bounds)
    rolling = uniform(of=(worlds,)) < config.rolling_worlds
    quicker = 1.0 + uniform(*config.goal_speed_bounds)
    quicker = torch.where(rolling.unsqueeze(-1), uniform(*config.rolling_speed), quicker)
    script, kind = _script(wanted, speed, config, uniform)
    speed = torch.where(script.scripted, torch.minimum(speed, script.cruise), speed)

    behind = shape.rear_reach
    length = behind + shape.front_overhang
    room = FULL * pairs.lines.length[tuple_index].float().unsqueeze(-1)
    speed, gap = _packed(wanted, length, speed, base * (1.0 - spread), room, config, uniform)
    found = place(pairs.lines, tuple_index, wanted, shape.truck, behind, length, gap, generator)
    wish = torch.maximum(speed, LEAST_WISH * base)
    in_curves = of_trucks(shape.truck) * pairs.curve_speed[pairs.lines.node[found.point]]
    speed = _harmonious(found, torch.minimum(speed, in_curves), braking_jerk * alpha)
    change_ratio = (regimes.change_late if late else regimes.change)[tuple_index].unsqueeze(-1)
    time = config.horizon_share * sim.horizon * sim.dt
    astray = uniform() < config.astray if config.astray else torch.zeros_like(wanted)

    active = torch.zeros(size, dtype=torch.bool, device=device)
    pair = torch.zeros(size, dtype=torch.long, device=device)
    node = pairs.lines.node[found.point]
    goal_speed = (wish * quicker).clamp(0.0, sim.max_speed)
    arrive = goal_speed
    state = _state_at(pairs, node, shape, speed, astray, generator)
    for round_ in range(1 + ROUNDS):
        if round_:
            anew = pairs.lines.node[anywhere(pairs.lines, tuple_index, shape.truck, generator)]
            node = torch.where(active, node, anew)
        longest = _way(speed, goal_speed, alpha, time)
        proposal, exists = pairs.draw(node, uniform() < change_ratio, shape.truck, longest, uniform())
        begin, end = _slowed(pairs, proposal, node, shape.truck, speed, goal_speed)
        begin = torch.where(script.scripted, torch.minimum(begin, script.cruise), begin)
        proposed = _state_at(pairs, node, shape, begin, astray & ~script.scripted, generator)
        trial = proposed.where(~active, state)
        fits = exists & (pairs.length[proposal] <= _way(begin, end, alpha, time))
        accepted = wanted & ~active & (fits | script.scripted)
        accepted &= found.placed if round_ == 0 else True
        claims = 0.5 * gap if round_ == 0 else gap
        accepted &= ~conflicts(shape, trial, braking_jerk * alpha, claims, active, accepted)
        pair = torch.where(accepted, proposal, pair)
        arrive = torch.where(accepted, end, arrive)
        state = proposed.where(accepted, state)
        active = active | accepted
        if bool((active == wanted).all()):
            break
    goal_node = pairs.goal[pair]
    x, y, yaw, _ = pairs.node[goal_node].unbind(-1)
    script.node = node
    task = Task(x, y, yaw, arrive, alpha)
    return Scenario(shape, state, task, active, goal_node, script, goal_speed, rolling, kind)


def _script(
    wanted: Tensor, speed: Tensor, config: ScenarioConfig, uniform: Callable[..., Tensor]
) -> tuple[Script, Tensor]:
    """Which of the vehicles ``wanted`` [B, N] stand or follow a script, and the kind [B] of each world.

    They take the slots behind those of the trucks, so they are cars wherever there are that many vehicles.
    """
    settings, size = config.script, wanted.shape
    script, world = Script.nobody(wanted), (size[0], 1)
    draw = uniform(of=world)
    kind = torch.where(draw < settings.standing_worlds, STANDING, PLAIN)
    kind = torch.where(
        (draw >= settings.standing_worlds) & (draw < settings.standing_worlds + settings.scripted_worlds),
        SCRIPTED,
        kind,
    )
    begin, most = script_slots(size[1], config)
    slot = torch.arange(size[1], device=wanted.device)
    many = torch.where(kind == STANDING, min(settings.most_standing, most), most)
    many = torch.floor(1.0 + many * uniform(of=world)) * (kind != PLAIN)
    script.scripted = (
        wanted & (slot >= begin) & (slot < begin + torch.minimum(many, torch.tensor(float(most))))
    )
    script.cruise = torch.where(kind == STANDING, 0.0, speed)
    brakes = (uniform() < 0.5) & (kind == SCRIPTED)
    script.brake = uniform(*settings.brake)
    script.brake_from = torch.where(brakes, uniform(*settings.brake_from), torch.inf)
    script.brake_until = script.brake_from + uniform(*settings.brake_for)
    return script, kind.squeeze(-1)


def script_slots(slots: int, config: ScenarioConfig) -> tuple[int, int]:
    """The first slot that scripted vehicles may take, and how many they are at most."""
    begin = truck_slots(slots, config)
    return begin, min(math.ceil(config.script.slots * slots), slots - begin)


def _packed(
    wanted: Tensor,
    length: Tensor,
    speed: Tensor,
    slowest: Tensor,
    room: Tensor,
    config: ScenarioConfig,
    uniform: Callable[..., Tensor],
) -> tuple[Tensor, Tensor]:
    """Speeds and gaps [B, N] with which the vehicles ``wanted`` fit into ``room`` [B, 1] m of lane.

    The gap is s0 + T v. Where there is no room for it T shrinks, down to the least time gap, and then v.

    Args:
        length: [B, N] m.
        slowest: [B, 1] m/s.
    """
    time_gap = uniform(*config.time_gap, (len(wanted), 1)) * uniform(0.7, 1.3)
    left = room - (wanted * (length + config.least_gap)).sum(-1, keepdim=True)

    def share(need: Tensor) -> Tensor:
        return (left / (wanted * need).sum(-1, keepdim=True).clamp_min(1e-3)).clamp(0.0, 1.0)

    time_gap = (time_gap * share(time_gap * speed)).clamp_min(config.least_time_gap)
    slower = speed * share(time_gap * speed)
    speed = torch.minimum(speed, torch.maximum(slower, slowest))
    return speed, config.least_gap + time_gap * speed


def _harmonious(found: Placement, speed: Tensor, jerk: Tensor) -> Tensor:
    """Speeds [B, N] from which vehicles can brake behind the one ahead, with -``jerk`` m/s^3.

    A difference D is gone after t = sqrt(2 D / J) and closes 2/3 D t, so a gap s allows for
    D = (3/2 s)^(2/3) (J / 2)^(1/3).
    """
    allowed = (1.5 * (found.gap - 1.0).clamp(0.0, 1e4)).pow(2.0 / 3.0) * (0.5 * jerk).pow(1.0 / 3.0)
    follows = found.leader >= 0
    for _ in range(HARMONIES):
        leader = speed.gather(-1, found.leader.clamp_min(0))
        speed = torch.where(follows, torch.minimum(speed, leader + allowed), speed)
    return speed


def _slowed(
    pairs: PairTable, pair: Tensor, node: Tensor, truck: Tensor, speed: Tensor, goal_speed: Tensor
) -> tuple[Tensor, Tensor]:
    """The speeds at a start ``node`` and at the goal of a pair, less where curves ask for it.

    Trucks take them slower. The node lies at the pair's own start or up to some metres before it.
    """
    share = of_trucks(truck)
    return (
        torch.minimum(speed, share * torch.minimum(pairs.start_speed[pair], pairs.curve_speed[node])),
        torch.minimum(goal_speed, share * pairs.goal_speed[pair]),
    )


def of_trucks(truck: Tensor) -> Tensor:
    """Share of a car's speed in a curve."""
    return torch.where(truck, (SIDEWAYS_TRUCK / SIDEWAYS) ** 0.5, 1.0)


def _way(speed: Tensor, goal_speed: Tensor, alpha: Tensor, time: float) -> Tensor:
    """Metres driven in ``time`` s from one speed to the other, which takes long with a small alpha.

    Anybody can be asked to come `FAIR` metres.
    """
    gain = torch.minimum(goal_speed - speed, 0.5 * STEADY_JERK * alpha * time**2)
    return (time * (speed + torch.where(gain > 0, gain / 3.0, 0.5 * gain))).clamp_min(FAIR)


def _state_at(
    pairs: PairTable,
    node: Tensor,
    shape: VehicleShape,
    speed: Tensor,
    astray: Tensor,
    generator: torch.Generator,
) -> VehicleState:
    """Vehicles settled on the lane at their node [B, N]: steering and hitch follow its curvature.

    Args:
        astray: [B, N] bool, further from the lane's centre and direction than others.
    """
    x, y, yaw, curvature = pairs.node[node].unbind(-1)
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
