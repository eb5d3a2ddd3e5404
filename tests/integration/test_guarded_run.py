"""The guard in a run of SUMO: who looks at nobody hits nobody, and every intervention is counted."""

from __future__ import annotations

import csv
import json

import pytest

from phase_sumo.bridge.run import run_scenario
from phase_sumo.cli import main
from tests.helpers.rules_run import RAMP, Run
from tests.helpers.scenario_files import write_scenario
from tests.helpers.standin import Standin

# Three that PHASE drives, fast and looking at nobody, come up to slow ones that SUMO drives
SLOW = '<vType id="slow" length="4.8" maxSpeed="12"><param key="has.phase.device" value="false"/></vType>'
FAST = '<vType id="fast" length="4.8" maxSpeed="30">{}</vType>'
VEHICLE = (
    '<vehicle id="{0}" type="{1}" depart="0" departLane="{2}" departPos="{3}" departSpeed="{4}" '
    'insertionChecks="none"><route edges="main0 main1 main2"/></vehicle>'
)


def traffic(param=""):
    ones = [(f"w{k}", "slow", k, 170, 12) for k in range(3)] + [
        (f"v{k}", "fast", k, 30, 28) for k in range(3)
    ]
    return SLOW + FAST.format(param) + "".join(VEHICLE.format(*one) for one in ones)


def drive(folder, param="", **changes):
    cfg = write_scenario(folder, traffic(param))
    options = {"policy": Standin(reckless=True), "time_gap": 0.0, "alpha": 0.8, "end": 14.0} | changes
    result = run_scenario(cfg, output_dir=folder / "out", record=False, **options)
    with (folder / "out" / "trips.csv").open(newline="") as file:
        return result, {trip["vehicle"]: trip for trip in csv.DictReader(file)}


def test_with_the_guard_nobody_is_run_into_and_without_they_are(tmp_path):
    result, trips = drive(tmp_path)
    assert result["collisions"] == 0 and result["phase_vehicles"] == 3
    assert result["guard_leader"] > 10 and 0 < result["guard_share_of_decisions"] < 1
    reasons = ("leader", "beside", "road_edge", "standing")
    assert result["guard_interventions"] == sum(result[f"guard_{name}"] for name in reasons)
    assert result["guard_interventions"] == sum(
        int(trip[f"guard_{name}"]) for trip in trips.values() for name in reasons
    )
    assert all(
        int(trips[f"v{k}"]["guard_leader"]) > 0 == int(trips[f"w{k}"]["guard_leader"]) for k in range(3)
    )
    assert result["guard_seconds"] == pytest.approx(0.1 * result["guard_interventions"], abs=0.01)
    assert json.loads((tmp_path / "out" / "result.json").read_text())["guard_jerk"] > 10.0
    assert result["guard_cpu_us_per_vehicle_step"] > 0
    off, trips = drive(tmp_path, guard=False)
    assert off["phase_at_fault_collisions"] == 3 and off["guard_interventions"] == 0
    assert off["guard_cpu_us_per_vehicle_step"] == 0


@pytest.mark.parametrize(("param", "guard", "collisions"), [("off", True, 3), ("on", False, 0)])
def test_a_types_own_word_wins_over_the_runs(tmp_path, param, guard, collisions):
    result, _ = drive(tmp_path, f'<param key="phase.guard" value="{param}"/>', guard=guard)
    assert result["phase_at_fault_collisions"] == collisions


def test_the_command_line_turns_it_off(tmp_path, capsys):
    cfg = write_scenario(tmp_path, traffic())
    found = []
    for words in ([], ["--guard", "off"]):
        out = tmp_path / "result.json"
        main(["run", str(cfg), "--alpha", "0.8", "--end", "3", "--json", str(out), *words])
        found.append(json.loads(out.read_text())["guard_cpu_us_per_vehicle_step"] > 0)
    assert found == [True, False]


def test_who_brakes_for_the_line_of_a_ramp_is_no_leader_on_the_main_road(tmp_path):
    """It used to make the main road brake from 22 to 10 m/s."""
    cars = (
        '<flow id="main" type="car" from="m0" to="m1" begin="0" end="20" period="2.5" departLane="0" '
        'departSpeed="24"/><flow id="side" type="car" from="on" to="m1" begin="0" end="4" period="5" '
        'departSpeed="18"/>'
    )
    run = Run(tmp_path, RAMP, cars, end=40)
    assert "others have the right of way" in run.reasons()
    assert run.result["collisions"] == run.result["guard_leader"] == 0
