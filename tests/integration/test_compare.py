"""A whole comparison in SUMO, with a hand-written driver in the policy's place."""

from __future__ import annotations

import csv
import json
import xml.etree.ElementTree as ET

import pytest

from phase_sumo.bridge.run import run_scenario
from phase_sumo.bridge.sumo.emission_tables import emission_tables
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.measures import emitted
from phase_sumo.evaluate.traffic import delay
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.report.comparison_page import write_report
from phase_sumo.studies.compare import compare
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
</routes>
"""
COLUMNS = ["model", "measure", "unit", "mean", "low", "high", "n", "interval"]


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenario")
    (folder / "demand.rou.xml").write_text(ROUTES)
    path = folder / "test.sumocfg"
    path.write_text(
        f'<configuration><input><net-file value="{NETWORK}"/><route-files value="demand.rou.xml"/></input>'
        '<time><end value="60"/><step-length value="0.1"/></time></configuration>'
    )
    return path


@pytest.fixture(scope="module")
def compared(scenario, tmp_path_factory):
    out, texts = tmp_path_factory.mktemp("out"), []
    result = compare(
        scenario,
        ("phase:0.5", "idm"),
        policy=Standin(),
        out_dir=out,
        seeds=2,
        end=25,
        jobs=2,
        write_report=write_report,
        progress=lambda fraction, text: texts.append((fraction, text)),
    )
    return out, result, texts


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_file_tells_the_same(compared):
    out, result, texts = compared
    assert texts[-1][0] == pytest.approx(1.0)
    stored = json.loads((out / "comparison.json").read_text())
    assert stored["models"] == ["phase:0.5", "idm"]
    assert stored["reference"] == "idm"
    runs = rows(out / "comparison.csv")
    assert [(r["model"], r["seed"]) for r in runs] == [(m, s) for s in "12" for m in ("phase:0.5", "idm")]
    summary = {(r["model"], r["measure"]): r for r in rows(out / "summary.csv")}
    assert list(next(iter(summary.values())))[:8] == COLUMNS
    speeds = {m: [float(r["mean_speed"]) for r in runs if r["model"] == m] for m in ("phase:0.5", "idm")}
    line = summary["phase:0.5", "mean_speed"]
    assert float(line["mean"]) == pytest.approx(sum(speeds["phase:0.5"]) / 2)
    assert float(line["low"]) < float(line["mean"]) < float(line["high"])
    change = [a - b for a, b in zip(speeds["phase:0.5"], speeds["idm"], strict=True)]
    assert float(line["difference_mean"]) == pytest.approx(sum(change) / 2, abs=1e-5)
    assert summary["idm", "mean_speed"]["difference_mean"] == ""
    assert result["summary"]["phase:0.5"]["mean_speed"]["mean"] == pytest.approx(float(line["mean"]))
    assert "PHASE 50 % against IDM" in (out / "report.html").read_text()


def test_a_share_is_driven_by_phase_and_the_rest_by_the_sumo_model(compared):
    out, result, _ = compared
    for row in result["runs"]:
        if row["model"] == "idm":
            assert row["phase_vehicles"] == 0
            assert row["model_vehicle_km"] == row["vehicle_km"]
        else:
            assert 0.2 < row["phase_vehicles"] / row["vehicles"] < 0.8
            assert row["model_vehicle_km"] < row["vehicle_km"]
    t = Trajectories.load(out / "phase_0.5-seed1" / "trajectories.npz")
    assert t.controlled.any()
    assert not t.controlled.all()


def test_collisions_are_those_of_the_events_files(compared):
    _, result, _ = compared
    for row in result["runs"]:
        listed = [c for c in result["collisions"] if (c["model"], c["seed"]) == (row["model"], row["seed"])]
        assert len(listed) == row["collisions"]
        assert row["collisions_per_1000km"] == pytest.approx(1e3 * row["collisions"] / row["vehicle_km"])


def test_target_speeds_do_not_depend_on_who_drives(compared):
    out, _, _ = compared
    targets = {}
    for model in ("phase_0.5", "idm"):
        t = Trajectories.load(out / f"{model}-seed1" / "trajectories.npz")
        on_main = [e == "main0" for e in t.lane_edges] + [False]
        for v, lane, target in zip(t.vehicle, t.lane, t.target_speed, strict=True):
            if on_main[lane]:
                targets.setdefault(t.vehicle_ids[v], {})[model] = target
    both = [t for t in targets.values() if len(t) == 2]
    assert len(both) > 8
    for target in both:
        assert target["phase_0.5"] == pytest.approx(target["idm"], rel=1e-4)


def test_delay_and_emissions_agree_with_sumos_where_sumo_drives(scenario, tmp_path):
    options = ["--tripinfo-output", str(tmp_path / "trips.xml"), "--tripinfo-output.write-unfinished", "true"]
    options += ["--device.emissions.probability", "1"]
    run_scenario(
        scenario, share=0.0, model="idm", seed=1, roads="all", output_dir=tmp_path, sumo_options=options
    )
    trips = ET.parse(tmp_path / "trips.xml").getroot().findall("tripinfo")
    t = Trajectories.load(tmp_path / "trajectories.npz")
    assert len(trips) > 15
    lost = sum(float(trip.attrib["timeLoss"]) for trip in trips)
    assert delay(t) == pytest.approx(lost, rel=0.05)
    sumo = {
        kind: sum(float(e.attrib[f"{kind}_abs"]) for e in ET.parse(tmp_path / "trips.xml").iter("emissions"))
        for kind in ("fuel", "CO2")
    }
    fuel, co2 = emitted(t, emission_tables(t.emission_classes))
    assert fuel == pytest.approx(sumo["fuel"] / 1e6, rel=0.02)
    assert co2 == pytest.approx(sumo["CO2"] / 1e6, rel=0.02)


def test_what_cannot_run_is_named(scenario, tmp_path):
    with pytest.raises(PhaseError, match="nosuch"):
        compare(scenario, ("phase", "nosuch"), out_dir=tmp_path)
    with pytest.raises(PhaseError, match="seeds"):
        compare(scenario, ("idm",), out_dir=tmp_path, seeds=0)
    with pytest.raises(PhaseError, match="jobs 0"):
        compare(scenario, ("idm",), out_dir=tmp_path, jobs=0)
