"""The measured motorway is full from the first step on, and its measurement adds up."""

from __future__ import annotations

import pytest

from phase_sumo.bridge.sumo.session import Session
from phase_sumo.errors import PhaseError
from phase_sumo.studies.bench import bench_full_freeway
from phase_sumo.studies.full_freeway import write_full_freeway
from phase_sumo.studies.stopwatch import PARTS


def test_all_vehicles_drive_from_the_first_step_to_the_last_one_measured(tmp_path):
    config = write_full_freeway(tmp_path, 60, seconds=15.0, seed=3)
    with Session(["-c", str(config), "--no-step-log", "true"], tmp_path) as session:
        for _ in range(150):
            session.step()
            assert len(session.api.vehicle.getIDList()) == 60
        api = session.api
        trucks = sum(api.vehicle.getTypeID(v) == "truck" for v in api.vehicle.getIDList())
        edges = {api.vehicle.getRoadID(v).rstrip("0123456789") for v in api.vehicle.getIDList()}
        assert api.simulation.getCollisions() == ()
    assert 3 <= trucks <= 18
    assert {"east", "west"} <= edges


def test_the_same_seed_makes_the_same_demand(tmp_path):
    demand = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        (tmp_path / name).mkdir()
        write_full_freeway(tmp_path / name, 20, 5.0, seed)
        demand.append((tmp_path / name / "full.rou.xml").read_bytes())
    assert demand[0] == demand[1]
    assert demand[0] != demand[2]


def test_parts_of_the_measurement_add_up_to_the_whole():
    row = bench_full_freeway(12, steps=4, seed=0, progress=lambda done, text: None)
    assert row["vehicles"] == 12
    assert row["agent_steps"] == 3 * 12  # nothing is decided after the last step
    parts = [row[f"{part}_cpu_us"] for part in (*PARTS, "rest") if part != "record"]
    assert sum(parts) == pytest.approx(row["cpu_us_per_agent_step"])
    assert min(parts) >= 0.0


def test_measuring_leaves_the_bridge_as_it_was():
    before = [getattr(owner, name) for owner, name in PARTS.values()]
    bench_full_freeway(6, steps=2, seed=0, progress=lambda done, text: None)
    assert [getattr(owner, name) for owner, name in PARTS.values()] == before


@pytest.mark.parametrize(("vehicles", "steps"), [(0, 100), (10, 1)])
def test_nothing_to_measure_is_refused(vehicles, steps):
    with pytest.raises(PhaseError, match=rf"--vehicles {vehicles} --steps {steps}"):
        bench_full_freeway(vehicles, steps, seed=0, progress=lambda done, text: None)
