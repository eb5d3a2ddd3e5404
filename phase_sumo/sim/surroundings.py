"""Whom a guarded vehicle may come across, as boxes along and beside its path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from phase_sumo.config import GuardConfig, SimConfig
from phase_sumo.sim.fallback import Motion, Pieces, braking, braking_of_others, limits
from phase_sumo.sim.geometry import wrap_angle
from phase_sumo.sim.path import Path, Sight
from phase_sumo.sim.vehicles import TensorBatch, VehicleShape, VehicleState

STANDING = 0.5  # m/s, at most
CROSSWISE = 0.5  # cosine of the direction relative to the path: less counts as standing
LATER = (1.25, 2.5)  # s, when it is looked whether lanes have come together
UNSURE = 0.3  # m, how well the far road is known sideways
# Who is certainly out of reach is not looked at:
MOST_ACCEL = 4.0  # m/s^2
NEAREST = 1.5  # m
SIDE_ROOM = 1.0  # m sideways within a step and a fallback, and what is covered sideways in 1 s
LANES_BESIDE, BENT = 6.0, 0.02  # m sideways of the vehicle's direction, and in bends 1/m
SAME_LANE = 0.8  # m sideways up to which those behind follow in the same lane


@dataclass
class Contacts(TensorBatch):
    """Pairs of a piece of a vehicle and a piece of another that may get in each other's way, all [E].

    Those ahead are here if the vehicle may be unable to stop behind them, those behind if they may be unable
    to stop behind it and do not follow it yet.

    Attributes:
        row: the vehicle.
        mine: the piece of it.
        other: number of the other vehicle.
        gap: m along the path from my front to its rear, below 0 where it is not ahead.
        room: the same to the rear of the whole other vehicle.
        apart: m between the boxes sideways now, below 0 where they overlap.
        low, high: the strip of road that the other covers now, m.
        sideways: m/s at which it moves to the left of the path.
        shift: [E, 2] m to the left that the strip will have moved after `LATER`, if both keep their lanes.
        going: [E, 2] m to the left that it moves until `LATER` if it keeps its direction.
        leads: the front of the other is ahead of mine.
        standing: the other stands.
    """

    row: Tensor
    mine: Tensor
    other: Tensor
    gap: Tensor
    room: Tensor
    apart: Tensor
    low: Tensor
    high: Tensor
    sideways: Tensor
    shift: Tensor
    going: Tensor
    leads: Tensor
    standing: Tensor


@dataclass
class Surroundings:
    """Everything that the choice of R vehicles among M depends on.

    Attributes:
        shape, state: [M] of everybody.
        rows: [R] the vehicles that choose.
        motion: of those.
        pieces: [Q] of those.
        contacts: [E] pairs of their pieces and those of others.
    """

    shape: VehicleShape
    state: VehicleState
    rows: Tensor
    motion: Motion
    pieces: Pieces
    contacts: Contacts

    def take(self, index: Tensor) -> Surroundings:
        """Of some of the R vehicles alone."""
        number = torch.full((len(self.rows),), -1)
        number[index] = torch.arange(len(index))
        row, own = number[self.contacts.row], number[self.pieces.row]
        kept, mine = (row >= 0).nonzero().squeeze(1), (own >= 0).nonzero().squeeze(1)
        contacts, pieces = self.contacts.take(kept), self.pieces.take(mine)
        contacts = replace(contacts, row=row[kept], mine=((own >= 0).cumsum(0) - 1)[contacts.mine])
        pieces = replace(pieces, row=own[mine])
        return Surroundings(
            self.shape, self.state, self.rows[index], self.motion.take(index), pieces, contacts
        )

    def among(self, some: Tensor) -> Surroundings:
        """With ``some`` [E] of the contacts alone."""
        return replace(self, contacts=self.contacts.take(some.nonzero().squeeze(1)))


def surroundings(
    shape: VehicleShape,
    state: VehicleState,
    rows: Tensor,
    motion: Motion,
    near: tuple[Tensor, Tensor],
    sight: Sight,
    sim: SimConfig,
    config: GuardConfig,
) -> Surroundings:
    """See `guard.guarded` for the arguments; ``motion`` is of the ``rows``, ``near`` as of `near_pairs`."""
    now, path, askew = motion.state, motion.path, motion.askew
    pieces = Pieces.of(motion.shape, torch.arange(len(rows)))
    own_rear, own_front, own_low, own_high, _ = _extent(pieces, now, pieces.row, path.take(pieces.row))

    row, other = near
    theirs = Pieces.of(shape, other)
    pairs, row, other = len(row), row[theirs.row], other[theirs.row]
    rear, front, low, high, turn = _extent(theirs, state, other, path.take(row))
    sideways = state.speed[other] * torch.sin(turn)
    whole = torch.full((pairs,), torch.inf).scatter_reduce_(0, theirs.row, rear, "amin")[theirs.row]
    room = SIDE_ROOM + now.speed * torch.sin(askew).abs()
    room = room[row] + sideways.abs() * LATER[-1]

    e, mine = _every_pair(row, pieces.row, len(rows))
    apart = torch.maximum(low[e] - own_high[mine], own_low[mine] - high[e])
    gap, gap_behind = rear[e] - own_front[mine], own_rear[mine] - front[e]
    # whose nose is past another's tail, but askew and not beside it yet, is behind it still
    level = (gap < 0.0) & (apart <= 0.0) & (rear[e] + front[e] > own_rear[mine] + own_front[mine])
    gap = torch.where(level, 0.0, gap)
    # who overlaps sideways and is not ahead has to look out itself
    keep = ((apart < room[e]) & ((gap >= 0.0) | (apart > 0.0))).nonzero().squeeze(1)
    e, mine, apart, gap, gap_behind = (v[keep] for v in (e, mine, apart, gap, gap_behind))
    me, ahead = rows[row[e]], gap >= 0.0
    leader, follower = torch.where(ahead, other[e], me), torch.where(ahead, me, other[e])
    between = torch.maximum(gap, gap_behind)
    keep = (
        ((between < 0.0) | _short(shape, state, leader, follower, between, sim, config)).nonzero().squeeze(1)
    )
    e, mine, apart, gap = (v[keep] for v in (e, mine, apart, gap))
    row, other = row[e], other[e]
    mine_lane, lane, x, y = path.take(row), Path.ahead(sight.take(other)), state.x[other], state.y[other]
    lane_s, lane_d, _ = lane.locate(x, y)
    speed, accel = state.speed[other], state.accel[other]
    later = [lane.at(lane_s + _way(speed, accel, t), lane_d) for t in (0.0, *LATER)]
    aside = torch.stack([mine_lane.locate(x, y)[1] for x, y in later], 1)
    shift = aside[:, 1:] - aside[:, :1]
    shift = shift - shift.clamp(-UNSURE, UNSURE)
    going = [torch.sin(turn[e]) * _way(speed, accel, min(t, config.crossing)) for t in LATER]
    contacts = Contacts(
        row=row,
        mine=mine,
        other=other,
        gap=gap,
        room=whole[e] - own_front[mine],
        apart=apart,
        low=low[e],
        high=high[e],
        sideways=sideways[e],
        shift=shift,
        going=torch.stack(going, 1),
        leads=_leads(shape, state, rows[row], other),
        standing=(state.speed[other] < STANDING) | (torch.cos(turn[e]) < CROSSWISE),
    )
    return Surroundings(shape, state, rows, motion, pieces, contacts)


def _way(speed: Tensor, accel: Tensor, seconds: float) -> Tensor:
    """m driven in some s by others who go on braking, if they brake now, and never speed up.

    Who slows down for a line or a gap, as at the end of a ramp, stops there.
    """
    braking = (-accel).clamp_min(1e-3)
    until = torch.minimum(speed / braking, torch.full_like(speed, seconds))
    return speed * until - 0.5 * braking * until.square()


def near_pairs(
    shape: VehicleShape,
    state: VehicleState,
    rows: Tensor,
    index: Tensor,
    mask: Tensor,
    sim: SimConfig,
    config: GuardConfig,
) -> tuple[Tensor, Tensor]:
    """Pairs of a vehicle (its place in ``rows``) and another that may have to brake for one another.

    Whoever is not among them is too far ahead or behind, whichever the lane: see `_closer`.
    """
    b, build_up = limits(shape.truck, sim, config)
    theirs = torch.where(shape.truck, config.others_braking[1], config.others_braking[0])
    # the step that is decided on, and until the brakes hold if the vehicle speeds up until then
    lost = (MOST_ACCEL + b) / (2.0 * build_up) + 1.5 * sim.dt
    rear = torch.where(shape.articulated, shape.reach, shape.rear_overhang)
    columns = (state.x, state.y, state.speed, shape.front_overhang, rear, b, theirs, lost)
    table = torch.stack(columns).T
    x, y, speed, front, rear, b, theirs, lost = table[index].unbind(2)
    own_x, own_y, own_speed, own_front, own_rear, own_b, own_theirs, own_lost = table[rows].T.unsqueeze(2)
    cos, sin = torch.cos(state.yaw[rows]).unsqueeze(1), torch.sin(state.yaw[rows]).unsqueeze(1)
    dx, dy = x - own_x, y - own_y
    u, w = dx * cos + dy * sin, (dy * cos - dx * sin).abs()
    ahead = _closer(own_speed, own_b, speed, theirs) + own_lost * own_speed + own_front + rear
    behind = _closer(speed, b, own_speed, own_theirs) + lost * speed + front + own_rear
    near = mask & (u < ahead + NEAREST) & (u > -behind - NEAREST) & (w < LANES_BESIDE + BENT * u.square())
    near &= (u > 0.0) | (w > SAME_LANE)
    row, k = near.nonzero(as_tuple=True)
    return row, index[row, k]


def _closer(speed: Tensor, b: Tensor, lead_speed: Tensor, lead_b: Tensor) -> Tensor:
    """m by which a follower comes nearer at most if both brake, with b and lead_b m/s^2, from now on.

    When both stand, v^2 / 2 b - v_l^2 / 2 b_l; or, if it brakes harder, when it is no longer faster,
    (v - v_l)^2 / 2 (b - b_l).
    """
    standing = speed.square() / (2.0 * b) - lead_speed.square() / (2.0 * lead_b)
    harder = (b - lead_b).clamp_min(1e-3)
    alike = torch.where(b > lead_b, (speed - lead_speed).clamp_min(0.0).square() / (2.0 * harder), 0.0)
    return torch.maximum(standing.clamp_min(0.0), alike)


def _short(
    shape: VehicleShape,
    state: VehicleState,
    leader: Tensor,
    follower: Tensor,
    gap: Tensor,
    sim: SimConfig,
    config: GuardConfig,
) -> Tensor:
    """Whether followers [E] that speed up for one more step may be unable to stop behind leaders [E]."""
    speeding = torch.full((len(state.speed), 1), config.followers_jerk)
    late = braking(shape, state, speeding, sim, config)[1].squeeze(1)
    early = braking_of_others(shape.truck, state.speed, state.accel, sim, config)
    closer = late.index_select(0, follower) - early.index_select(0, leader)
    return closer.amax(1) > gap - config.gap


def _leads(shape: VehicleShape, state: VehicleState, me: Tensor, other: Tensor) -> Tensor:
    """Whether the fronts of vehicles ``other`` [E] are ahead of those of ``me`` [E]."""
    dx, dy, yaw = state.x[other] - state.x[me], state.y[other] - state.y[me], state.yaw[me]
    front = shape.front_overhang
    return dx * torch.cos(yaw) + dy * torch.sin(yaw) + front[other] > front[me]


def _every_pair(row: Tensor, mine: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """All pairs of others [O] with pieces [Q] of the same vehicle, given the vehicle of either."""
    each = torch.bincount(mine, minlength=count)
    order, first = torch.argsort(mine, stable=True), each.cumsum(0) - each
    each = each[row]
    other = torch.repeat_interleave(torch.arange(len(row)), each)
    rank = torch.arange(len(other)) - (each.cumsum(0) - each)[other]
    return other, order[first[row][other] + rank]


def _extent(
    pieces: Pieces, state: VehicleState, of: Tensor, path: Path
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Where pieces [Q] of vehicles ``of`` [Q] lie on paths [Q]: range of s, range of d, yaw to the path."""
    yaw = state.yaw[of] - torch.where(pieces.towed, state.hitch[of], 0.0)
    ahead, half_length = 0.5 * (pieces.front + pieces.back), 0.5 * (pieces.front - pieces.back)
    half_width = 0.5 * pieces.width
    s, d, along_path = path.locate(state.x[of] + ahead * torch.cos(yaw), state.y[of] + ahead * torch.sin(yaw))
    turn = wrap_angle(yaw - along_path)
    cos, sin = torch.cos(turn).abs(), torch.sin(turn).abs()
    along, across = half_length * cos + half_width * sin, half_length * sin + half_width * cos
    return s - along, s + along, d - across, d + across, turn
