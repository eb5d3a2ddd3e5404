"""A short drive with known numbers: kinematics, events and reward must not change unnoticed."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from phase_sumo.config import RewardConfig, SimConfig
from phase_sumo.sim import kinematics
from tests.golden.scene import EXPECTED, play

WRITE_ANEW = "if this change is meant: python -m tests.golden.scene"


def differences(found: Any, expected: Any, name: str = "") -> list[str]:
    """Where two results differ by more than rounding."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), WRITE_ANEW
        return [d for key in expected for d in differences(found[key], expected[key], f"{name} {key}")]
    if np.allclose(found, expected, rtol=1e-5, atol=1e-5):
        return []
    return [f"{name.strip()}: {found} instead of {expected}"]


@pytest.fixture(scope="module")
def expected() -> dict[str, Any]:
    return json.loads(EXPECTED.read_text())


def test_the_drive_is_as_it_was(straight_map, expected):
    found = differences(play(straight_map.road_map), expected)
    assert not found, "\n".join([*found[:10], WRITE_ANEW])


def test_everything_that_can_happen_happens(expected):
    assert all(abs(value) > 1e-3 for value in expected["terms"].values())
    assert all(max(steps) >= 0 for steps in expected["events"].values())


REWARD = [
    *("goal", "lane", "collision", "road_edge", "termination", "alignment", "speed", "progress"),
    *("penalty_growth", "kappa", "ramp_horizon", "progress_decay", "distance_unit"),
]
SIM = [
    *("dt", "max_speed", "accel_bounds", "truck_accel_bounds", "max_steer"),
    *("lateral_accel", "truck_lateral_accel", "min_speed"),
]


def a_thousandth_more(value: Any) -> Any:
    return tuple(1.001 * v for v in value) if isinstance(value, tuple) else 1.001 * value


@pytest.mark.parametrize("name", REWARD)
def test_a_thousandth_of_a_reward_constant_is_noticed(straight_map, expected, name: str):
    config = replace(RewardConfig(), **{name: a_thousandth_more(getattr(RewardConfig(), name))})
    assert differences(play(straight_map.road_map, reward=config), expected)


@pytest.mark.parametrize("name", SIM)
def test_a_thousandth_of_a_constant_of_the_model_is_noticed(straight_map, expected, name: str):
    config = replace(SimConfig(), **{name: a_thousandth_more(getattr(SimConfig(), name))})
    assert differences(play(straight_map.road_map, sim=config), expected)


@pytest.mark.parametrize("name", ["x", "y", "yaw", "speed", "steer", "hitch"])
def test_a_thousandth_of_a_step_is_noticed(straight_map, expected, monkeypatch, name: str):
    """The model itself, off by 1e-3 of one quantity's change per step."""
    right = kinematics.advance

    def wrong(shape, state, jerk, rate, config):
        after = right(shape, state, jerk, rate, config)
        change = getattr(after, name) - getattr(state, name)
        return replace(after, **{name: getattr(after, name) + 1e-3 * change})

    monkeypatch.setattr(kinematics, "advance", wrong)
    assert differences(play(straight_map.road_map), expected)
