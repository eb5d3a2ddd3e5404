"""The curve: rows appended, columns that come later, and the cut to a checkpoint."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from phase_sumo.errors import PhaseError
from phase_sumo.train import tensorboard
from phase_sumo.train.curve import Curve
from phase_sumo.train.tensorboard import TensorBoardLog
from tests.helpers.curves import read_curve, read_tensorboard


def steps(run: Path) -> list[int]:
    return [int(row["steps"]) for row in read_curve(run)]


@pytest.fixture
def grown(tmp_path: Path) -> Path:
    curve = Curve(tmp_path / "curve.csv", 0)
    for number in (1_234_567_890, 1_234_567_891, 1_234_567_895):
        curve.add({"steps": number, "goal_rate": 0.25})
    return tmp_path / "curve.csv"


def test_it_is_cut_at_exact_steps(grown: Path):
    assert Curve(grown, 1_234_567_891).last == {"steps": 1_234_567_891, "goal_rate": 0.25}
    assert steps(grown.parent) == [1_234_567_890, 1_234_567_891]
    assert Curve(grown, 0).last == {} and steps(grown.parent) == []


@pytest.mark.parametrize("torn", ["1", "1234567", "1234567896,0.2", "\0\0\0"])
def test_a_torn_row_is_cut_off(grown: Path, torn: str):
    with grown.open("a") as file:
        file.write(torn)
    Curve(grown, 1_234_567_895).add({"steps": 1_234_567_899, "goal_rate": 0.5})
    assert steps(grown.parent) == [1_234_567_890, 1_234_567_891, 1_234_567_895, 1_234_567_899]


def test_columns_that_come_later_widen_it(grown: Path):
    curve = Curve(grown, 1_234_567_895)
    curve.add({"steps": 1_234_567_896, "goal_rate": 0.5, "held_out_goal_rate": 0.75})
    curve.add({"steps": 1_234_567_897, "goal_rate": 0.5})
    assert [row["held_out_goal_rate"] for row in read_curve(grown.parent)] == ["", "", "", "0.75", ""]
    assert Curve(grown, 1_234_567_896).last["held_out_goal_rate"] == 0.75


def test_tensorboard_goes_on_where_the_checkpoint_was(tmp_path: Path):
    for begin, end in ((0, 5), (3, 7)):
        with TensorBoardLog(tmp_path, begin) as log:
            for step in range(begin + 1, end + 1):
                log.add({"steps": step, "goal_rate": 0.5, "reward_goal": 1.0, "held_out_goal_rate": 0.4})
    points = read_tensorboard(tmp_path)
    assert points.keys() == {
        "training/steps",
        "training/goal_rate",
        "reward/goal",
        "held_out/goal_rate",
    }
    assert all(seen == [1, 2, 3, 4, 5, 6, 7] for seen in points.values())


def test_a_disk_too_full_for_tensorboard_stops_with_the_same_message(tmp_path: Path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(tensorboard.shutil, "disk_usage", lambda _: usage._replace(free=7))
    message = rf"{os.strerror(errno.ENOSPC)}.*: 128 bytes needed, 7 free"
    with TensorBoardLog(tmp_path, 0) as log, pytest.raises(PhaseError, match=message):
        log.add({"steps": 1, "goal_rate": 0.5})
