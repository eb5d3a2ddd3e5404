"""Drives the controlled rows of a table with the policy, one move at a time.

The policy decides every 0.1 s of simulated time, as it was trained to. A longer step of SUMO holds several
decisions; between two decisions there may be several shorter ones, in which the vehicles only move on. All
decide at the same instants, the multiples of 0.1 s. A vehicle that is taken over in between keeps the
acceleration that it had under SUMO until then, so that its speed does not jump.
"""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from phase_sumo.bridge.fleet.drivers import Driver, Drivers, Member
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.guarded import Guarding
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.fleet.target_speeds import TargetSpeeds
from phase_sumo.config import SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.policy.network import choose
from phase_sumo.sim import kinematics
from phase_sumo.sim.near import pairs_within, ranges
from phase_sumo.sim.observation import Appearance, appearance, observe
from phase_sumo.sim.path import Sight
from phase_sumo.sim.vehicles import VehicleState

TOLERANCE = 1e-6  # s
MILLISECOND = 1e-3  # s, SUMO's clock counts them


@dataclass(frozen=True)
class Steps:
    """Moves of the vehicles, each as long as the shorter of the two steps.

    Attributes:
        seconds: of a move.
        per_sumo_step: moves in a step of SUMO.
        per_decision: moves from one decision to the next; one of the two numbers is 1.
    """

    seconds: float
    per_sumo_step: int
    per_decision: int

    @classmethod
    def fit(cls, sumo: float, policy: float) -> Steps:
        """For steps of SUMO and of the policy in s.

        Raises:
            PhaseError: neither is a multiple of the other.
        """
        several, parts = max(round(sumo / policy), 1), max(round(policy / sumo), 1)
        if abs(several * policy - parts * sumo) > TOLERANCE:
            in_milliseconds = round(policy / MILLISECOND)
            usable = [policy / n for n in range(1, in_milliseconds + 1) if in_milliseconds % n == 0]
            nearest = min([several * policy, *usable], key=lambda step: abs(step - sumo))
            raise PhaseError(
                f"option step-length {sumo:g} s: PHASE decides every {policy:g} s, which the step "
                f"must divide or be a multiple of; pass -- --step-length {nearest:g}"
            )
        return cls(policy / parts, several, parts)

    def decides(self, time: float) -> bool:
        """Whether the move that begins at a time begins with a decision."""
        return round(time / self.seconds) % self.per_decision == 0


NOBODY, LOW_BITS = np.uint64(2**64 - 1), np.uint64(2**32 - 1)
SAME_WAY = 0.5  # cosine of the heading difference up to which another vehicle is seen
# The network's matrix products are in bf16, as in training, where the processor has them: a fifth less time
_CAPABILITIES = getattr(torch.cpu, "get_capabilities", dict)()
BF16 = any(_CAPABILITIES.get(name, False) for name in ("amx_bf16", "avx512_bf16", "bf16"))


