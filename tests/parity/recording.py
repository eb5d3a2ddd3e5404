"""Drives a fleet in SUMO and keeps what every vehicle saw, did and became."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phase_sumo.bridge.fleet.contacts import ContactMonitor
from phase_sumo.bridge.fleet.drivers import Driver, Drivers
from phase_sumo.bridge.fleet.event_log import Event
from phase_sumo.bridge.fleet.fleet import Fleet
from phase_sumo.bridge.fleet.parameters import Choice
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.fleet.table import STATE, TASK, VehicleTable
from phase_sumo.bridge.sumo.conventions import ShapeRow
from phase_sumo.bridge.sumo.options import command, read_scenario
from phase_sumo.bridge.sumo.session import Session
from phase_sumo.policy.network import choose
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.observation import Observation

Values = dict[str, np.ndarray]


@dataclass
class Decision:
    """One step of the model: rows are vehicles, in the order of ``ids``.

    Attributes:
        ids: vehicles under the policy.
        seen: what each of them saw.
        tokens: what each of them did.
        task: goals and context that it did it with.
        others: state of the vehicles that SUMO drives, by id.
    """

    ids: list[str]
    seen: Observation
    tokens: Tensor
    task: Values
    others: dict[str, dict[str, Any]]


@dataclass
class SumoStep:
    """What SUMO and our events say after one of SUMO's steps.

    Attributes:
        time: s.
        decisions: how many decisions have been taken so far.
        pose: id -> front bumper x, y in m and angle in degrees, from SUMO.
        table: id -> model state, from ours.
        contacts: pairs of vehicles whose contact begins now, with the vehicles at fault.
        off_road: contacts with the road edge so far.
    """

    time: float
    decisions: int
    pose: dict[str, tuple[float, float, float]]
    table: dict[str, dict[str, Any]]
    contacts: list[tuple[set[str], set[str]]]
    off_road: int


@dataclass
class Recording:
    """A run; ``shapes`` holds every vehicle's geometry."""

    shapes: dict[str, ShapeRow] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    steps: list[SumoStep] = field(default_factory=list)


class Recorder:
    """Passes decisions on and notes them."""

    def __init__(self, driver: Driver, table: VehicleTable, kept: Recording) -> None:
        self.sim, self.actions = driver.sim, driver.actions
        self._driver, self._table, self._kept = driver, table, kept

    def scores(self, observation: Observation) -> Tensor:
        table = self._table
        rows = np.flatnonzero(table.controlled)
        scores = self._driver.scores(observation)
        others = np.flatnonzero(table.active & ~table.controlled)
        self._kept.decisions.append(
            Decision(
                [table.ids[row] for row in rows],
                observation.map(torch.clone),
                choose(scores),
                {name: table[name][rows].copy() for name in TASK},
                {table.ids[row]: state_of(table, row) for row in others.tolist()},
            )
        )
        return scores


def state_of(table: VehicleTable, row: int) -> dict[str, Any]:
    return {name: table[name][row].copy() for name in STATE}


def record(
    cfg: Path,
    network: LaneNetwork,
    driver: Driver,
    until: float,
    choice: Choice | None = None,
    begin_from: Callable[[VehicleTable, float], None] | None = None,
) -> Recording:
    """Run a scenario until a time; ``begin_from`` may change the table before the fleet drives."""
    kept = Recording()
    edges = frozenset(lane.edge for lane in network.lanes if not lane.connector)
    args = command(read_scenario(cfg), cfg.parent, seed=1)
    with Session(args, cfg.parent) as session:
        scene = Scene(session, edges)
        monitor = ContactMonitor(scene.events)
        drivers = Drivers(Recorder(driver, scene.table, kept))
        fleet = Fleet(scene, Road(network), drivers, choice or Choice(alpha=0.8, time_gap=0.0, guard=False))
        while True:
            session.step()
            time = session.time
            scene.update()
            fleet.follow_sumo(time)
            new = monitor.update(scene.table, time, scene.types)
            kept.steps.append(_sumo_step(time, kept, scene, new))
            kept.shapes |= {vehicle: facts.shape for vehicle, facts in scene.facts.items()}
            if time >= until - 1e-6:
                return kept
            if begin_from:
                begin_from(scene.table, time)
            fleet.drive(time)


def _sumo_step(time: float, kept: Recording, scene: Scene, new: list[Event]) -> SumoStep:
    api, table = scene.api.vehicle, scene.table
    return SumoStep(
        time,
        len(kept.decisions),
        {v: (*api.getPosition(v), api.getAngle(v)) for v in table.row_of},
        {v: state_of(table, row) for v, row in table.row_of.items()},
        [({c.vehicle, c.other}, {c.vehicle, c.other} if c.other_fault else {c.vehicle}) for c in new],
        len(scene.events.of("road edge")),
    )
