"""SUMO's routeLength of vehicles that are moved, on a straight road where x is the way driven."""

from __future__ import annotations

import itertools
import signal
import subprocess
from itertools import pairwise

import numpy as np
import pytest
import sumolib
import torch
from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.fleet.controller import Controller
from phase_sumo.bridge.fleet.event_log import read_events
from phase_sumo.bridge.fleet.fleet import Fleet
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.outputs.lane_records import LaneChanges
from phase_sumo.bridge.run import run_scenario
from phase_sumo.bridge.sumo.session import Simulation
from tests.helpers.scenario_files import write_scenario
from tests.helpers.standin import Standin

JOINTS = (0, 250, 500, 560, 600, 850, 1100)  # m: between edges
START = 20.0  # m
FLOW = (
    f'<flow id="m" type="car" from="e0" to="e5" begin="0" end="18" period="2.13" departLane="1" '
    f'departSpeed="avg" departPos="{START:g}"/>'
)


def road(folder, internal=True, city=()):
    """Three lanes to the east, 3.2 m apart; city streets among the edges are SUMO's to drive."""
    nodes = "".join(f'<node id="n{i}" x="{x}" y="0"/>' for i, x in enumerate(JOINTS))
    edges = "".join(
        f'<edge id="e{i}" from="n{i}" to="n{i + 1}" numLanes="3" speed="36" '
        f'type="highway.{"residential" if i in city else "motorway"}"/>'
        for i in range(len(JOINTS) - 1)
    )
    (folder / "s.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "s.edg.xml").write_text(f"<edges>{edges}</edges>")
    args = [f"-n{folder / 's.nod.xml'}", f"-e{folder / 's.edg.xml'}", f"-o{folder / 's.net.xml'}"]
    args += ["--no-internal-links", str(not internal).lower()]
    subprocess.run([sumolib.checkBinary("netconvert"), *args], check=True, capture_output=True)
    return folder / "s.net.xml"


@pytest.fixture
def slalom(monkeypatch):
    """A lane change over the end of each edge, one back behind it, and once off the road."""
    drive = Controller._next

    def bump(x, begin, end):
        return torch.sigmoid((x - begin) / 2.0) - torch.sigmoid((x - end) / 2.0)

    def follow(self, rows, driver, every):
        state = drive(self, rows, driver, every)
        state.x[:] = state.x - 0.01 * state.speed  # a tenth of the step: SUMO drives it further
        state.y[:] = -4.8 + 7.0 * bump(state.x, 300.0, 340.0)
        for joint in JOINTS[1:-1]:
            state.y[:] += 3.2 * bump(state.x, joint - 2.0, joint + 14.0)
        state.yaw[:], state.steer[:] = 0.0, 0.0
        return state

    monkeypatch.setattr(Controller, "_next", follow)


def outputs(folder):
    wanted = ("fcd-output", "tripinfo-output", "statistic-output", "lanechange-output")
    options = [part for name in wanted for part in (f"--{name}", str(folder / f"{name}.xml"))]
    return [*options, "--precision", "6", "--tripinfo-output.write-unfinished", "true"]


def parsed(folder, name):
    return etree.parse(str(folder / f"{name}-output.xml")).getroot()


def check_lengths(folder, internal):
    """Compare routeLength with x, by vehicle and in the mean; returns which trips have arrived."""
    last = {v.get("id"): float(v.get("x")) for frame in parsed(folder, "fcd") for v in frame}
    trips = parsed(folder, "tripinfo").findall("tripinfo")
    arrived = [float(t.get("arrival")) >= 0 for t in trips]
    length, speed = [], []
    for trip, done in zip(trips, arrived, strict=True):
        left = 250.0 - float(trip.get("arrivalPos"))  # of the last edge
        x = JOINTS[-1] - left if done else last[trip.get("id")]
        passed = sum(a <= x for _, a in pairwise(JOINTS)) - done
        length.append(float(trip.get("routeLength")))
        speed.append(length[-1] / float(trip.get("duration")))
        # lanes inside junctions are 0.1 m long, and their ends are in one place
        assert length[-1] == pytest.approx(x - START + internal * 0.1 * passed, abs=0.11)
    mean = parsed(folder, "statistic").find("vehicleTripStatistics")
    assert float(mean.get("routeLength")) == pytest.approx(np.mean(length), abs=1e-4)
    assert float(mean.get("speed")) == pytest.approx(np.mean(speed), abs=1e-4)
    return arrived


@pytest.mark.parametrize(
    ("step", "internal", "city"),
    [(0.1, True, (0, 3, 5)), (0.5, False, ()), (0.5, True, (5,)), (1.0, True, ()), (1.0, True, (0, 3, 5))],
)
def test_route_lengths_are_the_way_driven(tmp_path, slalom, step, internal, city):
    net = road(tmp_path, internal, city)
    inside = {float(lane.get("length")) for lane in etree.parse(str(net)).iterfind("edge[@function]/lane")}
    assert sorted(inside) == ([0.1] if internal else [])
    run_scenario(
        write_scenario(tmp_path, FLOW, net=net, step=step), policy=Standin(), seed=1, end=46,
        sumo_options=outputs(tmp_path), output_dir=tmp_path / "out", record=False,
    )  # fmt: skip
    turns = [e for e in read_events(tmp_path / "out" / "events.csv") if e.kind in ("adoption", "hand-back")]
    assert len(turns) >= 9
    assert {e.kind for e in turns} == ({"adoption", "hand-back"} if city else {"adoption"})
    arrived = check_lengths(tmp_path, internal)
    assert len(arrived) == 9 and 1 < sum(arrived) < 9


def test_trips_end_soon_after_their_arrival_position(tmp_path, slalom):
    flow = FLOW.replace("departPos", 'arrivalPos="100" departPos')
    result = run_scenario(
        write_scenario(tmp_path, flow, net=road(tmp_path), step=1.0), policy=Standin(), seed=1, end=46,
        sumo_options=outputs(tmp_path), output_dir=tmp_path / "out", record=False,
    )  # fmt: skip
    arrived = check_lengths(tmp_path, internal=True)
    ends = [float(t.get("arrivalPos")) for t in parsed(tmp_path, "tripinfo").findall("tripinfo")]
    assert all(100.0 <= at < 180.0 if done else at == -1.0 for at, done in zip(ends, arrived, strict=True))
    assert any(arrived)
    assert not [warning for warning in result["warnings"] if "arrivalPos" in warning]


@pytest.mark.parametrize(
    "place", [(Simulation, "step"), (Scene, "update"), (LaneChanges, "update"), (Fleet, "drive")]
)
def test_files_of_an_interrupted_run_are_right_up_to_there(tmp_path, slalom, monkeypatch, place):
    """Wherever Ctrl-C comes: the step is done first."""
    work, calls = getattr(*place), itertools.count()

    def interrupted(*args):
        if next(calls) == 54:
            signal.raise_signal(signal.SIGINT)
        work(*args)

    monkeypatch.setattr(*place, interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_scenario(
            write_scenario(tmp_path, FLOW, net=road(tmp_path), step=0.5), policy=Standin(), seed=1, end=60,
            sumo_options=outputs(tmp_path), output_dir=tmp_path / "out",
        )  # fmt: skip
    assert len(check_lengths(tmp_path, internal=True)) == 9
    expected, last = set(), {}
    for frame in parsed(tmp_path, "fcd"):
        for seen in frame:
            name, lane = seen.get("id"), seen.get("lane")
            edge, _, index = last.get(name, lane).rpartition("_")
            if lane.startswith(f"{edge}_") and not lane.endswith(f"_{index}"):
                expected.add((name, float(frame.get("time")), last[name], lane))
            last[name] = lane or last[name]
    changes = parsed(tmp_path, "lanechange")
    found = {(c.get("id"), float(c.get("time")), c.get("from"), c.get("to")) for c in changes}
    assert len(expected) > 20 and found >= expected
    assert {c.get("reason") for c in changes} == {"traci"}
    assert not (tmp_path / "out" / "result.json").exists()
