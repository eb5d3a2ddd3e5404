"""SUMO's own trajectory output against the model's states."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from phase_sumo.bridge.maps.sumo_network import read_network
from tests.helpers.parity_scenes import SCENE, write_scenario
from tests.helpers.places import NETWORKS
from tests.helpers.standin import Standin
from tests.parity.recording import Recording, record

FCD = '<fcd-output value="fcd.xml"/><fcd-output.acceleration value="true"/><precision value="9"/>'


@pytest.mark.parametrize(
    ("road", "step", "reckless"),
    [
        ("f12_scurve2", 0.05, False),
        ("f12_scurve2", 0.1, False),
        ("f12_scurve2", 1.0, False),
        ("f04_onramp3", 0.025, False),
        ("f04_onramp3", 0.1, True),
        ("f04_onramp3", 0.5, False),
    ],
)
def test_fcd_output_is_the_models_state(tmp_path, road, step, reckless):
    """On curves, above limit and vType maximum, through collisions, at steps below and above the policy's.

    SUMO's acceleration is the change of speed over its step: up to the policy's step that is the model's own
    but for the float32 rounding of speeds near 30 m/s.
    """
    network = read_network(NETWORKS / f"{road}.net.xml")
    cfg = write_scenario(tmp_path, road, SCENE, step, FCD)
    kept = record(cfg, network, Standin(reckless), until=8.0)
    error = errors(kept, sumo_rows(tmp_path / "fcd.xml"), step)
    assert len(error) > 30
    np.testing.assert_array_less(error[:, :5].max(0), 1e-6)
    if step <= Standin().sim.dt:
        assert error[:, 5].max() < 3e-6 / step
    speeds = [float(state["speed"]) for s in kept.steps for state in s.table.values()]
    assert max(speeds) > 31.0 if reckless else min(speeds) < 17.0


def sumo_rows(path: Path) -> dict[tuple[float, str], dict[str, str]]:
    """(time, id) -> attributes; SUMO labels a step with the time at which it began."""
    return {
        (round(float(frame.get("time", "nan")), 3), vehicle.get("id", "")): dict(vehicle.attrib)
        for frame in ET.parse(path).getroot()
        for vehicle in frame
    }


def errors(kept: Recording, rows: dict[tuple[float, str], dict[str, str]], step: float) -> np.ndarray:
    """[n, 6] differences of x, y, angle, speed, change of speed and the model's acceleration, in SI units."""
    found = []
    before: dict[str, float] = {}
    for sumo in kept.steps:
        for vehicle, state in sumo.table.items():
            if vehicle.startswith("native"):
                continue
            row = rows[round(sumo.time - step, 3), vehicle]
            x, y, yaw, speed, accel = (float(state[n]) for n in ("x", "y", "yaw", "speed", "accel"))
            ahead = kept.shapes[vehicle].length - kept.shapes[vehicle].rear_overhang
            angle = np.radians(90.0 - float(row["angle"]))
            change = (speed - before.get(vehicle, np.nan)) / step
            before[vehicle] = speed
            found.append(
                (
                    abs(float(row["x"]) - x - ahead * np.cos(yaw)),
                    abs(float(row["y"]) - y - ahead * np.sin(yaw)),
                    abs(np.sin(angle - yaw)),
                    abs(float(row["speed"]) - speed),
                    abs(float(row["acceleration"]) - change),
                    abs(float(row["acceleration"]) - accel),
                )
            )
    error = np.array(found)
    return error[np.isfinite(error).all(1)]  # all but each vehicle's first row, which is SUMO's own
