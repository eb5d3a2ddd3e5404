"""How far a vehicle would be short of safety after an action: towards others, the road's edge and curves.

A shortage is in metres that are missing ahead when the vehicle brakes as hard as it can from the next step
on, running along its lane (`fallback`); what is missing sideways counts many times. 0 is safe.
"""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

from phase_sumo.config import GuardConfig, SimConfig
from phase_sumo.sim.fallback import LOOKED_AT, Motion, braking, braking_of_others, limits, straighten, sweep
from phase_sumo.sim.kinematics import bounded_accel
from phase_sumo.sim.path import Sight, road_between
from phase_sumo.sim.surroundings import LATER, Contacts, Surroundings

INTO_SOMEBODY, OFF_ROAD = 100.0, 20.0  # m too near to a leader that 1 m sideways is set against, choice
TOWARDS = 0.02  # m by which an action is nearer to somebody than running along the lane
HALF_LANE = 1.7  # m, of a narrow lane: corners within it are not near the road's edge
TURN = 0.5  # s that it takes at most to run along the lane again, roughly
EDGE_AHEAD = (1.2, 12.0)  # s and m at least, along which the road's edges are looked at


class Reason(IntEnum):
    """Why a wanted action is not taken; of several, the last."""

    NONE = 0
    ROAD_EDGE = 1  # or a curve that could not be driven
    BESIDE = 2  # somebody is there, comes from behind, or comes together with me
    LEADER = 3
    STANDING = 4  # a leader that stands


class _Tally:
    """The largest shortages of every kind and the last reasons of R vehicles for J jerks x C steering rates.

    Kinds add up, so that of actions that are equally bad sideways those that brake harder are less bad.
    """

    def __init__(self, count: int, jerks: int, rates: int) -> None:
        self.size = count, jerks, rates
        self.shortage = torch.zeros(count, jerks, rates)
        self.reason = torch.zeros(count, jerks * rates, dtype=torch.long)

    def add(self, row: Tensor, shortage: Tensor, reason: Tensor) -> None:
        """Shortages [E, J or 1, C or 1] of one kind of vehicles ``row`` [E] for reasons [E]."""
        shortage = shortage.clamp_min(0.0).expand(-1, *self.size[1:]).flatten(1)
        reason = reason.unsqueeze(1) * (shortage > 0.0)
        row = row.unsqueeze(1).expand_as(shortage)
        worst = torch.zeros_like(self.reason, dtype=torch.float32)
        self.shortage += worst.scatter_reduce_(0, row, shortage, "amax").view(self.size)
        self.reason.scatter_reduce_(0, row, reason, "amax")


def edges_beside(motion: Motion, sight: Sight) -> Tensor:
    """[2, R] d of the road's right and left edge along vehicles' lanes, as far as they must look."""
    seconds, least = EDGE_AHEAD
    ahead = (seconds * motion.state.speed).clamp_min(least)
    return torch.stack(road_between(sight, motion.path, motion.s, ahead))


def reach_aside(motion: Motion, rate: Tensor, sim: SimConfig) -> Tensor:
    """m by which corners of vehicles [R] may soon be farther aside than now, with steering rates [R]."""
    shape, state = motion.shape, motion.state
    curvature = motion.path.curvature_at(motion.s.unsqueeze(1)).squeeze(1)
    bend = ((state.steer + rate * sim.dt) / shape.wheelbase - curvature).abs()
    askew = motion.askew.abs() + bend * state.speed * TURN
    ahead = state.speed * TURN + shape.front_overhang
    behind = shape.trailer_length * (state.hitch.abs() + motion.askew.abs())
    return torch.maximum(askew * ahead, behind)


def near_edge(motion: Motion, sight: Sight, aside: Tensor, config: GuardConfig) -> Tensor:
    """Whether vehicles [R] may come near the road's edge, reaching ``aside`` [R] m."""
    half = 0.5 * torch.maximum(motion.shape.width, motion.shape.trailer_width)
    out = (motion.d.abs() + half + aside > HALF_LANE).nonzero().squeeze(1)
    right, left = edges_beside(motion.take(out), sight.take(out))
    d, half = motion.d[out], (half + aside)[out]
    near = torch.zeros_like(aside, dtype=torch.bool)
    near[out] = torch.maximum(d + half - left, right - d + half) > -config.approach_edge
    return near