class Controller:
    """Observation, policy, kinematics: the same code as in training, on the table's memory.

    A decision changes acceleration and steering angle at once, by j dt and d(steer)/dt dt with the policy's
    dt, and the moves up to the next one hold them, as the simulator's one step of dt does. Vehicles thus end
    n moves on the path of that step, with its speed, (1 - 1/n) a dt^2 / 2 behind. With jerk and steering rate
    spread over the moves they would turn in up to dt/2 later than the policy was trained with.

    Attributes:
        cpu, decisions: CPU seconds spent on observing, deciding and moving, and vehicle steps decided.
    """

    def __init__(
        self,
        road: Road,
        table: VehicleTable,
        drivers: Drivers,
        steps: Steps,
        speeds: TargetSpeeds,
        planner: GoalPlanner,
        guarding: Guarding,
    ) -> None:
        self._road, self._table, self._drivers, self._steps = road, table, drivers, steps
        self._speeds, self._planner, self._guarding = speeds, planner, guarding
        self._node = np.full(len(table), -1, np.int64)  # at the last decision
        self._sight: Sight  # of all rows at the last decision
        self.cpu = 0.0
        self.decisions = 0

    def drive(self, time: float, node: np.ndarray, members: dict[str, Member]) -> np.ndarray:
        """Move the controlled rows on by one step of SUMO.

        SUMO's vehicles run on at constant speed between two of SUMO's steps; the table holds their pose of
        SUMO's clock again afterwards.

        Args:
            node: [N] node of each row's front bumper, -1 off the road.

        Returns:
            [N] nodes after the move.
        """
        table, steps = self._table, self._steps
        others = np.flatnonzero(table.active & ~table.controlled)
        routes = {vehicle: member.route for vehicle, member in members.items()}
        before = {name: table[name][others].copy() for name in ("x", "y")}
        for k in range(steps.per_sumo_step):
            rows = np.flatnonzero(table.controlled)
            if not len(rows):
                break
            now = time + k * steps.seconds
            decides = steps.decides(now)
            if decides:
                self._node = node
                occupancy = Occupancy(self._road, table, node)
                if k:  # those of the first move were set when SUMO's step was followed
                    self._speeds.update(node, self._planner.beside(node), occupancy, members)
                self._planner.update(now, node, occupancy, routes)
                self._sight = self._look(node, routes)
            self._move(rows, decides)
            node = self.track(node, rows)
            if k + 1 < steps.per_sumo_step:
                table.extrapolate(others, steps.seconds)
        for name, values in before.items():
            table[name][others] = values
        return node

    def track(self, node: np.ndarray, rows: np.ndarray, piece: np.ndarray | None = None) -> np.ndarray:
        """Nodes of the front bumpers, updated for some rows; ``piece`` as in `Road.track`."""
        x, y = self._table.front
        node = node.copy()
        node[rows], _ = self._road.track(node[rows], x[rows], y[rows], self._table["yaw"][rows], piece)
        return node

    @torch.no_grad()
    def _move(self, rows: np.ndarray, decides: bool) -> None:
        begin = clock.process_time()
        table = self._table
        by = table.driver[rows]
        groups = [(rows[by == number], driver) for number, driver in enumerate(self._drivers)]
        groups = [(own, driver) for own, driver in groups if len(own)]
        if decides:
            every = appearance(table.shape(), table.state())
            moved = [self._next(own, driver, every) for own, driver in groups]
            self.decisions += len(rows)
        else:
            moved = [self._hold(own, driver) for own, driver in groups]
        for (own, _), state in zip(groups, moved, strict=True):  # all have seen the same traffic
            table.take(state, own)
        self.cpu += clock.process_time() - begin

    def _next(self, rows: np.ndarray, driver: Driver, every: Appearance) -> VehicleState:
        """States [len(rows)] after a move that begins with a decision, under one driver."""
        table, driven = self._table, torch.from_numpy(rows)

        def own(values: Tensor) -> Tensor:
            return values[0, driven]

        shape, state, task = table.shape().map(own), table.state().map(own), table.task().map(own)
        index, mask = self._neighbours(rows, driver.sim)
        others = every.map(lambda values: values[0, index])
        sight = self._sight.take(driven)
        seen = observe(shape, state, task, others, mask, sight.road_map, sight.view, sight.yaw, driver.sim)
        with torch.autocast("cpu", torch.bfloat16, enabled=BF16):
            scores = driver.scores(seen)
        command = kinematics.command(choose(scores), state, task.alpha, driver.actions, driver.sim.dt)
        jerk, rate = self._guarding.correct(scores, command, rows, index, mask, self._sight, driver)
        moves = self._steps.per_decision
        return kinematics.advance(shape, state, moves * jerk, moves * rate, self._of_a_move(driver.sim))

    def _look(self, node: np.ndarray, routes: dict[str, RouteLanes]) -> Sight:
        """The road as all rows see it: from their place, or along their route where that shows another."""
        road, table, graph = self._road.map, self._table, self._road.graph
        layer = torch.from_numpy(np.where(node >= 0, self._road.layer[node], 0))
        cell = road.cell(layer, torch.from_numpy(table["x"]), torch.from_numpy(table["y"]))
        by_route, at = self._road.views.seen(table, node, routes)
        own = torch.from_numpy(by_route >= 0)
        along = torch.from_numpy(np.column_stack((graph.node_xy[at], graph.node_yaw[at])).astype(np.float32))
        place = torch.cat((road.cell_node[cell], road.cell_yaw[cell].unsqueeze(1)), 1)
        x, y, yaw = torch.where(own.unsqueeze(1), along, place).unbind(1)
        view = torch.where(own, torch.from_numpy(by_route), road.cell_view[cell])
        return Sight(self._road.map, view, x, y, yaw)

    def _hold(self, rows: np.ndarray, driver: Driver) -> VehicleState:
        """States [len(rows)] after a move between two decisions, which the histories do not count."""
        table, driven = self._table, torch.from_numpy(rows)

        def own(values: Tensor) -> Tensor:
            return values[0, driven]

        shape, state = table.shape().map(own), table.state().map(own)
        none = torch.zeros_like(state.speed)
        moved = kinematics.advance(shape, state, none, none, self._of_a_move(driver.sim))
        return replace(moved, accel_history=state.accel_history, steer_history=state.steer_history)

    def _of_a_move(self, sim: SimConfig) -> SimConfig:
        return replace(sim, dt=self._steps.seconds)

    def _neighbours(self, rows: np.ndarray, sim: SimConfig) -> tuple[Tensor, Tensor]:
        """As `neighbours.nearest`, for some rows, without traffic on other roads.

        Training maps are single carriageways; the opposite one and roads on other levels would only take
        the places of the vehicles that matter. A vehicle that is on no lane is told by its direction.

        Returns:
            index of the neighbours' rows and mask, both [len(rows), K].
        """
        table = self._table
        x, y = table["x"], table["y"]
        active = np.flatnonzero(table.active)
        # some more than are in range, which float32 decides as in training
        first, second = pairs_within(
            np.stack((x[rows], y[rows]), -1), np.stack((x[active], y[active]), -1), sim.neighbour_range + 1.0
        )
        own, other = rows[first], active[second]
        dx, dy = x[own] - x[other], y[own] - y[other]
        squared = dx * dx + dy * dy
        near = np.flatnonzero((squared < sim.neighbour_range**2) & (own != other))
        near = near[self._on_one_road(own[near], other[near])]
        first, other, squared = first[near], other[near], squared[near]
        # one number to sort by, distance before row: the bits of floats >= 0 rise with their value
        key = squared.view(np.uint32).astype(np.uint64) << np.uint64(32) | other.astype(np.uint64)
        count = np.bincount(first, minlength=len(rows))
        ordered = np.full((len(rows), max(int(count.max()), sim.neighbours)), NOBODY)
        ordered[first, ranges(count)] = key
        ordered = np.sort(ordered, 1)[:, : sim.neighbours]
        mask = ordered != NOBODY
        index = np.where(mask, ordered & LOW_BITS, 0).astype(np.int64)
        return torch.from_numpy(index), torch.from_numpy(mask)

    def _on_one_road(self, own: np.ndarray, other: np.ndarray) -> np.ndarray:
        """[n] whether the vehicle in a row sees the one in another."""
        a, b = self._node[own], self._node[other]
        piece, yaw = self._road.piece, self._table["yaw"]
        known = (a >= 0) & (b >= 0)
        same_way = np.cos(yaw[own] - yaw[other]) >= SAME_WAY
        return np.where(known, self._road.levels.seen(piece[a], piece[b]), same_way)
