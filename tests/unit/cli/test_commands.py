"""The command line's exit statuses and messages, and what an import drags in."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from phase_sumo.cli import main
from phase_sumo.cli.files import load_maps
from phase_sumo.cli.parser import make_parser
from phase_sumo.errors import PhaseError
from phase_sumo.sim.bundle import save_bundle
from tests.helpers.small_nets import SmallNet, lanes_from


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "missing.sumocfg"], ["missing.sumocfg"]),
        (["compare", "missing.sumocfg", "--out", "{tmp}/o"], ["missing.sumocfg"]),
        (["convert", "missing.net.xml", "--out", "{tmp}/o"], ["missing.net.xml"]),
        (["train", "--networks", "nowhere", "--run", "{tmp}/r"], ["nowhere"]),
        (["train", "--networks", "{tmp}", "--run", "{tmp}/r"], [".net.xml"]),
        (["train", "--networks", "x", "--run", "{tmp}/r", "--preset", "fast"], ["fast", "no-dclamp"]),
        (["train", "--networks", "x", "--run", "{tmp}/r", "--resume"], ["without --resume"]),
        (["evaluate", "--scenarios", "moon:x"], ["moon:x", "synthetic:PATH"]),
        (["evaluate", "--scenarios", "synthetic:{tmp}", "--policy", "no.safetensors"], ["no.safetensors"]),
        (["evaluate", "--scenarios", "synthetic:benchmark", "synthetic:x"], ["result of its own"]),
        (["search", "missing.sumocfg", "--out", "{tmp}/o"], ["missing.sumocfg"]),
        (["steer", "--policy", "no.safetensors", "--out", "{tmp}/o"], ["no.safetensors"]),
        (["run", "x.sumocfg", "--alpha", "7"], ["--alpha", "0.1..1"]),
        (["run", "--types", "car", "x.sumocfg"], ["x.sumocfg", "--types", "before it"]),
        (["check", "-n", "a.net.xml", "--types", "x.sumocfg"], ["x.sumocfg", "--types"]),
        (["compare", "--models", "phase", "x.sumocfg", "--out", "{tmp}/o"], ["x.sumocfg", "--models"]),
    ],
    ids=lambda value: "-".join(value[:2]) if isinstance(value, list) else None,
)
def test_bad_input_is_one_clear_line_and_status_2(arguments, words, tmp_path, capsys):
    status = main([a.replace("{tmp}", str(tmp_path)) for a in arguments])
    message = [line for line in capsys.readouterr().err.splitlines() if line.startswith("phase-sumo:")]
    assert status == 2
    assert len(message) == 1 and all(word in message[0] for word in words), message


def test_convert_with_all_its_options(tmp_path):
    path = SmallNet().edge("main", lanes_from(0, 1400, 0.0, 3.6)).write(tmp_path / "road.net.xml")
    options = ["--keep", "all", "--stretch", "350", "--json", str(tmp_path / "summary.json")]
    assert main(["convert", str(path), "--out", str(tmp_path / "maps"), *options]) == 0
    (row,) = json.loads((tmp_path / "summary.json").read_text())
    assert row["stretches"] == 4 and row["names"][0] == "road_00"
    assert sorted(p.name for p in (tmp_path / "maps").iterdir()) == [
        f"road_{k:02d}.{ending}" for k in range(4) for ending in ("npz", "png")
    ]


def test_a_long_network_is_trained_on_in_stretches_and_not_converted_twice(tmp_path):
    path = SmallNet().edge("main", lanes_from(0, 1400, 0.0, 3.6)).write(tmp_path / "road.net.xml")
    maps = load_maps([str(path)], tmp_path / "kept")
    files = sorted((tmp_path / "kept").iterdir())
    assert [m.name for m in maps] == [f.stem for f in files] == ["road_00", "road_01", "road_02"]
    times = [f.stat().st_mtime_ns for f in files]
    again = load_maps([str(path)], tmp_path / "kept")
    assert [m.key for m in again] == [m.key for m in maps]
    assert [f.stat().st_mtime_ns for f in files] == times


def test_debug_shows_the_traceback():
    with pytest.raises(PhaseError):
        main(["run", "missing.sumocfg", "--debug"])


def test_train_evaluate_and_resume_from_the_command_line(straight_map, tmp_path, capsys):
    save_bundle(tmp_path / "maps" / "straight.npz", straight_map)
    common = ["--networks", str(tmp_path / "maps"), "--run", str(tmp_path / "run")]
    assert main(["train", *common, "--preset", "smoke", "--steps", "1"]) == 0
    assert main(["train", *common, "--resume", "--steps", "9000", "--json", str(tmp_path / "t.json")]) == 0
    assert json.loads((tmp_path / "t.json").read_text())["agent_steps"] >= 9000
    assert main(["train", *common, "--preset", "smoke"]) == 2  # never over an existing run
    policy = str(tmp_path / "run" / "policy.safetensors")
    scenarios = ["--scenarios", f"synthetic:{tmp_path / 'maps'}", "--worlds", "4", "--episodes", "1"]
    for name in ("a", "b"):
        arguments = ["evaluate", "--policy", policy, *scenarios, "--json", str(tmp_path / f"{name}.json")]
        assert main(arguments) == 0
    first, second = ((tmp_path / f"{name}.json").read_text() for name in ("a", "b"))
    assert first == second and json.loads(first)["agents"] > 10
    assert "goal" in capsys.readouterr().out


def test_training_needs_no_sumo_and_no_plotting():
    code = """
import sys
for name in "libsumo traci sumolib sumo lxml pyproj shapely matplotlib rich jinja2".split():
    sys.modules[name] = None  # importing it raises ImportError
import phase_sumo.train.loop, phase_sumo.evaluate.synthetic, phase_sumo.sim.bundle, phase_sumo.cli
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_the_package_does_not_import_torch():
    code = "import sys, phase_sumo, phase_sumo.cli; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_demo_shows_measures_that_a_comparison_has():
    from phase_sumo.cli.commands import DEMO_MEASURES
    from phase_sumo.studies.compare import ALL_MEASURES

    assert set(DEMO_MEASURES) <= set(ALL_MEASURES)


def test_bench_measures_all_parts_or_those_named(capsys):
    assert make_parser().parse_args(["bench"]).parts == []
    assert make_parser().parse_args(["bench", "sim", "bridge"]).parts == ["sim", "bridge"]
    with pytest.raises(SystemExit):
        main(["bench", "wheels"])
    assert "'wheels' is none of sim, train, bridge, convert" in capsys.readouterr().err
