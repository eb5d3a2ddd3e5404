"""What counts as an encounter, and that an exported scene begins and ends as it was searched."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phase_sumo.bridge.run import run_scenario
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.studies.scenario_export import SceneVehicle, write_scene
from phase_sumo.studies.search import Scene, Search, encounter, export, replay
from tests.helpers.scenario_files import RAMP_NET
from tests.helpers.standin import Standin
from tests.helpers.trajectories import make

WAY = ("main0", "main1", "main2")
CAR = SceneVehicle("a", "car", "passenger", 4.8, 1.9, 1, 60.0, 0.4, 20.0, WAY, 0.7, 20.0)
BEHIND = replace(CAR, id="b", position=25.0, offset=0.0, speed=27.0, target_speed=30.0)
TRUCK = SceneVehicle("t", "articulated_truck", "trailer", 16.5, 2.55, 0, 90.0, -0.2, 18.0, WAY, 0.5, 18.0)


def test_time_to_collision_counts_behind_a_box_and_not_at_the_end():
    # v0 follows v1 in lane A_0: gap 20 - 5 = 15 m, closing by 5 m/s, three seconds; later closer still
    rows = [(t, v, 0, p + 10.0 * t, s) for t in range(5) for v, p, s in ((0, 10.0, 15.0), (1, 30.0, 10.0))]
    found = encounter(make(rows), "near-miss")
    assert (found.follower, found.leader, found.value) == ("v0", "v1", pytest.approx(3.0))
    assert found.time <= 1.0  # the last 3 s of the 4 s do not count
    aside = replace(make(rows), lateral=np.tile([0.0, 1.9], 5))  # 1.8 m wide each: no overlap
    assert encounter(aside, "near-miss").value == np.inf


def test_a_cut_in_is_the_time_gap_left_to_the_one_behind():
    rows = [(t, 0, 0, 10.0 + 10.0 * t, 10.0) for t in range(6)]
    rows += [(t, 1, 0 if t >= 2 else 1, 27.0 + 10.0 * t, 10.0) for t in range(6)]
    found = encounter(make(rows), "cut-in")
    assert (found.follower, found.leader, found.time) == ("v0", "v1", 2.0)
    assert found.value == pytest.approx((17.0 - 5.0) / 10.0)
    assert encounter(make(rows[:6]), "cut-in").value == np.inf


def test_a_scene_begins_as_it_was(tmp_path: Path):
    cfg = write_scene(tmp_path / "s", "s", RAMP_NET, (CAR, BEHIND, TRUCK), 1.0)
    result = run_scenario(cfg, policy=Standin(), output_dir=tmp_path / "out")
    assert result["phase_vehicles"] == 3
    t = Trajectories.load(tmp_path / "out" / "trajectories.npz")
    first = t.select(t.time == t.time[0])
    for v in (CAR, BEHIND, TRUCK):
        row = [t.vehicle_ids[k] for k in first.vehicle].index(v.id)
        assert first.position[row] == pytest.approx(v.position, abs=1e-3)
        assert first.lateral[row] == pytest.approx(v.offset, abs=1e-3)
        assert first.speed[row] == pytest.approx(v.speed, abs=1e-3)
        assert first.alpha[row] == pytest.approx(v.alpha) and first.target_speed[row] == v.target_speed
        assert first.lane_ids[first.lane[row]] == f"main0_{v.lane}"


@pytest.fixture
def scene() -> Scene:
    return Scene(RAMP_NET, (BEHIND, CAR, TRUCK), ((WAY,),) * 3)


def test_what_is_found_is_replayed_from_its_files(scene: Scene, tmp_path: Path):
    policy = Standin()
    search = Search(scene, policy, "near-miss", 1, 6.0)
    vehicles, found = search.run(6, seed=1)
    assert {found.follower, found.leader} == {"a", "b"} and found.contacts == 0
    assert found.value == min(e.value for _, e in search.tried if not e.contacts)
    assert vehicles[1:] == scene.vehicles[1:]  # one alone is varied
    cfg = export(tmp_path / "close", search, vehicles, {"seed": 1})
    assert replay(cfg, policy, "near-miss", tmp_path / "again") == found
    assert json.loads((tmp_path / "close" / "close.json").read_text())["varied"] == ["b"]
    assert len((tmp_path / "close" / "search.csv").read_text().splitlines()) == 7


def test_a_search_without_encounters_says_so(tmp_path: Path):
    search = Search(Scene(RAMP_NET, (CAR,), ((WAY,),)), Standin(), "cut-in", 1, 4.0)
    with pytest.raises(PhaseError, match="none of 2 runs had a cut-in without a collision; raise --budget"):
        search.run(2, seed=0)


def test_only_vehicles_that_fit_are_put_in(scene: Scene):
    close = replace(BEHIND, position=CAR.position - 12.0)
    search = Search(replace(scene, vehicles=(CAR, close, TRUCK)), Standin(), "near-miss", 3, 6.0)
    assert search._kinds[0] == ["car"]  # 12 m to the next one
    assert set(search._kinds[2]) == {"articulated_truck", "car", "rigid_truck"}
