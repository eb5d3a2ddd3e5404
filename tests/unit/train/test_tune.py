"""The table of settings to tune, and a study that two commands add to."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

from phase_sumo.cli.files import TUNE_TABLE
from phase_sumo.errors import PhaseError
from phase_sumo.train.presets import preset
from phase_sumo.train.tune import changed, read_table, tune

SMALL = dataclasses.replace(preset("smoke"), worlds=4, slots=6, total_steps=300)


def table(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(("setting,low,high,scale", *rows)))
    return path


def test_the_shipped_table_fits_the_presets():
    ranges = read_table(TUNE_TABLE, preset("phase"))
    assert len({r.setting for r in ranges}) == len(ranges) > 5


def test_a_nested_setting_is_changed_alone_and_whole_numbers_stay_whole():
    config = changed(preset("phase"), "actions.prior_jerk", 1.5)
    assert config == dataclasses.replace(
        preset("phase"), actions=dataclasses.replace(config.actions, prior_jerk=1.5)
    )
    assert changed(config, "minibatch", 700.4).minibatch == 700


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("speed,1,2,linear", "no number 'speed'"),
        ("reward.speeds,1,2,linear", "RewardConfig has no number 'speeds'"),
        ("reweight,0,1,linear", "no number 'reweight'"),
        ("reward,0,1,linear", "no number 'reward'"),
        ("gamma,0.99,0.9,linear", "no range"),
        ("gamma,0,1,log", "no range"),
        ("gamma,0.9,1,", "no range"),
        ("gamma,high,1,linear", "no range"),
    ],
)
def test_bad_tables_are_refused(tmp_path, row: str, words: str):
    with pytest.raises(PhaseError, match=words):
        read_table(table(tmp_path / "t.csv", row), preset("phase"))


def test_tables_that_are_missing_or_empty_are_refused(tmp_path):
    with pytest.raises(PhaseError, match="cannot be read"):
        read_table(tmp_path / "none.csv", preset("phase"))
    with pytest.raises(PhaseError, match="no settings to tune"):
        read_table(table(tmp_path / "t.csv"), preset("phase"))


def test_a_study_is_continued_by_the_next_command(straight_map, tmp_path, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setattr("phase_sumo.train.held_out.WORLDS", 2)
    monkeypatch.setattr("phase_sumo.train.tune.JUDGED", 1)
    rows = table(tmp_path / "t.csv", "learning_rate,1e-4,1e-3,log")
    for trials in (1, 2):
        result = tune(tmp_path / "study", SMALL, [straight_map], [straight_map], 1, rows)
        assert result["trials"] == trials
    assert 1e-4 <= result["settings"]["learning_rate"] <= 1e-3
    assert Path(result["policy"]).is_file() and 0.0 <= result["goal_rate"] <= 1.0


def test_without_optuna_the_remedy_is_named(straight_map, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(PhaseError, match=r"phase-sumo\[tune\]"):
        tune(tmp_path, SMALL, [straight_map], [straight_map], 1, TUNE_TABLE)
