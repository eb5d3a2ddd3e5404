"""Training runs that are killed, interrupted or run out of disk, in processes of their own."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
import torch

from phase_sumo.cli import main
from phase_sumo.errors import PhaseError
from phase_sumo.sim.bundle import MapBundle, save_bundle
from phase_sumo.train import disk
from phase_sumo.train.loop import Trainer
from phase_sumo.train.presets import preset
from phase_sumo.train.run_folder import RunFolder
from tests.helpers.curves import read_curve, read_tensorboard

PART = f"{os.getpid()}.part"  # end of the names of files that are being written
CONFIG = dataclasses.replace(
    preset("smoke"), worlds=8, slots=8, rollout=4, minibatch=32, total_steps=1600, checkpoint_every=1
)
# what differs between two runs that do the same
CLOCKS = {"wall_seconds", "rollout_cpu_us", "learn_cpu_us", "peak_memory_mb"}
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks, and fills /dev/full")


def start(work: Callable[[], object]) -> BaseProcess:
    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    return process


def train(road: MapBundle, path: Path) -> None:
    """Begin the run, or go on with it."""
    folder = RunFolder(path)
    Trainer(CONFIG, [road], [], folder, resume=(path / "config.json").exists()).run()


def die_while_writing(road: MapBundle, path: Path, moment: str, count: int) -> None:
    """Train until the ``count``-th checkpoint, and be killed when half of it is written or just after."""
    fsync, replace = os.fsync, os.replace
    written: list[str] = []

    def half(handle: int) -> None:
        fsync(handle)
        written.append(str(Path(f"/proc/self/fd/{handle}").readlink()))
        if moment == "half" and sum("checkpoint" in name for name in written) == count:
            os.ftruncate(handle, os.fstat(handle).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    def placed(source: Path, target: Path) -> None:
        replace(source, target)
        if moment == "placed" and sum("checkpoint" in name for name in written) == count:
            os.kill(os.getpid(), signal.SIGKILL)

    disk.os.fsync, disk.os.replace = half, placed  # in this process alone
    train(road, path)


def test_killed_at_any_moment_it_goes_on_bit_for_bit(straight_map, tmp_path):
    began = time.monotonic()
    train(straight_map, tmp_path / "whole")
    whole = time.monotonic() - began
    path = tmp_path / "killed"
    for moment, count in (("half", 1), ("placed", 2), ("half", 3)):
        process = start(lambda m=moment, c=count: die_while_writing(straight_map, path, m, c))
        process.join()
        assert process.exitcode == -signal.SIGKILL
    moments = random.Random(time.time_ns())
    for _ in range(2):
        process = start(lambda: train(straight_map, path))
        time.sleep(moments.uniform(0.0, 0.5 * whole))
        process.kill()
        process.join()
    process = start(lambda: train(straight_map, path))
    process.join()
    assert process.exitcode == 0

    mine, theirs = (RunFolder(tmp_path / name).load() for name in ("whole", "killed"))
    for name, weights in mine["network"].items():
        assert torch.equal(weights, theirs["network"][name]), name
    first, second = (read_curve(tmp_path / name) for name in ("whole", "killed"))
    assert [row.keys() for row in first] == [row.keys() for row in second]
    for a, b in zip(first, second, strict=True):
        assert {k: v for k, v in a.items() if k not in CLOCKS} == {
            k: v for k, v in b.items() if k not in CLOCKS
        }
    steps = [int(row["steps"]) for row in first]
    for name in ("whole", "killed"):
        points = read_tensorboard(tmp_path / name)
        assert points.keys() and all(seen == steps for seen in points.values())
    assert not list(path.glob("*.part")) and (path / "policy.safetensors").exists()


def test_an_interrupted_run_leaves_a_checkpoint_of_its_last_update(straight_map, tmp_path, capfd):
    save_bundle(tmp_path / "straight.npz", straight_map)
    run = tmp_path / "run"
    common = ["train", "--networks", str(tmp_path / "straight.npz"), "--run", str(run), "--preset", "smoke"]
    process = start(lambda: os._exit(main(common)))
    while process.is_alive() and not read_curve(run):
        time.sleep(0.05)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGINT)
    process.join()
    assert process.exitcode == 130
    assert RunFolder(run).load()["steps"] == int(read_curve(run)[-1]["steps"]) > 0
    said = capfd.readouterr()
    assert "peak memory" in said.out and said.err.count("stopped") == 1


@pytest.mark.parametrize("name", [f"checkpoint.pt.{PART}", f"policy.safetensors.{PART}", "curve.csv"])
def test_a_full_disk_stops_it_with_one_message(straight_map, tmp_path, name: str):
    # the curve is full in the middle of an update, the others at a checkpoint
    config = CONFIG if "part" in name else dataclasses.replace(CONFIG, checkpoint_every=10**9)
    trainer = Trainer(config, [straight_map], [], RunFolder(tmp_path))
    updates: list[dict[str, float]] = []

    def fill_the_disk(row: dict[str, float]) -> None:
        updates.append(row)
        if len(updates) == 2:
            (tmp_path / name).unlink(missing_ok=True)
            (tmp_path / name).symlink_to("/dev/full")

    with pytest.raises(
        PhaseError, match=r"No space left.* [\d,]+ bytes needed, [\d,]+ free.*--resume"
    ) as said:
        trainer.run(fill_the_disk)
    assert str(tmp_path) in str(said.value) and "\n" not in str(said.value)
    if name == "curve.csv":
        (tmp_path / name).unlink()
    again = Trainer(CONFIG, [straight_map], [], RunFolder(tmp_path), resume=True)
    again.run(stopping=lambda: again.steps >= updates[-1]["steps"])
    assert RunFolder(tmp_path).load()["steps"] == updates[-1]["steps"]