def near_others(c: Contacts, aside: Tensor, config: GuardConfig) -> Tensor:
    """Whether those of contacts [E] may come near, if the vehicles [R] themselves reach ``aside`` m."""
    drift = c.sideways.abs()
    drift = drift * torch.where(drift > config.wobble, config.crossing, config.drift)
    room = aside[c.row] + torch.maximum(drift, c.shift.abs().amax(1)) + config.approach
    return c.apart < room


def too_fast(motion: Motion, jerk: Tensor, sim: SimConfig, config: GuardConfig) -> Tensor:
    """[R, J] m that are missing to brake to the speeds at which the curves ahead can be driven.

    From v with an acceleration a the way to a curve driven at v_c = sqrt(grip / curvature) is
    (v^2 - v_c^2) / 2 b + v ((a + b) / 2 J + dt) at most, b and J being the hardest braking and its build-up.
    """
    shape, state = motion.shape, motion.state
    grip = torch.where(shape.truck, sim.truck_lateral_accel, sim.lateral_accel).unsqueeze(1)
    squared = config.grip * grip / motion.path.curvature.abs().clamp_min(1e-4)  # [R, P]
    b, build_up = (v.unsqueeze(1) for v in limits(shape.truck, sim, config))
    accel = state.accel.unsqueeze(1) + jerk * sim.dt
    accel = bounded_accel(accel, shape.map(lambda v: v.unsqueeze(1)), sim)
    speed = (state.speed.unsqueeze(1) + accel * sim.dt).clamp_min(0.0)
    late = speed * (0.5 * (accel + b).clamp_min(0.0) / build_up + sim.dt)
    braked = (speed.square().unsqueeze(2) - squared.unsqueeze(1)) / (2.0 * b.unsqueeze(2))
    way = (motion.path.s - motion.s.unsqueeze(1)).clamp_min(0.0).unsqueeze(1)
    missing = torch.where(braked > 0.0, braked + late.unsqueeze(2) - way, 0.0)
    return missing.amax(2).clamp_min(0.0)


def judge(
    around: Surroundings, edges: Tensor, jerk: Tensor, rate: Tensor, sim: SimConfig, config: GuardConfig
) -> tuple[Tensor, Tensor]:
    """Shortages and reasons [R, J, C] for jerks [R, J] x steering rates [R, C].

    Args:
        edges: [2, R] of `edges_beside`.
    """
    motion, c = around.motion, around.contacts
    tally = _Tally(len(jerk), jerk.shape[1], rate.shape[1])
    speed, moved = braking(motion.shape, motion.state, jerk, sim, config)
    steady = jerk.shape[1] // 3  # on our lattice, the jerk that is 0
    tried = torch.cat((rate, straighten(motion, sim, config)), 1)
    low, high = sweep(motion, around.pieces, speed[:, steady], tried, sim, config)  # [Q, C + 1]

    every = torch.arange(len(jerk))
    edge = torch.full_like(every, Reason.ROAD_EDGE)
    tally.add(every, too_fast(motion, jerk, sim, config).unsqueeze(2), edge)
    right, left = edges[:, around.pieces.row].unsqueeze(2)
    off = torch.maximum(high - left, right - low)
    # on roads that are narrower than they look from afar, to run along the lane is never wrong
    off = off[:, :-1] - off[:, -1:].clamp_min(-config.approach_edge)
    tally.add(around.pieces.row, OFF_ROAD * off.unsqueeze(1), edge[around.pieces.row])

    low, high = low[c.mine], high[c.mine]
    over = _overlap(c, low, high, config)
    over, along = over[:, :-1], over[:, -1:]  # [E, C] and [E, 1]
    nearer = over - along.clamp(-config.approach, 0.0)
    beside = ((c.gap < 0.0) & (nearer > 0.0).any(1)).nonzero().squeeze(1)
    side = INTO_SOMEBODY * nearer[beside].unsqueeze(1)
    tally.add(c.row[beside], side, torch.full_like(beside, Reason.BESIDE))

    close = torch.where(over > along + TOWARDS, config.approach, config.aside)
    meet = torch.where(over > -close, 0.0, _later(c, low[:, :-1], high[:, :-1], config))  # [E, C]
    _leaders(tally, around, moved, meet, over, sim, config)
    _giving_way(tally, around, moved, torch.where((meet > 0.0) | (along > 0.0), meet, torch.inf), sim, config)
    return tally.shortage, tally.reason.view(tally.size)


