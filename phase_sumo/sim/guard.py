"""The guard: of the policy's actions, the likeliest from which a vehicle can still avoid whom it must.

A safety filter between policy and vehicle, after responsibility-sensitive safety (Shalev-Shwartz et al. 2017)
and model predictive shielding (Bastani 2021). An action is safe if after it the fallback is: to brake as hard
as the vehicle can and to run along its lane (`fallback`). The fallback is itself an action, tried with the
others, so whoever has been safe has a safe action in the next step. Where there is none, the guard takes the
least bad one and says so.

What holds. Let A follow B: B is ahead, and the strip of road that A's fallback covers overlaps with B. With

    x_A(t): A's way with the action for a step, then a' = -J up to a = -b, in steps of `kinematics.advance`
    x_B(t): B's way braking from now on, a' = -J_B up to a = -b_B

the action is safe only if gap + x_B(t) - x_A(t) >= `GuardConfig.gap` for all t until both stand. Then A does
not run into B as long as

1. B brakes no harder than b_B, and its braking builds up no faster than J_B (`GuardConfig.others_braking`,
   `GuardConfig.others_jerk`),
2. B does not come nearer sideways than it would in `GuardConfig.drift` seconds as it moves now, nor than its
   lane leads it within 2.5 s at its speed, or braking on if it brakes now, as before the line at the end of
   a ramp: who cuts in without notice, or lets go of the brakes, too close to be avoided is not avoided,
3. A has been safe with respect to B once since it follows B, and
4. everybody that matters is among those given, and the road ahead is as seen (`path.Path`).

Proof: by (3) the fallback from now on keeps the gap for B's hardest braking, so by (1) for any. Its first
step is the action with jerk -J, along the lane. If no other action is safe it is taken, and what remains of
it is safe in the next step, since by (1) B has driven at least what was reckoned with. Nothing is delayed:
everybody sees and acts in every step.

Beside. No action steers nearer than `GuardConfig.approach` to a box beside, nor into the lane of somebody
behind who, speeding up for one more step, could no longer stop behind A if A braked as hard as it can; so two
guarded vehicles begin to follow one another only where (3) holds. Of two whose lanes come together the one
whose front is behind gives way. Towards those behind in its own lane a vehicle owes nothing. Trailers, mine
and others', are boxes of their own; long boxes are cut into pieces. What two vehicles do sideways at once
within a step is bounded by margins, not by a proof, and so is the road's edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import Actions, GuardConfig, SimConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.fallback import Motion, limits, straighten
from phase_sumo.sim.hazards import edges_beside, judge, near_edge, near_others, reach_aside, too_fast
from phase_sumo.sim.neighbours import nearest
from phase_sumo.sim.path import Sight
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.surroundings import Surroundings, near_pairs, surroundings
from phase_sumo.sim.vehicles import TensorBatch, VehicleShape, VehicleState
from phase_sumo.sim.worlds import Worlds

BUILD_UP = (0.25, 0.5, 1.0)  # shares of the emergency jerk that the guard may brake with
PER_METRE = 1e4  # nats that a metre of shortage outweighs
SLACK = 0.1  # m by which a shortage may come from rounding and from how well the lane is known
GENTLE = 0.1  # rad/s up to which the guard may choose among the policy's other steering rates
# nats by which running along the lane, and braking harder while doing so, come after other actions
STRAIGHT, HARDER = 1.0, 5.0


@dataclass
class Decision(TensorBatch):
    """What vehicles do, all [R], or [W, N] of whole worlds.

    Attributes:
        token: the action taken, or where it is not on the lattice, the one with the nearest steering.
        jerk, rate: m/s^3 and rad/s, the command.
        reason: `Reason` why the wanted action was not taken.
        unsafe: bool, nothing was safe and this is the least bad.
    """

    token: Tensor
    jerk: Tensor
    rate: Tensor
    reason: Tensor
    unsafe: Tensor


def guarded(
    scores: Tensor,
    alpha: Tensor,
    shape: VehicleShape,
    state: VehicleState,
    rows: Tensor,
    index: Tensor,
    mask: Tensor,
    sight: Sight,
    actions: Actions,
    sim: SimConfig,
    config: GuardConfig,
) -> Decision:
    """Decisions of R vehicles among M. Most of them want what is safe, and only the others look further.

    Args:
        scores: [R, A] logits of the actions; with Gumbel noise on them the result is a draw from the
            policy, given that the action is safe.
        alpha: [R] longitudinal action range; it does not limit how hard the guard brakes.
        shape, state: [M] of everybody.
        rows: [R] which of them decide.
        index, mask: [R, K] the nearest others and which are real.
        sight: [M] the road as everybody sees it.
    """
    motion = Motion.of(shape.take(rows), state.take(rows), sight.take(rows))
    jerks, rates = kinematics.lattice(motion.state, alpha, actions, sim.dt)
    token, columns = scores.argmax(1), rates.shape[1]
    jerk = jerks.gather(1, token.unsqueeze(1) // columns)
    rate = rates.gather(1, token.unsqueeze(1) % columns)
    reason = torch.zeros_like(token)
    aside = reach_aside(motion, rate.squeeze(1), sim)
    busy = near_edge(motion, sight.take(rows), aside, config)
    busy |= (too_fast(motion, jerk, sim, config) > 0.0).squeeze(1)
    edge = busy.clone()
    row, other = near_pairs(shape, state, rows, index, mask, sim, config)
    busy[row] = True
    some, number = busy.nonzero().squeeze(1), busy.cumsum(0) - 1
    near = number[row], other
    around = surroundings(shape, state, rows[some], motion.take(some), near, sight, sim, config)
    close = near_others(around.contacts, aside[some], config)
    busy = edge[some]
    busy[around.contacts.row[close]] = True
    some, around = some[busy], around.take(busy.nonzero().squeeze(1))
    edges = edges_beside(around.motion, sight.take(rows[some]))
    near = around.among(near_others(around.contacts, aside[some], config))
    reason[some] = judge(near, edges, jerk[some], rate[some], sim, config)[1].flatten()
    wanted = Decision(token, jerk.squeeze(1), rate.squeeze(1), reason, torch.zeros_like(edge))
    few = (reason[some] > 0).nonzero().squeeze(1)
    if len(few):
        at = some[few]
        instead = _instead(around.take(few), edges[:, few], scores[at], jerks[at], rates[at], sim, config)
        for name in ("token", "jerk", "rate", "unsafe"):
            getattr(wanted, name)[at] = getattr(instead, name)
    return wanted


def _instead(
    around: Surroundings,
    edges: Tensor,
    scores: Tensor,
    jerks: Tensor,
    rates: Tensor,
    sim: SimConfig,
    config: GuardConfig,
) -> Decision:
    """The best of the actions [R, J x C] and of the guard's own: braking harder, running along the lane."""
    columns = rates.shape[1]
    _, build_up = limits(around.motion.shape.truck, sim, config)
    back = straighten(around.motion, sim, config)
    all_jerks = torch.cat((jerks, -build_up.unsqueeze(1) * torch.tensor(BUILD_UP)), 1)
    all_rates = torch.cat((rates, back), 1)
    shortage, reason = judge(around, edges, all_jerks, all_rates, sim, config)
    value = _preference(scores.view(len(scores), -1, columns), config)
    # who has been safe is so in the fallback, which is judged again in every step of it
    shortage[:, -1, -1] = (shortage[:, -1, -1] - SLACK).clamp_min(0.0)
    # of about equally unsafe ones the preferred
    steps = torch.ceil(shortage / SLACK) * SLACK
    value = torch.where(shortage > 0.0, value - PER_METRE * (1.0 + steps), value)
    # nobody is saved by a jerk at the wheel
    wanted = rates.gather(1, (scores.argmax(1, keepdim=True) % columns))
    sharp = rates.abs() > wanted.abs().clamp_min(GENTLE)
    value[:, :, :-1].masked_fill_(sharp.unsqueeze(1), -torch.inf)
    best = value.flatten(1).argmax(1, keepdim=True)
    along, across = best // (columns + 1), best % (columns + 1)
    rate = all_rates.gather(1, across)
    on_lattice = torch.where(across < columns, across, (rates - rate).abs().argmin(1, keepdim=True))
    token = torch.where(along < jerks.shape[1], along, 0) * columns + on_lattice
    unsafe = shortage.flatten(1).gather(1, best) > 0.0
    columns_of = token, all_jerks.gather(1, along), rate, reason.flatten(1).gather(1, best), unsafe
    return Decision(*(values.squeeze(1) for values in columns_of))


