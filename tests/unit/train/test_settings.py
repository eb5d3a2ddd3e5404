"""Single settings of a training from the command line."""

from __future__ import annotations

import pytest

from phase_sumo.config import TrainConfig
from phase_sumo.errors import PhaseError
from phase_sumo.train.settings import with_settings


def test_settings_are_set_wherever_they_are_nested():
    settings = ["reward.collision=2", "worlds=4e1", "bf16=false", "sim.accel_bounds=(-6.0, 3.0)"]
    config = with_settings(TrainConfig(), [*settings, "scenarios.script.slots=0.2"])
    assert config.reward.collision == 2.0 and isinstance(config.reward.collision, float)
    assert config.worlds == 40 and isinstance(config.worlds, int)
    assert config.bf16 is False
    assert config.sim.accel_bounds == (-6.0, 3.0)
    assert config.scenarios.script.slots == 0.2
    assert config.reward.goal == TrainConfig().reward.goal


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("reward.colision=2", "no setting 'colision'; did you mean collision"),
        ("reward=2", "write reward.NAME=VALUE"),
        ("worlds.x=2", "write worlds=VALUE"),
        ("worlds=many", "expected int"),
        ("worlds=1.5", "expected int"),
        ("gamma", "write KEY=VALUE"),
    ],
)
def test_what_cannot_be_set_is_refused_by_name(setting, message):
    with pytest.raises(PhaseError, match=message):
        with_settings(TrainConfig(), [setting])
