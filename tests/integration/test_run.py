"""Whole runs in SUMO with a hand-written driver in the policy's place."""

from __future__ import annotations

import csv
import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import libsumo
import pytest

from phase_sumo.bridge.run import run_scenario
from phase_sumo.bridge.sumo.session import Session
from phase_sumo.cli import main
from phase_sumo.errors import PhaseError
from phase_sumo.studies.processes import run_all
from tests.helpers.places import NETWORKS
from tests.helpers.standin import Standin

NETWORK = NETWORKS / "f04_onramp3.net.xml"
ROUTES = """<routes>
    <vType id="car" vClass="passenger" length="4.8" width="1.9" speedFactor="normc(0.9,0.1,0.7,1.1)"/>
    <vType id="semi" vClass="trailer" length="20.0" width="2.55"
           accel="0.9" maxSpeed="25" speedFactor="0.85"/>
    <flow id="m" type="car" from="main0" to="main2" begin="0" end="40" period="2.2"
          departLane="best" departSpeed="avg"/>
    <flow id="t" type="semi" from="main0" to="main2" begin="0" end="40" period="9"
          departLane="0" departSpeed="avg"/>
    <flow id="r" type="car" from="onramp1" to="main2" begin="0" end="40" period="8" departSpeed="avg"/>
</routes>
"""


@pytest.fixture
def scenario(tmp_path):
    def write(step=0.1, end=40):
        (tmp_path / "demand.rou.xml").write_text(ROUTES)
        path = tmp_path / "test.sumocfg"
        path.write_text(
            f'<configuration><input><net-file value="{NETWORK}"/>'
            '<route-files value="demand.rou.xml"/></input>'
            f'<time><end value="{end}"/><step-length value="{step}"/></time></configuration>'
        )
        return path

    return write


def balanced(result):
    accounts = dict(result["accounts"])
    return accounts.pop("inserted") == sum(accounts.values()) == result["vehicles"]


@pytest.mark.parametrize("step", [pytest.param(0.05, marks=pytest.mark.slow), 0.1, 0.5, 1.0])
def test_every_vehicle_is_accounted_for_at_every_step_length(scenario, tmp_path, step):
    out = tmp_path / "out"
    result = run_scenario(scenario(step), policy=Standin(), seed=1, output_dir=out)
    assert balanced(result)
    assert result["phase_vehicles"] == result["vehicles"] > 20
    assert result["phase_arrived_under_policy"] == result["accounts"]["arrived"] > 5
    assert result["off_road"] < 8  # the stand-in cuts the ramp's curve
    assert result["share_of_time_under_policy"] > 0.9
    assert result["phase_vehicle_km"] > 5.0
    assert json.loads((out / "result.json").read_text()) == result
    with (out / "trips.csv").open() as file:
        assert len(list(csv.DictReader(file))) == result["vehicles"]


def test_same_seed_same_run(scenario):
    first, second = (run_scenario(scenario(), policy=Standin(), seed=3, end=20) for _ in range(2))
    for name in ("vehicles", "accounts", "phase_vehicle_km", "fleet"):
        assert first[name] == second[name]


def test_share_and_types(scenario):
    some = run_scenario(scenario(), policy=Standin(), seed=1, share=0.5, end=30)
    assert 0 < some["phase_vehicles"] < some["vehicles"]
    assert balanced(some)
    trucks = run_scenario(scenario(), policy=Standin(), seed=1, types=["semi"], end=30)
    assert 0 < trucks["phase_vehicles"] < 6
    none = run_scenario(scenario(), phase=False, seed=1, end=30)
    assert none["phase_vehicles"] == 0
    assert none["arrived"] > 0


def test_an_odd_step_length_is_refused_with_a_remedy(scenario):
    with pytest.raises(PhaseError, match=r"step-length 0\.25.*pass -- --step-length 0\.2"):
        run_scenario(scenario(0.25), policy=Standin())
    run_scenario(scenario(), phase=False, end=5)  # the session was closed


