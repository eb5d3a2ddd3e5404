"""Places vehicles on lanes: as many as are asked for, in an order drawn at random, with gaps to one another.

Every vehicle draws a place along the lanes (`pairs.Lines`); then all move by as little as makes room for each
of them and the gap ahead of it. So lanes fill up as in jams, where random places one by one fill three
quarters at most (Renyi's parking constant), and far less with trucks.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.pairs import Lines
from phase_sumo.sim.vehicles import VehicleShape, VehicleState, boxes

PASSES = 6  # of making room
TOUCH = 1e-3  # m


@dataclass
class Placement:
    """Where vehicles stand on the axis of the lanes, [B, N].

    Attributes:
        point: of their reference point, an index into `Lines`.
        placed: bool, there was room.
        leader: slot of the vehicle ahead on the same chain of lanes, -1 for none.
        gap: bumper to bumper to it in m.
    """

    point: Tensor
    placed: Tensor
    leader: Tensor
    gap: Tensor


def place(
    lines: Lines,
    tuple_index: Tensor,
    wanted: Tensor,
    truck: Tensor,
    behind: Tensor,
    length: Tensor,
    gap: Tensor,
    generator: torch.Generator,
) -> Placement:
    """Places for the vehicles ``wanted`` [B, N] of each world.

    Args:
        tuple_index: [B] (map, regime) tuple.
        truck: [B, N] bool, may start from the points of trucks only.
        behind, length: [B, N] m, of the whole vehicle, behind its reference point and in all.
        gap: [B, N] m to be kept free ahead.
    """
    begin, room = (values[tuple_index].unsqueeze(-1) for values in (lines.begin, lines.length))
    aim = _aims(lines, tuple_index, wanted, truck, generator)
    aim = torch.where(wanted, aim, begin + room + 1.0)  # the others stand behind all of them
    order = aim.argsort(-1)

    def ordered(values: Tensor) -> Tensor:
        return values.gather(-1, order)

    there = ordered(wanted)
    body, free = (torch.where(there, ordered(v), 0.0).double() for v in (length, gap))
    at = lines.point(ordered(aim))
    low, high = lines.low[at], lines.high[at]
    before = (body + free).cumsum(-1) - (body + free)
    least, most = low - before, torch.maximum(high - body, low) - before
    rear = torch.where(there, ordered(aim), begin + room) - before
    for _ in range(PASSES):
        rear = torch.minimum(torch.maximum(rear, least), most)
        rising = rear.cummax(-1).values
        falling = rear.flip(-1).cummin(-1).values.flip(-1)
        rear = 0.5 * (rising + falling)
    rear = torch.minimum(torch.maximum(rear, least), most) + before
    # those ahead of a vehicle that has no room stay
    same = (low[:, 1:] == low[:, :-1]) & there[:, 1:]
    ahead = torch.where(same, rear[:, 1:] - rear[:, :-1] - body[:, :-1], torch.inf)
    ahead = torch.nn.functional.pad(ahead, (0, 1), value=torch.inf)
    fits = there & (ahead > 0.5 * free - TOUCH) & (rear + body <= high + TOUCH)

    def slots(values: Tensor, empty: float) -> Tensor:
        return torch.full_like(values, empty).scatter(-1, order, values)

    leader = torch.where(same, order[:, 1:], -1)
    leader = torch.nn.functional.pad(leader, (0, 1), value=-1)
    reference = rear + torch.where(there, ordered(behind), 0.0)
    point = lines.point(torch.minimum(reference, high - TOUCH))
    return Placement(
        slots(point, 0),
        slots(fits, False),
        slots(leader, -1),
        slots(ahead.float(), torch.inf),
    )


def anywhere(lines: Lines, tuple_index: Tensor, truck: Tensor, generator: torch.Generator) -> Tensor:
    """[B, N] a random point for every vehicle, one for trucks for a truck."""
    uniform = torch.rand(truck.shape, generator=generator, device=truck.device, dtype=torch.float64)
    return _points(lines, tuple_index, truck, uniform)


def _aims(
    lines: Lines, tuple_index: Tensor, wanted: Tensor, truck: Tensor, generator: torch.Generator
) -> Tensor:
    """[B, N] place on the axis that each vehicle would like, the cars and the trucks spread evenly."""
    device = wanted.device
    aim = torch.zeros(wanted.shape, dtype=torch.float64, device=device)
    for kind in (wanted & truck, wanted & ~truck):
        shuffle = torch.rand(wanted.shape, generator=generator, device=device)
        rank = torch.where(kind, shuffle, 2.0).argsort(-1).argsort(-1)
        jitter = torch.rand(wanted.shape, generator=generator, device=device, dtype=torch.float64)
        share = (rank + jitter) / kind.sum(-1, keepdim=True).clamp_min(1)
        aim = torch.where(kind, lines.at[_points(lines, tuple_index, truck, share)], aim)
    return aim


def _points(lines: Lines, tuple_index: Tensor, truck: Tensor, share: Tensor) -> Tensor:
    """Points at a share in [0, 1) of the places that a vehicle may start from."""
    share = share.clamp(0.0, 1.0 - 1e-9)
    begin, length, first, count = (
        values[tuple_index].unsqueeze(-1)
        for values in (lines.begin, lines.length, lines.first_truck, lines.truck_count)
    )
    trucks = (first + (share * count).long()).clamp_max(max(len(lines.trucks) - 1, 0))
    of_trucks = lines.trucks[trucks] if len(lines.trucks) else torch.zeros_like(trucks)
    return torch.where(truck, of_trucks, lines.point(begin + share * length))


def conflicts(
    shape: VehicleShape,
    trial: VehicleState,
    braking: Tensor,
    gap: Tensor,
    active: Tensor,
    wanted: Tensor,
) -> Tensor:
    """Slots whose trial position is too close to a placed agent or to an earlier proposal.

    Each vehicle claims its boxes and the road ahead of it: a gap, and the distance that
    it closes on a slower one while it brakes, so that no collision is unavoidable from the start. With
    jerk -J alpha the speed difference D is gone after t = sqrt(2 D / (J alpha)), and 2/3 D t is closed.

    Args:
        braking: [B, N] J alpha in m/s^3.
        gap: [B, N] m to be kept free ahead.
        active, wanted: [B, N] bool, who is placed, and who proposes a place.
    """
    box = boxes(shape, trial)
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
