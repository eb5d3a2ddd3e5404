"""Drives the controlled rows of a table with the policy, one simulator step at a time."""

from __future__ import annotations

import time as clock

import numpy as np
import torch
from torch import Tensor

from phase_sumo.bridge.fleet.drivers import Driver, Drivers
from phase_sumo.bridge.fleet.goals import GoalPlanner
from phase_sumo.bridge.fleet.member import Member
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.fleet.target_speed import TargetSpeeds
from phase_sumo.config import SimConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.near import pairs_within, ranges
from phase_sumo.sim.observation import Appearance, appearance, observe
from phase_sumo.sim.vehicles import VehicleState

NOBODY, LOW_BITS = np.uint64(2**64 - 1), np.uint64(2**32 - 1)
SAME_WAY = 0.5  # cosine of the heading difference up to which another vehicle is seen


class Controller:
    """Observation, policy, kinematics: the same code as in training, on the table's memory.

    Attributes:
        cpu, decisions: CPU seconds spent on observing, deciding and moving, and vehicle steps decided.
    """

    def __init__(
        self, road: Road, table: VehicleTable, drivers: Drivers, speeds: TargetSpeeds, planner: GoalPlanner
    ) -> None:
        self._road, self._table, self._drivers = road, table, drivers
        self._speeds, self._planner = speeds, planner
        self._map_index = torch.zeros(1, dtype=torch.long)
        self.cpu = 0.0
        self.decisions = 0

    def drive(self, time: float, substeps: int, node: np.ndarray, members: dict[str, Member]) -> np.ndarray:
        """Move the controlled rows on by ``substeps`` steps.

        SUMO's vehicles run on at constant speed between two of SUMO's steps; the table holds their pose of
        SUMO's clock again afterwards.

        Args:
            node: [N] node of each row's front bumper, -1 off the road.

        Returns:
            [N] nodes after the move.
        """
        table, dt = self._table, self._drivers.dt
        others = np.flatnonzero(table.active & ~table.controlled)
        routes = {vehicle: member.route for vehicle, member in members.items()}
        before = {name: table[name][others].copy() for name in ("x", "y")}
        for k in range(substeps):
            rows = np.flatnonzero(table.controlled)
            if not len(rows):
                break
            occupancy = Occupancy(self._road, table, node)
            if k:  # those of the first step were set when SUMO's was followed
                self._speeds.update(node, self._planner.beside(node), occupancy, members)
            self._planner.update(time + k * dt, node, occupancy, routes)
            self._step(rows)
            node = self.track(node, rows)
            if k + 1 < substeps:
                table.extrapolate(others, dt)
        for name, values in before.items():
            table[name][others] = values
        return node

    def track(self, node: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Nodes of the front bumpers, updated for some rows."""
        x, y = self._table.front
        node = node.copy()
        node[rows], _ = self._road.track(node[rows], x[rows], y[rows], self._table["yaw"][rows])
        return node

    @torch.no_grad()
    def _step(self, rows: np.ndarray) -> None:
        begin = clock.process_time()
        table = self._table
        every = appearance(table.shape(), table.state())
        by = table.driver[rows]
        groups = [(rows[by == number], driver) for number, driver in enumerate(self._drivers)]
        moved = [(own, self._next(own, driver, every)) for own, driver in groups if len(own)]
        for own, state in moved:  # all have seen the same traffic
            table.take(state, own)
        self.cpu += clock.process_time() - begin
        self.decisions += len(rows)

    def _next(self, rows: np.ndarray, driver: Driver, every: Appearance) -> VehicleState:
        """States [len(rows)] one policy step later, under one driver."""
        table, driven = self._table, torch.from_numpy(rows)

        def own(values: Tensor) -> Tensor:
            return values[0, driven]

        shape, state, task = table.shape().map(own), table.state().map(own), table.task().map(own)
        index, mask = self._neighbours(rows, driver.sim)
        others = every.map(lambda values: values[0, index])
        cell = self._road.map.cell(self._map_index, state.x.unsqueeze(0), state.y.unsqueeze(0)).squeeze(0)
        seen = observe(shape, state, task, others, mask, self._road.map, cell, driver.sim)
        jerk, rate = kinematics.command(driver.act(seen), state, task.alpha, driver.actions, driver.sim.dt)
        return kinematics.advance(shape, state, jerk, rate, driver.sim)

    def _neighbours(self, rows: np.ndarray, sim: SimConfig) -> tuple[Tensor, Tensor]:
        """As `neighbours.nearest`, for some rows, without traffic that runs in another direction.

        Training maps are single carriageways; the opposite one and roads on other levels would only take
        the places of the vehicles that matter.

        Returns:
            index of the neighbours' rows and mask, both [len(rows), K].
        """
        table = self._table
        x, y, yaw = table["x"], table["y"], table["yaw"]
        active = np.flatnonzero(table.active)
        # some more than are in range, which float32 decides as in training
        first, second = pairs_within(
            np.stack((x[rows], y[rows]), -1), np.stack((x[active], y[active]), -1), sim.neighbour_range + 1.0
        )
        own, other = rows[first], active[second]
        dx, dy = x[own] - x[other], y[own] - y[other]
        squared = dx * dx + dy * dy
        same_way = np.cos(yaw[own] - yaw[other]) >= SAME_WAY
        seen = np.flatnonzero((squared < sim.neighbour_range**2) & same_way & (own != other))
        first, other, squared = first[seen], other[seen], squared[seen]
        # one number to sort by, distance before row: the bits of floats >= 0 rise with their value
        key = squared.view(np.uint32).astype(np.uint64) << np.uint64(32) | other.astype(np.uint64)
        count = np.bincount(first, minlength=len(rows))
        ordered = np.full((len(rows), max(int(count.max()), sim.neighbours)), NOBODY)
        ordered[first, ranges(count)] = key
        ordered = np.sort(ordered, 1)[:, : sim.neighbours]
        mask = ordered != NOBODY
        index = np.where(mask, ordered & LOW_BITS, 0).astype(np.int64)
        return torch.from_numpy(index), torch.from_numpy(mask)
