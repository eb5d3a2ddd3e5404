"""The shipped policy keeps its lane and reaches goals on networks that it was not trained on."""

from __future__ import annotations

import pytest

from phase_sumo import load_policy
from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import TrainConfig
from phase_sumo.evaluate.synthetic import evaluate_synthetic
from phase_sumo.sim.bundle import MapBundle
from tests.helpers.places import NETWORKS


@pytest.fixture(scope="module")
def held_out() -> list[MapBundle]:
    return [build_bundle(read_network(path)) for path in sorted((NETWORKS / "held_out").glob("*.net.xml"))]


def test_it_reaches_goals_and_stays_on_the_road(held_out: list[MapBundle]):
    policy = load_policy()
    assert policy.info["agent_steps"] >= 10_000_000
    assert not {m.name for m in held_out} & set(policy.info["networks"])
    config = TrainConfig()
    result = evaluate_synthetic(policy, held_out, config.scenarios, 48, config.slots, seed=42)
    assert result["agents"] > 500
    assert result["goal_rate"] > 0.75, result
    assert result["road_collision_rate"] < 0.05, result
    assert result["agent_collision_rate"] < 0.15, result