def test_bad_network_is_one_clear_error(scenario, tmp_path):
    path = scenario()
    bad = tmp_path / "demand.rou.xml"
    bad.write_text("<routes><flow id='f' from='nowhere' to='main2' begin='0' end='9' period='1'/></routes>")
    with pytest.raises(PhaseError, match="nowhere"):
        run_scenario(path, phase=False)


def test_a_window_without_a_display_is_refused_with_a_remedy(scenario, monkeypatch):
    """SUMO would end the whole process, or be tried again for a minute over TraCI."""
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    for over_traci in (False, True):
        with pytest.raises(PhaseError, match=r"DISPLAY is not set.*xvfb-run"):
            run_scenario(scenario(), policy=Standin(), gui=True, over_traci=over_traci)


def test_run_of_the_command_line_keeps_no_frames(scenario, tmp_path):
    arguments = ["run", str(scenario()), "--share", "0", "--end", "5", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"result.json", "events.csv", "trips.csv"}
    assert not (tmp_path / "out" / "trajectories.npz").exists()


def test_one_simulation_per_process(scenario, tmp_path):
    args = ["-n", str(NETWORK), "--no-step-log", "true"]
    with (
        Session(args, tmp_path),
        pytest.raises(PhaseError, match="already running in this process"),
        Session(args, tmp_path),
    ):
        pass
    with Session(args, tmp_path) as session:
        session.step()
        assert session.time == 1.0


def test_session_closes_after_an_exception(tmp_path):
    args = ["-n", str(NETWORK), "--no-step-log", "true"]
    with pytest.raises(KeyboardInterrupt), Session(args, tmp_path):
        raise KeyboardInterrupt
    with Session(args, tmp_path):
        pass


def test_processes_report_refusals(scenario, tmp_path):
    with pytest.raises(PhaseError, match="nothere"):
        run_all([{"cfg": str(tmp_path / "nothere.sumocfg"), "phase": False}])


def test_hitch_angles_reach_sumos_trajectory_output(scenario, tmp_path):
    fcd = tmp_path / "fcd.xml"
    options = ["--fcd-output", str(fcd), "--fcd-output.params", "phase.hitch"]
    run_scenario(scenario(), policy=Standin(), seed=1, types=["semi"], end=20, sumo_options=options)
    assert "phase.hitch=" in fcd.read_text() or "phase_hitch=" in fcd.read_text()


def test_types_and_ids_that_no_file_has_are_refused(scenario):
    with pytest.raises(PhaseError, match=r"'smei' is in none.*did you mean semi"):
        run_scenario(scenario(), policy=Standin(), seed=1, types=["smei"], end=5)
    result = run_scenario(scenario(), policy=Standin(), seed=1, explicit=["m.17"], end=5)
    assert any("m.17" in text for text in result["warnings"])  # it comes later


def test_the_check_is_part_of_the_result_and_the_scenarios_seed_holds(scenario, tmp_path):
    cfg = scenario()
    cfg.write_text(cfg.read_text(encoding="utf-8").replace("<time>", '<seed value="9"/><time>'))
    result = run_scenario(cfg, policy=Standin(), end=5, output_dir=tmp_path / "out", record=False)
    assert result["seed"] == result["check"]["time"]["seed"] == 9
    stored = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert stored["check"] == result["check"]
    assert "end 40 -> 5 (the command line says so)" in result["check"]["changed"]


def test_demand_from_calibrators_alone_runs_to_the_end(scenario, tmp_path):
    cfg = scenario(end=10)
    (tmp_path / "demand.rou.xml").write_text(
        '<routes><vType id="car"/><route id="r" edges="main0 main1 main2"/><calibrator id="c" edge="main0" '
        'pos="5"><flow begin="0" end="9" route="r" vehsPerHour="1800" speed="30" type="car"/></calibrator>'
        "</routes>"
    )
    text = cfg.read_text(encoding="utf-8")
    cfg.write_text(text.replace("route-files", "additional-files"))
    result = run_scenario(cfg, policy=Standin())
    assert result["sim_seconds"] == pytest.approx(10.0)
    assert result["vehicles"] > 2


