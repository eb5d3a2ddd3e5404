"""PHASE in a loop of the caller's own, and how SUMO's files select and condition its vehicles."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys

import libsumo
import pytest
import sumolib
import traci

import phase_sumo
from phase_sumo.bridge.drive_options import DriveOptions
from phase_sumo.bridge.fleet import drivers
from phase_sumo.bridge.run import run_scenario
from phase_sumo.cli import main
from phase_sumo.errors import PhaseError
from tests.helpers.places import ROOT
from tests.helpers.standin import Standin

NETWORK = ROOT / "networks" / "f04_onramp3.net.xml"
TYPES = """
    <vType id="plain" length="4.8" width="1.9" speedFactor="0.8" speedDev="0"/>
    <vType id="yes" length="4.8" width="1.9"><param key="has.phase.device" value="true"/></vType>
    <vType id="no" length="4.8" width="1.9"><param key="has.phase.device" value="false"/></vType>
    <vType id="calm" length="4.8" width="1.9"><param key="phase.alpha" value="0.35"/>
        <param key="phase.target_speed" value="18"/></vType>
"""


def vehicle(name, kind, depart, *params):
    inner = "".join(f'<param key="{key}" value="{value}"/>' for key, value in params)
    return (
        f'<vehicle id="{name}" type="{kind}" depart="{depart}" departLane="best" departSpeed="20">'
        f'<route edges="main0 main1 main2"/>{inner}</vehicle>'
    )


@pytest.fixture
def scenario(tmp_path):
    def write(*vehicles, types=TYPES, end=20):
        (tmp_path / "demand.rou.xml").write_text(f"<routes>{types}{''.join(vehicles)}</routes>")
        path = tmp_path / "test.sumocfg"
        path.write_text(
            f'<configuration><input><net-file value="{NETWORK}"/>'
            '<route-files value="demand.rou.xml"/></input>'
            f'<time><end value="{end}"/><step-length value="0.1"/></time></configuration>'
        )
        return path

    return write


@pytest.fixture
def started(scenario, monkeypatch):
    """A running simulation of libsumo with three vehicles; fleets are closed before it."""
    fleets = []
    begin = phase_sumo.PhaseFleet.__init__
    monkeypatch.setattr(
        phase_sumo.PhaseFleet,
        "__init__",
        lambda self, *a, **k: (begin(self, *a, **k), fleets.append(self))[0],
    )

    def start(*vehicles, options=phase_sumo.SUMO_OPTIONS):
        cars = vehicles or [vehicle(f"v{i}", "plain", 2 * i) for i in range(3)]
        libsumo.start(["sumo", "-c", str(scenario(*cars)), "--no-step-log", "true", *options])
        return libsumo

    yield start
    for fleet in fleets:
        fleet.close()
    libsumo.close()


def run_for(seconds):
    for _ in range(round(10 * seconds)):
        libsumo.simulationStep()


def adopted(folder):
    with (folder / "trips.csv").open() as file:
        return {row["vehicle"] for row in csv.DictReader(file) if row["adopted"] == "1"}


MARKED = [
    vehicle("plain", "plain", 0),
    vehicle("plain_yes", "plain", 1, ("phase.device", "true")),
    vehicle("type_yes", "yes", 2),
    vehicle("type_yes_own_no", "yes", 3, ("phase.device", "false")),
    vehicle("type_no", "no", 4),
    vehicle("type_no_own_yes", "no", 5, ("phase.device", "1")),
    vehicle("named_no", "no", 6, ("phase.device", "false")),
]


@pytest.mark.parametrize(
    ("options", "phase"),
    [
        ({}, {"plain", "plain_yes", "type_yes", "type_no_own_yes"}),
        ({"share": 0.0}, {"plain_yes", "type_yes", "type_no_own_yes"}),
        ({"explicit": ["named_no"]}, {"plain_yes", "type_yes", "type_no_own_yes", "named_no"}),
        ({"phase": False, "explicit": ["named_no"]}, set()),
    ],
    ids=["default", "share-0", "explicit", "no-phase"],
)
def test_selection_has_the_precedence_of_sumos_devices(scenario, tmp_path, options, phase):
    path = scenario(*MARKED, end=10)
    result = run_scenario(path, policy=Standin(), seed=1, output_dir=tmp_path / "out", **options)
    assert adopted(tmp_path / "out") == phase
    assert result["phase_vehicles"] == len(phase)
    assert result["vehicles"] == len(MARKED)


def test_device_options_are_ours_on_both_sides_of_the_dashes(scenario, tmp_path):
    path = scenario(*(vehicle(f"v{i}", "plain", 0.5 * i) for i in range(12)), end=8)
    common = ["--seed", "1", "--json", str(tmp_path / "result.json"), "--out", str(tmp_path / "out")]
    share = ["--device.phase.deterministic", "--device.phase.probability", "0.25"]
    for arguments in (
        ["run", *share, str(path), *common],
        ["run", str(path), *common, "--", *share, "--device.phase.explicit", "v1,v2"],
    ):
        assert main(arguments) == 0
        found = adopted(tmp_path / "out")
        assert json.loads((tmp_path / "result.json").read_text())["share"] == 0.25
        others = found - {"v1", "v2"} if "--" in arguments else found
        assert len(others) == 3
        assert ("--" in arguments) == ({"v1", "v2"} <= found)


def test_unknown_vehicles_are_refused(scenario):
    for options in (DriveOptions(explicit=["nobody"]), DriveOptions(types=["notype"])):
        with pytest.raises(PhaseError, match="in none of the scenario's files"):
            run_scenario(scenario(*MARKED[:2]), options, policy=Standin())


def test_context_reaches_the_policy_and_may_change_during_the_run(started):
    sumo = started(
        vehicle("calm", "calm", 0),
        vehicle("own", "calm", 3, ("phase.alpha", "0.9")),
        vehicle("p", "plain", 6),
    )
    fleet = phase_sumo.PhaseFleet(sumo, Standin(), alpha=0.5, time_gap=0.0)
    sumo.addStepListener(fleet)
    run_for(8)
    table, row = fleet.scene.table, fleet.scene.table.row_of
    limit = sumo.lane.getMaxSpeed(sumo.vehicle.getLaneID("p"))
    alphas = {v: pytest.approx(float(table["alpha"][row[v]])) for v in row}
    assert alphas == {"calm": 0.35, "own": 0.9, "p": 0.5}
    speeds = {v: pytest.approx(float(table["goal_speed"][row[v]])) for v in row}
    assert speeds == {"calm": 18.0, "own": 18.0, "p": 0.8 * limit}
    assert sumo.vehicle.getSpeed("calm") < 21.0

    fleet.set_context("calm", alpha=0.8, target_speed=12.0)
    sumo.vehicle.setParameter("own", "phase.target_speed", "25")
    run_for(0.1)
    assert float(table["goal_speed"][row["own"]]) == pytest.approx(18.0)  # SUMO is not asked in every step
    fleet.set_context("own")
    run_for(4)
    assert float(table["goal_speed"][row["own"]]) == pytest.approx(25.0)
    assert sumo.vehicle.getSpeed("calm") < 14.0 < 19.0 < sumo.vehicle.getSpeed("own")
    fleet.set_context("own", time_gap=1.5)
    run_for(0.1)
    assert float(table["goal_speed"][row["own"]]) < 24.0  # "calm" is ahead
    with pytest.raises(PhaseError, match=r"phase.alpha='2'"):
        fleet.set_context("calm", alpha=2)
    assert sumo.vehicle.getParameter("calm", "phase.alpha") == "0.8"
    with pytest.raises(PhaseError, match="nobody"):
        fleet.set_context("nobody", alpha=0.5)


def test_take_and_release_at_any_time_without_a_jump(started):
    sumo = started()
    fleet = phase_sumo.PhaseFleet(sumo, Standin(), share=0.0)
    run_sumo, speed = [], None

    def step():
        sumo.simulationStep()
        fleet.step()

    for _ in range(30):
        step()
    assert fleet.driven == 0
    fleet.take("v0")
    for k in range(100):
        if k == 50:
            fleet.release("v0")
        before, speed = sumo.vehicle.getPosition("v0"), sumo.vehicle.getSpeed("v0")
        step()
        after = sumo.vehicle.getPosition("v0")
        run_sumo.append((fleet.driven, abs(after[0] - before[0] - 0.1 * sumo.vehicle.getSpeed("v0"))))
        assert abs(sumo.vehicle.getSpeed("v0") - speed) < 1.0
    assert [driven for driven, _ in run_sumo] == [1] * 50 + [0] * 50
    assert max(jump for _, jump in run_sumo) < 0.02
    assert sumo.vehicle.getSpeedMode("v0") == 31
    fleet.take("v0")
    step()
    assert fleet.driven == 1


def test_policies_by_vehicle_type_drive_side_by_side(scenario, monkeypatch):
    """The same driver under two names must drive like under one: all see the same traffic."""
    cars = [vehicle(f"v{i}", "plain" if i % 2 else "other", i) for i in range(10)]
    other = '<vType id="other" length="4.8" width="1.9" speedFactor="0.8" speedDev="0">{}</vType>'
    named = other.format('<param key="phase.policy" value="b.safetensors"/>')
    asked = []
    monkeypatch.setattr(drivers, "load_policy", lambda path: asked.append(path) or Standin())
    one = run_scenario(scenario(*cars, types=TYPES + other.format(""), end=12), policy=Standin(), seed=1)
    path = scenario(*cars, types=TYPES + named, end=12)
    two = run_scenario(path, policy=Standin(), seed=1)
    assert asked == [path.parent / "b.safetensors"]  # beside the scenario, read once
    for name in ("phase_vehicles", "phase_vehicle_km", "accounts", "fleet", "mean_travel_time"):
        assert one[name] == two[name]


def test_a_missing_policy_names_the_vehicle(scenario):
    path = scenario(vehicle("v", "plain", 0, ("phase.policy", "nothere.safetensors")))
    with pytest.raises(PhaseError, match=r"'v'.*phase\.policy.*nothere"):
        run_scenario(path, policy=Standin(), seed=1)


@pytest.mark.parametrize("over_traci", [False, True])
def test_sumo_failing_on_the_way_is_one_clear_error_and_no_harm_to_the_next_run(scenario, over_traci):
    lost = vehicle("lost", "plain", 6).replace("main2", "nowhere")
    path = scenario(vehicle("a", "plain", 0), vehicle("b", "plain", 5), lost)
    path.write_text(
        path.read_text().replace("<time>", '<processing><route-steps value="1"/></processing><time>')
    )
    with pytest.raises(PhaseError, match=r"SUMO stopped at .* s: .*nowhere") as raised:
        run_scenario(path, policy=Standin(), seed=1, over_traci=over_traci)
    assert "\n" not in str(raised.value)
    path = scenario(vehicle("a", "plain", 0))
    assert run_scenario(path, policy=Standin(), seed=1, end=2, over_traci=over_traci)["phase_vehicles"] == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "collision.action=teleport.*--collision.action warn"),
        ([*phase_sumo.SUMO_OPTIONS, "--lanechange.duration", "3"], "lanechange.duration=3.*may crash"),
        ([*phase_sumo.SUMO_OPTIONS, "--mesosim", "true"], "mesosim"),
        ([*phase_sumo.SUMO_OPTIONS, "--step-length", "0.25"], "step-length 0.25"),
    ],
)
def test_a_simulation_that_lacks_what_phase_needs_is_refused(started, options, words):
    with pytest.raises(PhaseError, match=words):
        phase_sumo.PhaseFleet(started(options=options), Standin())


def test_misuse_of_the_loop_is_refused(started):
    sumo = started()
    fleet = phase_sumo.PhaseFleet(sumo, Standin())
    number = sumo.addStepListener(fleet)
    run_for(3)
    with pytest.raises(PhaseError, match="not both"):
        fleet.step()
    with pytest.raises(PhaseError, match="without a time"):
        sumo.simulationStep(5.0)
    sumo.removeStepListener(number)


def test_a_fleet_may_join_late_and_leave_early(started, scenario):
    sumo = started()
    run_for(4)
    fleet = phase_sumo.PhaseFleet(sumo, Standin())
    sumo.addStepListener(fleet)
    run_for(1)
    assert fleet.driven == fleet.report()["vehicles"] == len(sumo.vehicle.getIDList()) == 3
    fleet.close()
    sumo.close()
    sumo.start(["sumo", "-c", str(scenario(vehicle("v0", "plain", 0))), "--no-step-log", "true"])
    run_for(1)
    assert sumo.vehicle.getPosition("v0")[0] > 0  # no pose of the first simulation disturbs the second


def test_a_run_that_is_interrupted_does_not_disturb_the_next(scenario):
    path = scenario(*(vehicle(f"v{i}", "plain", 0) for i in range(3)))

    def interrupt(fraction, text):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_scenario(path, policy=Standin(), seed=1, progress=interrupt)
    assert run_scenario(path, policy=Standin(), seed=1, end=2)["phase_vehicles"] == 3


def test_own_loop_traci_and_run_are_the_same_simulation(scenario):
    cars = [vehicle(f"v{i}", "plain", i) for i in range(8)]
    path = scenario(*cars, end=12)
    ran = run_scenario(path, policy=Standin(), seed=7)
    over_traci = run_scenario(path, policy=Standin(), seed=7, over_traci=True)
    reports = []
    for sumo in (libsumo, traci):
        args = ["-c", str(path), "--seed", "7", "--no-step-log", "true", *phase_sumo.SUMO_OPTIONS]
        sumo.start([sumolib.checkBinary("sumo"), *args])
        connection = traci.getConnection("default") if sumo is traci else libsumo
        fleet = phase_sumo.PhaseFleet(connection, Standin(), seed=7)
        connection.addStepListener(fleet)
        while connection.simulation.getTime() < 12:
            connection.simulationStep()
        reports.append(fleet.report())
        sumo.close()
    clocks = {"policy_cpu_us_per_vehicle_step", "guard_cpu_us_per_vehicle_step"}
    assert ran["phase_vehicle_km"] > 1.0
    for name in set(reports[0]) - clocks:
        assert ran[name] == over_traci[name] == reports[1][name], name
        if name != "fleet":  # the run loop's last step is not driven either
            assert ran[name] == reports[0][name], name


def test_the_example_runs(tmp_path):
    script = ROOT / "scenarios" / "own_loop.py"
    done = subprocess.run(
        [sys.executable, str(script), "--end", "14"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    report = dict(line.split(": ", 1) for line in done.stdout.splitlines() if ": " in line)
    assert 0 < int(report["phase_vehicles"]) < int(report["vehicles"])


@pytest.mark.skipif(not shutil.which("Xvfb"), reason="a window needs Xvfb, which is not installed")
def test_sumos_window(scenario):
    code = (
        "from phase_sumo.bridge.run import run_scenario; from tests.helpers.standin import Standin; "
        f"r = run_scenario({str(scenario(*MARKED))!r}, policy=Standin(), seed=1, end=3, gui=True); "
        "assert r['phase_vehicles'] > 0"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = ["xvfb-run", "-a", sys.executable, "-c", code]
    subprocess.run(command, check=True, env=environment, timeout=120)
