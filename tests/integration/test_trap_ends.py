"""Runs that break off: outputs closed, the cause named, nothing left behind, the same seed the same bytes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import torch

from phase_sumo.bridge.run import run_scenario
from phase_sumo.errors import PhaseError
from tests.helpers.scenario_files import FLOW, TYPES, write_scenario
from tests.helpers.standin import Standin

OUTPUTS = '<fcd-output value="fcd.xml"/><tripinfo-output value="trips.xml"/>'
VEHICLE = '<vehicle id="{}" type="car" depart="{}" departSpeed="20"><route edges="{}"/></vehicle>'
FIRST = VEHICLE.format("a", 0, "main0 main1 main2")


@pytest.mark.parametrize(
    ("later", "message"),
    [
        (VEHICLE.format("b", 5, "main2 onramp1"), "SUMO stopped at 5 s: .*'b' has no valid route"),
        (VEHICLE.format("b", 30, "main0 nowhere"), "edge 'nowhere' within the route for vehicle 'b'"),
        ('<person id="p" depart="5"><walk edges="main0"/></person>', "SUMO stopped at 5 s: .*sidewalk"),
    ],
)
def test_fatal_errors_during_the_run(tmp_path, later, message):
    """And the same vehicles run again in the same process: poses told and not stepped to are gone."""
    cfg = write_scenario(tmp_path, FIRST + later, options=OUTPUTS + '<route-steps value="2"/>')
    with pytest.raises(PhaseError, match=message):
        run_scenario(cfg, policy=Standin(), output_dir=tmp_path / "out")
    for name in ("fcd.xml", "trips.xml"):
        ET.parse(tmp_path / "out" / name)  # closed
    assert not (tmp_path / "out" / "result.json").exists()
    (tmp_path / "demand.rou.xml").write_text(f"<routes>{TYPES}{FIRST}</routes>")
    assert run_scenario(cfg, policy=Standin(), end=2.0)["vehicles"] == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [("<routes><vehicle", "demand.rou.xml"), ("<routes/> <routes", "demand.rou.xml"), ("", "demand.rou.xml")],
)
@pytest.mark.parametrize("model", [None, "idm"])
def test_damaged_route_files(tmp_path, text, message, model):
    cfg = write_scenario(tmp_path)
    (tmp_path / "demand.rou.xml").write_text(text + "<vType" * bool(text))
    with pytest.raises(PhaseError, match=message):
        run_scenario(cfg, share=0.0, model=model, output_dir=tmp_path / "out")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["run", "compare"])
def test_a_signal_ends_it_cleanly(tmp_path, command, number):
    """To the process alone; a terminal's Ctrl-C reaches the simulation processes as well."""
    cfg = write_scenario(tmp_path, FLOW.format(begin=0, end=3000), options=OUTPUTS + '<end value="4000"/>')
    models = ["--models", "idm"] if command == "compare" else ["--share", "0.3"]
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "phase_sumo", command, str(cfg), "--out", str(out), *models],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        begun = time.monotonic()
        while time.monotonic() - begun < 120:
            if any(path.stat().st_size > 0 for path in out.rglob("fcd.xml")):
                break
            time.sleep(0.1)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            process.kill()
    assert process.returncode == 130, said
    assert "phase-sumo: stopped" in said
    assert "Traceback" not in said
    (fcd,) = out.rglob("fcd.xml")
    ET.parse(fcd)
    assert not list(out.rglob("result.json")) and not list(out.rglob("report.html"))
    assert gone(process.pid, within=10.0)


def gone(session: int, within: float) -> bool:
    """Whether nobody of a session is left after some seconds: Python's own helper process goes last."""
    begun = time.monotonic()
    while time.monotonic() - begun < within:
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.parametrize("threads", [1, 2])
def test_same_seed_same_bytes(tmp_path, threads):
    flow = FLOW.format(begin=0, end=15).replace('period="2"', 'probability="0.4" departLane="best"')
    cfg = write_scenario(tmp_path, flow, options=OUTPUTS)
    torch.set_num_threads(threads)
    try:
        for name in ("one", "two"):
            run_scenario(cfg, policy=Standin(), seed=5, end=25.0, output_dir=tmp_path / name)
    finally:
        torch.set_num_threads(1)
    for name in ("events.csv", "trips.csv", "fcd.xml", "trips.xml"):
        first, second = (content(tmp_path / folder / name) for folder in ("one", "two"))
        assert first == second, name
        assert first or name == "events.csv"


def content(path: Path) -> list[str]:
    """Lines without SUMO's header, which holds the date."""
    lines = path.read_text().splitlines()
    begin = next((i for i, line in enumerate(lines) if line.startswith("-->")), -1)
    return lines[begin + 1 :]
