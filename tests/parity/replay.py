"""The torch simulator with the vehicles of a recording, playing the same tokens."""

from __future__ import annotations

from dataclasses import replace

import torch

from phase_sumo.bridge.fleet.table import STATE, TASK
from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.sumo.conventions import shapes
from phase_sumo.config import REGIMES, ScenarioConfig, SimConfig, TaskConfig
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.observation import Observation
from phase_sumo.sim.vehicles import Task, VehicleState
from tests.helpers.rollouts import place
from tests.parity.recording import Decision, Recording, SumoStep


class Replay:
    """One world without noise and without an end.

    Attributes:
        ids: vehicle of each slot; trucks have the first ones.
        environment: the torch simulator.
    """

    def __init__(self, network: LaneNetwork, recording: Recording, start: SumoStep, sim: SimConfig) -> None:
        self.ids = sorted(start.table, key=lambda v: (not recording.shapes[v].truck, v))
        self.slot = {vehicle: slot for slot, vehicle in enumerate(self.ids)}
        sim = replace(sim, horizon=10**6, early_termination=False)
        self.environment = Environment(
            [build_bundle(network, ScenarioConfig(regimes=REGIMES[:1]))],
            1,
            len(self.ids),
            TaskConfig(sim=sim, scenarios=ScenarioConfig(regimes=REGIMES[:1])),
            training=False,
        )
        self.environment.trailers = len(self.ids)
        shape = shapes([recording.shapes[v] for v in self.ids])
        columns = {n: torch.tensor([[start.table[v][n].tolist() for v in self.ids]]) for n in STATE}
        none = torch.zeros(1, len(self.ids), dtype=torch.bool)
        nowhere = torch.zeros(1, len(self.ids))
        task = Task(*(nowhere.clone() for _ in TASK))
        self.environment.worlds = place(shape, VehicleState(**columns), task, ~none)

    @property
    def state(self) -> VehicleState:
        return self.environment.worlds.state

    def see(self, decision: Decision) -> Observation:
        """What the vehicles of a decision see here, with its goals and the others where SUMO has them."""
        worlds = self.environment.worlds
        slots = torch.tensor([self.slot[v] for v in decision.ids])
        for name in TASK:
            getattr(worlds.task, name)[0, slots] = torch.from_numpy(decision.task[name])
        for vehicle, state in decision.others.items():
            for name in STATE:
                getattr(worlds.state, name)[0, self.slot[vehicle]] = torch.as_tensor(state[name])
        return self.environment.seen_by(slots)

    def act(self, decision: Decision) -> tuple[set[str], set[str], set[str]]:
        """Step with the decision's tokens; vehicles that have collided, were at fault, touched the edge."""
        action = torch.zeros(1, len(self.ids), dtype=torch.long)
        action[0, [self.slot[v] for v in decision.ids]] = decision.tokens
        outcome = self.environment.step(action).outcome
        return self._where(outcome.collision), self._where(outcome.at_fault), self._where(outcome.road_edge)

    def _where(self, mask: torch.Tensor) -> set[str]:
        return {self.ids[slot] for slot in mask[0].nonzero().flatten().tolist()}
