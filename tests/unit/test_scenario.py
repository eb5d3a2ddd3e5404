"""Scenarios beyond the paper's: agents that begin out of line with their lane."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.network import read_network
from phase_sumo.config import REGIMES, ScenarioConfig, SimConfig
from phase_sumo.sim.scenario import PairTable, RegimeTable, Scenario, sample
from tests.scenario_files import NETWORKS

WORLDS, SLOTS = 64, 24
JAMMED, DENSE = 0, 1


@pytest.fixture(scope="module")
def bundle():
    return build_bundle(read_network(NETWORKS / "f04_onramp3.net.xml"))


@pytest.fixture
def drawn(bundle):
    def draw(regime: int, **changes) -> Scenario:
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