def _preference(scores: Tensor, config: GuardConfig) -> Tensor:
    """[R, J + 3, C + 1] of the lattice's scores [R, J, C] and those of the guard's own jerks and steering.

    What is `GuardConfig.improbable` against the likeliest action comes after the guard's own, mildest first.
    """
    harder = scores.amax(1, keepdim=True) - torch.arange(1, len(BUILD_UP) + 1).view(1, -1, 1)
    straight = torch.cat((scores.amax(2, keepdim=True), harder.amax(2, keepdim=True) - HARDER), 1) - STRAIGHT
    return torch.cat((torch.cat((scores, harder - config.improbable), 1), straight - config.improbable), 2)


def of_worlds(
    scores: Tensor,
    worlds: Worlds,
    road_map: RoadMap,
    map_index: Tensor,
    actions: Actions,
    sim: SimConfig,
    config: GuardConfig,
) -> Decision:
    """Decisions [W, N] of all agents of batched worlds; those of other slots mean nothing."""
    size, state, active = worlds.active.shape, worlds.state, worlds.active
    index, mask = nearest(state.x, state.y, active, sim)
    cell = road_map.cell(map_index, state.x, state.y)
    first = torch.arange(size[0], device=index.device).view(-1, 1, 1) * size[1]
    rows = worlds.controlled.flatten().nonzero().squeeze(1)

    def flat(values: Tensor) -> Tensor:
        return values.flatten(0, 1)

    cell = flat(cell)
    node = road_map.cell_node[cell]
    sight = Sight(road_map, road_map.cell_view[cell], node[:, 0], node[:, 1], road_map.cell_yaw[cell])
    decision = guarded(
        flat(scores)[rows],
        flat(worlds.task.alpha)[rows],
        worlds.shape.map(flat),
        state.map(flat),
        rows,
        flat(index + first)[rows].long(),
        flat(mask)[rows],
        sight,
        actions,
        sim,
        config,
    )

    def back(values: Tensor) -> Tensor:
        every = torch.zeros(size[0] * size[1], dtype=values.dtype, device=values.device)
        every[rows] = values
        return every.view(size)

    return decision.map(back)
