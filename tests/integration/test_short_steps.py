"""Steps of SUMO shorter than the policy's: the same driving in finer steps, as SUMO itself reports it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phase_sumo.bridge.run import run_scenario
from tests.helpers.parity_scenes import SCENE, write_scenario
from tests.helpers.standin import Standin

FCD = '<fcd-output value="fcd.xml"/><fcd-output.acceleration value="true"/><precision value="6"/>'
COLUMNS = ("x", "y", "speed", "acceleration")
DRIVEN = {name: speed for name, kind, *_, speed in SCENE if kind != "native"}


def run(folder: Path, step: float, end: float) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Result, and [n, 5] of each vehicle: when SUMO had the state, and `COLUMNS` of it."""
    cfg = write_scenario(folder, "f12_scurve2", SCENE, step, FCD)
    out = folder / "out"
    result = run_scenario(cfg, policy=Standin(), guard=False, seed=1, end=end, output_dir=out, record=False)
    rows = defaultdict(list)
    for frame in ET.parse(folder / "out" / "fcd.xml").getroot():
        time = float(frame.get("time", "nan")) + step  # SUMO's label is when the step began
        for vehicle in frame:
            rows[vehicle.get("id", "")].append([time, *(float(vehicle.get(n, "nan")) for n in COLUMNS)])
    return result, {vehicle: np.array(values) for vehicle, values in rows.items()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run(tmp_path_factory.mktemp("whole"), 0.1, 4.0)[1]


@pytest.mark.parametrize(("step", "end", "arrived"), [(0.05, 40.0, 6), (0.02, 5.0, 0)])
def test_vehicles_drive_as_at_the_policys_step(tmp_path, whole, step, end, arrived):
    result, paths = run(tmp_path, step, end)
    assert result["phase_vehicles"] == 6
    assert result["phase_arrived_under_policy"] == result["arrived"] == arrived
    assert result["collisions"] == 0
    for vehicle in DRIVEN:
        check_continuity(paths[vehicle], step)
        check_nearness(paths[vehicle], whole[vehicle][:30], DRIVEN[vehicle] * (0.1 - step))


@pytest.mark.parametrize("step", [0.1, 0.05])
def test_time_and_way_under_the_policy(tmp_path, step):
    """By SUMO's own poses; the policy decides as often at either step."""
    result, paths = run(tmp_path, step, 5.0)
    ways = [np.hypot(*np.diff(paths[v][:, 1:3], axis=0).T).sum() for v in DRIVEN]
    assert 1000.0 * result["phase_vehicle_km"] == pytest.approx(sum(ways), rel=1e-3)
    seconds = 5.0 - step  # from the insertion on
    assert result["share_of_time_under_policy"] == pytest.approx(seconds / 5.0, abs=1e-6)
    assert result["fleet"]["decisions"] == 6 * 49


def check_continuity(path: np.ndarray, step: float) -> None:
    """The way of each step is speed x step; acceleration is the change of speed and within the model's."""
    _, x, y, speed, accel = path.T
    np.testing.assert_allclose(np.hypot(np.diff(x), np.diff(y)), speed[1:] * step, rtol=0, atol=1e-3)
    np.testing.assert_allclose(np.diff(speed), accel[1:] * step, rtol=0, atol=2e-6)
    assert accel.min() > -8.001
    assert accel.max() < 4.001


def check_nearness(path: np.ndarray, whole: np.ndarray, start: float) -> None:
    """3 s of both; SUMO's first step inserts the vehicles, after a shorter one they are ``start`` m ahead."""
    here = path[np.searchsorted(path[:, 0], whole[:, 0] - 1e-6)]
    np.testing.assert_allclose(here[:, 0], whole[:, 0], atol=1e-6)
    ahead = np.hypot(*(here[:, 1:3] - whole[:, 1:3]).T) - start
    assert np.abs(ahead[:10]).max() < 0.1
    assert np.abs(ahead).max() < 0.6
    assert np.abs(here[:, 3] - whole[:, 3]).max() < 0.25
