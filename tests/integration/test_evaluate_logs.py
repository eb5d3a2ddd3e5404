"""`phase-sumo evaluate` on recorded traffic in files, as a user types it."""

from __future__ import annotations

import json

import pytest

from phase_sumo.cli import main
from tests.log_files import write_commonroad, write_levelx, write_tracks

RATES = ("goal_rate", "agent_collision_rate", "road_collision_rate", "success_rate")


def evaluated(tmp_path, *sources: str, extra: tuple[str, ...] = ()) -> dict:
    out = tmp_path / "result.json"
    assert main(["evaluate", "--scenarios", *sources, "--json", str(out), *extra]) == 0
    return json.loads(out.read_text())


def test_two_sources_with_references(tmp_path):
    tracks = write_tracks(tmp_path / "tracks.csv")
    folder = tmp_path / "highd"
    folder.mkdir()
    write_levelx(folder, exid=False)
    result = evaluated(tmp_path, f"tracks:{tracks}", f"highd:{folder}", extra=("--references",))
    assert result["scenarios"] == 2 and result["agents"] == 6  # the fourth vehicle appears later
    assert set(result["by_source"]) == {"tracks", "highd"}
    assert result["by_type"]["articulated_truck"]["agents"] == 2
    for name in RATES:
        assert 0.0 <= result[name]["mean"] <= 1.0
    log, straight = result["references"]["log"], result["references"]["constant-velocity"]
    assert log["success_rate"]["mean"] == 1.0 and log["fde_5s"]["mean"] == pytest.approx(0.0, abs=0.05)
    assert straight["goal_rate"]["mean"] == pytest.approx(2 / 3)  # all but the one that changes lanes
    # SUMO's drivers know no goal, but the road
    assert result["references"]["idm"]["fde_5s"]["mean"] < 25.0


def test_the_result_is_the_same_every_time_and_follows_the_seed(tmp_path):
    source = f"commonroad:{write_commonroad(tmp_path / 'scene.xml')}"
    first = evaluated(tmp_path, source)
    assert first == evaluated(tmp_path, source)
    assert first["ade_5s"] != evaluated(tmp_path, source, extra=("--seed", "1"))["ade_5s"]


def test_sources_of_both_families_are_refused(tmp_path, capsys):
    tracks = write_tracks(tmp_path / "tracks.csv")
    assert main(["evaluate", "--scenarios", f"tracks:{tracks}", "synthetic:benchmark"]) != 0
    assert "apart" in capsys.readouterr().err


def test_recordings_without_a_lane_change_name_the_remedy(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("phase_sumo.bridge.rollout.protocol.windows", lambda recording, **kwargs: [])
    tracks = write_tracks(tmp_path / "tracks.csv")
    assert main(["evaluate", "--scenarios", f"tracks:{tracks}"]) != 0
    assert "--all-windows" in capsys.readouterr().err
