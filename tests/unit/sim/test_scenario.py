"""Scenarios beyond the paper's: agents that begin out of line with their lane, and tight curves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import (
    POOLS,
    REGIMES,
    ScenarioConfig,
    ScriptConfig,
    SimConfig,
    TaskConfig,
)
from phase_sumo.sim.curve_speed import SIDEWAYS, SIDEWAYS_TRUCK, WINDOW
from phase_sumo.sim.dimensions import truck_slots
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.events import agent_contacts
from phase_sumo.sim.pairs import PairTable
from phase_sumo.sim.scenario import SCRIPTED, STANDING, RegimeTable, Scenario, capacity, sample
from phase_sumo.sim.vehicles import boxes
from tests.helpers.places import NETWORKS

WORLDS, SLOTS = 64, 24
JAMMED, DENSE = 0, 1


@pytest.fixture(scope="module")
def bundle():
    return build_bundle(read_network(NETWORKS / "f04_onramp3.net.xml"))


@pytest.fixture
def drawn(bundle):
    def draw(regime: int, bundle=bundle, **changes) -> Scenario:
        config = replace(ScenarioConfig(), **changes)
        pools = [(bundle.graph, pool) for pool in bundle.pools]
        return sample(
            PairTable.of(pools, "cpu"),
            RegimeTable.of(list(POOLS), 0.25, SLOTS, "cpu"),
            torch.full((WORLDS,), regime),
            SLOTS,
            True,
            config,
            SimConfig(),
            8.0,
            torch.Generator().manual_seed(3),
        )

    return draw


@pytest.mark.parametrize(("regime", "yaw"), [(JAMMED, 0.15), (DENSE, 0.15 * 8.0 / 15.0)])
def test_agents_astray_are_out_of_line(drawn, bundle, regime, yaw):
    def errors(scenario: Scenario) -> tuple[float, float]:
        node = torch.from_numpy(bundle.graph.node_xy).float()
        state, active = scenario.state, scenario.active
        xy = torch.stack((state.x, state.y), -1)[active]
        distance, nearest = torch.cdist(xy, node).min(-1)
        direction = torch.from_numpy(bundle.graph.node_yaw).float()[nearest]
        turn = torch.remainder(state.yaw[active] - direction + torch.pi, 2 * torch.pi) - torch.pi
        return float(distance.square().mean().sqrt()), float(turn.std())

    aside, turned = errors(drawn(regime, astray=1.0))
    assert aside == pytest.approx(0.6, rel=0.2)
    assert turned == pytest.approx(yaw, rel=0.25)
    aside, turned = errors(drawn(regime))
    assert aside < 0.4 and turned < 0.03


@pytest.mark.parametrize("regime", [JAMMED, DENSE])
def test_nobody_begins_or_is_told_to_arrive_too_fast_for_a_curve(drawn, regime):
    ramp = build_bundle(read_network(NETWORKS / "hard" / "f26_ramp1.net.xml"))
    scenario = drawn(regime, ramp, truck_ratio=0.5)
    truck, active = scenario.shape.truck, scenario.active
    node = torch.from_numpy(ramp.graph.node_xy).double()
    bend = torch.from_numpy(np.abs(ramp.graph.curvature(WINDOW)))

    def sideways(x, y, speed, vehicles) -> torch.Tensor:
        at = torch.cdist(torch.stack((x, y), -1)[vehicles].double(), node).argmin(-1)
        return speed[vehicles].square() * bend[at]

    state, task = scenario.state, scenario.task
    for vehicles, most in ((active & ~truck, SIDEWAYS), (active & truck, SIDEWAYS_TRUCK)):
        assert vehicles.sum() > 100
        assert sideways(task.goal_x, task.goal_y, task.goal_speed, vehicles).max() < 1.02 * most
        # beginners lie a little beside their node, so the nearest one may be the next
        assert sideways(state.x, state.y, state.speed, vehicles).max() < 1.1 * most
    fastest = state.speed[active & ~truck].max()
    assert fastest > 0.8 * torch.sqrt(SIDEWAYS / bend.median()).clamp_max(6.7 * 1.4)


@pytest.mark.parametrize("regime", range(len(REGIMES)), ids=[r.name for r in REGIMES])
def test_worlds_hold_as_many_agents_and_trucks_as_the_paper_asks_for(regime):
    """Full scale, after the switch: 144 to 256 agents in a jam; up to what the lanes can hold."""
    names = ("f03_curve4", "f11_straight6", "f16_carpool5")
    maps = [build_bundle(read_network(NETWORKS / f"{name}.net.xml")) for name in names]
    config = ScenarioConfig()
    pairs = PairTable.of([(bundle.graph, bundle.pools[regime]) for bundle in maps], "cpu")
    table = RegimeTable.of([REGIMES[regime]] * len(maps), 1.0, 256, "cpu")
    index = torch.arange(len(maps)).repeat_interleave(64)
    rooms = capacity(pairs, table, config)
    generator = torch.Generator().manual_seed(0)
    scenario = sample(pairs, table, index, 256, True, config, SimConfig(), 8.0, generator)
    low, high = REGIMES[regime].agents_late
    found = scenario.active.sum(-1).float()
    for number, room in enumerate(rooms.tolist()):
        counts = found[index == number]
        expected = torch.arange(low, high + 1).clamp_max(int(room)).float().mean().item()
        assert counts.mean().item() == pytest.approx(expected, rel=0.15)
        assert counts.min().item() >= 0.85 * min(low, room)
    trucks = (scenario.shape.truck & scenario.active).sum() / scenario.active.sum()
    assert trucks.item() == pytest.approx(config.truck_ratio, abs=0.02)
    box = boxes(scenario.shape, scenario.state)
    assert not agent_contacts(box, scenario.active, truck_slots(256, config))[0].any()


def test_standing_and_scripted_vehicles_follow_their_lanes(bundle):
    """They stay on their lane's centre, stop behind what stands, and nobody trains on them."""
    script = ScriptConfig(standing_worlds=0.5, scripted_worlds=0.5, most_standing=2)
    scenarios = ScenarioConfig(agent_scale=0.2, script=script)
    env = Environment([bundle], 24, 24, TaskConfig(scenarios=scenarios), training=False)
    kind, scripted = env.worlds.kind, env.worlds.script.scripted
    assert set(kind.tolist()) == {STANDING, SCRIPTED}
    assert (scripted & env.worlds.active).any(-1).float().mean() > 0.75  # not where a free road has few
    still = scripted & (kind == STANDING).unsqueeze(-1)
    node, begin = torch.from_numpy(bundle.graph.node_xy), env.worlds.state
    moving = scripted & ~still
    for _ in range(40):
        step = env.step(torch.zeros_like(env.worlds.goal_node))
        assert not (step.active & env.worlds.script.scripted & ~step.over.unsqueeze(-1)).any()
        same = ~step.over.unsqueeze(-1) & env.worlds.active
        still, moving = still & same, moving & same
    after = env.worlds.state
    assert still.any() and (after.xy[still] == begin.xy[still]).all()
    assert moving.any() and (after.xy - begin.xy)[moving].norm(dim=-1).median() > 5.0
    assert torch.cdist(after.xy[moving], node).min(-1).values.max() < 0.6