def _overlap(c: Contacts, low: Tensor, high: Tensor, config: GuardConfig) -> Tensor:
    """[E, C] m by which my strips and those of the others overlap, who go on sideways as now for a while."""
    drift = c.sideways * config.drift
    theirs_low, theirs_high = c.low + drift.clamp_max(0.0), c.high + drift.clamp_min(0.0)
    return torch.minimum(high - theirs_low.unsqueeze(1), theirs_high.unsqueeze(1) - low)


def _later(c: Contacts, low: Tensor, high: Tensor, config: GuardConfig) -> Tensor:
    """[E, C] s until the other is in my strip, of `LATER`, where its lane leads it or as it moves now.

    Nobody keeps to the middle of the lane exactly: slow movement sideways is not taken to go on.
    """
    going = torch.where(c.sideways.abs().unsqueeze(1) > config.wobble, c.going, 0.0)
    meet = torch.full_like(low, torch.inf)
    for k in reversed(range(len(LATER))):
        moved = going[:, k]
        theirs_low = (c.low + torch.minimum(c.shift[:, k], moved)).unsqueeze(1)
        theirs_high = (c.high + torch.maximum(c.shift[:, k], moved)).unsqueeze(1)
        meet = torch.where((theirs_low < high) & (theirs_high > low), LATER[k], meet)
    return meet


def _leaders(
    tally: _Tally,
    around: Surroundings,
    moved: Tensor,
    meet: Tensor,
    over: Tensor,
    sim: SimConfig,
    config: GuardConfig,
) -> None:
    """Those ahead who brake as hard as they can: from ``meet`` [E, C] on I must not reach them.

    If I shall, the less the strips overlap the better.
    """
    c, times = around.contacts, torch.tensor(LOOKED_AT) * sim.dt
    k = ((c.gap >= 0.0) & meet.isfinite().any(1)).nonzero().squeeze(1)
    others, state = c.other[k], around.state
    way = braking_of_others(around.shape.truck[others], state.speed[others], state.accel[others], sim, config)
    missing = moved[c.row[k]] - (c.gap[k].unsqueeze(1) - config.gap + way).unsqueeze(1)
    missing = _from(missing, times, meet[k])
    missing = torch.where(missing > 0.0, missing + over[k].clamp_min(0.0).unsqueeze(1), 0.0)
    tally.add(c.row[k], missing, torch.where(c.standing[k], Reason.STANDING, Reason.LEADER))


def _giving_way(
    tally: _Tally, around: Surroundings, moved: Tensor, meet: Tensor, sim: SimConfig, config: GuardConfig
) -> None:
    """Those beside with whom I come together, and whose front is ahead of mine: then I must be behind.

    They are expected to go on braking as they do, and not to speed up.
    """
    c, times = around.contacts, torch.tensor(LOOKED_AT) * sim.dt
    k = ((c.room < 0.0) & c.leads & meet.isfinite().any(1)).nonzero().squeeze(1)
    speed = around.state.speed[c.other[k]].unsqueeze(1)
    accel = around.state.accel[c.other[k]].clamp_max(-1e-3).unsqueeze(1)
    until = torch.minimum(times, -speed / accel)
    way = (speed + 0.5 * accel * until) * until
    missing = moved[c.row[k]] - (c.room[k].unsqueeze(1) + way).unsqueeze(1)
    tally.add(c.row[k], _from(missing, times, meet[k]), torch.full_like(k, Reason.BESIDE))


def _from(missing: Tensor, times: Tensor, meet: Tensor) -> Tensor:
    """[E, J, C] the most of [E, J, T] from ``meet`` [E, C] s on, 0 where that is never."""
    onwards = missing.flip(2).cummax(2).values.flip(2)
    first = torch.searchsorted(times, meet.contiguous()).clamp_max(len(times) - 1)
    most = onwards.gather(2, first.unsqueeze(1).expand(-1, missing.shape[1], -1))
    return torch.where(meet.isfinite().unsqueeze(1), most, 0.0)
