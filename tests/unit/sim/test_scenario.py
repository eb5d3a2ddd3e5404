"""Scenarios beyond the paper's: agents that begin out of line with their lane, and tight curves."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import REGIMES, ScenarioConfig, SimConfig
from phase_sumo.sim.curve_speed import SIDEWAYS, SIDEWAYS_TRUCK, curvature
from phase_sumo.sim.scenario import PairTable, RegimeTable, Scenario, sample
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
            PairTable(pools, "cpu"),
            RegimeTable.of(list(REGIMES), 0.25, SLOTS, "cpu"),
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
    bend = torch.from_numpy(curvature(ramp.graph))

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