def test_a_second_thread_is_refused_in_one_line_and_the_first_one_runs_on(scenario):
    cfg = scenario()
    with ThreadPoolExecutor(1) as pool:
        started = threading.Event()

        def watch(fraction, text):
            started.set()

        first = pool.submit(run_scenario, cfg, policy=Standin(), progress=watch)
        assert started.wait(60)
        with pytest.raises(PhaseError, match="already running in this process"):
            run_scenario(cfg, policy=Standin(), end=1)
        assert first.result()["vehicles"] > 20
    assert run_scenario(cfg, policy=Standin(), end=1)["sim_seconds"] == pytest.approx(1.0)


def test_a_simulation_started_elsewhere_is_not_replaced(scenario):
    libsumo.start(["sumo", "-n", str(NETWORK), "--no-step-log", "true"])
    try:
        with pytest.raises(PhaseError, match="started elsewhere"):
            run_scenario(scenario(), policy=Standin(), end=1)
        libsumo.simulationStep()
    finally:
        libsumo.close()


@pytest.mark.parametrize("affixes", [("", ""), ("TIME_", "_x"), ("p${PID}_", "")])
def test_outputs_are_put_right_whatever_their_names(scenario, tmp_path, affixes):
    cfg = scenario()
    more = '<tripinfo-output value="a/result.json"/><lanechange-output value="b/result.json"/>'
    more += "".join(
        f'<output-{n} value="{v}"/>' for n, v in zip(("prefix", "suffix"), affixes, strict=True) if v
    )
    cfg.write_text(cfg.read_text(encoding="utf-8").replace("<time>", more + "<time>"))
    out = tmp_path / "out"
    result = run_scenario(cfg, policy=Standin(), seed=1, end=30, output_dir=out, record=False)
    assert result["warnings"] == []
    names = [p.name for p in out.rglob("*") if p.is_file()]
    xml = [name for name in names if (out / name).is_file() and b"<tripinfos" in (out / name).read_bytes()]
    assert len(xml) == 1 and xml[0] != "result.json"
    assert sum("result" in name for name in names) == 3  # theirs and ours, each by itself
    assert json.loads((out / "result.json").read_text(encoding="utf-8"))["vehicles"] == result["vehicles"]
    assert not [name for name in names if "tripinfo" in name or "collision" in name]  # ours alone, gone


def test_a_run_that_breaks_off_leaves_no_older_result(scenario, tmp_path):
    out = tmp_path / "out"
    cfg = scenario()
    run_scenario(cfg, policy=Standin(), end=5, output_dir=out)
    assert (out / "result.json").is_file()
    with pytest.raises(PhaseError, match="no such"):
        run_scenario(cfg, policy=tmp_path / "gone.safetensors", output_dir=out)
    assert (out / "result.json").is_file()  # refused before anything was run

    def fails(fraction, text):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_scenario(cfg, policy=Standin(), end=5, output_dir=out, progress=fails)
    assert not any((out / name).exists() for name in ("result.json", "events.csv", "trajectories.npz"))


def test_surrogate_safety_goes_to_the_output_folder(scenario, tmp_path):
    options = ["--device.ssm.probability", "1"]
    run_scenario(scenario(), policy=Standin(), end=15, output_dir=tmp_path / "out", sumo_options=options)
    assert "<SSMLog" in (tmp_path / "out" / "ssm.xml").read_text()


def test_dates_for_times_leave_sumos_files_alone(scenario, tmp_path):
    options = ["--human-readable-time", "true", "--tripinfo-output", str(tmp_path / "t.xml")]
    result = run_scenario(scenario(), policy=Standin(), end=30, sumo_options=options)
    assert any("human-readable-time" in warning for warning in result["warnings"])
    assert "<tripinfo " in (tmp_path / "t.xml").read_text()
