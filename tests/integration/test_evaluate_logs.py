"""`phase-sumo evaluate` on recorded traffic in files, as a user types it."""

from __future__ import annotations

import json
import weakref
from collections import Counter

import pytest

from phase_sumo.cli import main
from phase_sumo.logs.windows import windows
from phase_sumo.studies import log_protocol
from tests.helpers.log_files import write_commonroad, write_levelx, write_tracks
from tests.helpers.small_nets import SmallNet, lanes_from
from tests.helpers.steady_recordings import recording

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
    assert set(result["by_source"]) == {"tracks/a", "highd"}
    assert result["by_type"]["articulated_truck"]["agents"] == 2
    for name in RATES:
        assert 0.0 <= result[name]["mean"] <= 1.0
    log, straight = result["references"]["log"], result["references"]["constant-velocity"]
    assert log["success_rate"]["mean"] == 1.0 and log["fde_5s"]["mean"] == pytest.approx(0.0, abs=0.05)
    assert straight["goal_rate"]["mean"] == pytest.approx(2 / 3)  # all but the one that changes lanes
    # SUMO's drivers know no goal, but the road
    assert result["references"]["idm"]["fde_5s"]["mean"] < 25.0


def test_traffic_on_the_left_is_scored_as_its_mirror_image_is(tmp_path):
    """SUMO's drivers know no sides but the network's; what the log says is on the other one."""
    lanes = lanes_from(0.0, 400.0, 9.15, 5.49, 1.83)  # from the left to the right
    net = SmallNet({"lefthand": "true"}).edge("road", lanes).write(tmp_path / "left.net.xml")
    mirrored = SmallNet().edge("road", [[(x, 10.98 - y) for x, y in lane] for lane in lanes])
    tracks = write_tracks(tmp_path / "tracks.csv")
    header, *rows = tracks.read_text().splitlines()
    at = header.split(",").index("y_m")
    fields = [row.split(",") for row in rows]
    flipped = [",".join([*f[:at], f"{10.98 - float(f[at]):.4f}", *f[at + 1 :]]) for f in fields]
    other = tmp_path / "mirrored.csv"
    other.write_text("\n".join([header, *flipped]) + "\n")
    left, right = (
        evaluated(tmp_path, f"tracks:{file}@{road}", extra=("--references",))["references"]["idm"]
        for file, road in ((tracks, net), (other, mirrored.write(tmp_path / "right.net.xml")))
    )
    for name in (*RATES, "ade_5s", "fde_5s"):
        assert left[name]["mean"] == pytest.approx(right[name]["mean"], abs=0.02), name


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
    monkeypatch.setattr("phase_sumo.studies.log_protocol.windows", lambda recording, **kwargs: [])
    tracks = write_tracks(tmp_path / "tracks.csv")
    assert main(["evaluate", "--scenarios", f"tracks:{tracks}"]) != 0
    assert "--all-windows" in capsys.readouterr().err


def test_no_more_windows_are_held_than_are_asked_for(monkeypatch):
    made = [recording([(20.0, 0, 5.0), (60.0, 1, 5.5)], samples=301, name=f"r{k}") for k in range(6)]
    cut = {r.name: windows(r, lane_changes_only=False) for r in made}
    monkeypatch.setattr(log_protocol, "windows", lambda r, **_: cut[r.name])

    def drawn(most: int, seed: int) -> list[tuple[str, float]]:
        found = log_protocol._windows(made, True, most, seed, lambda share, text: None)
        return [(w.recording.name, float(w.recording.x[0, w.begin])) for w in found]

    every = drawn(99, 0)
    assert len(every) == 6 * 3 and every == drawn(18, 1)
    few = [drawn(4, seed) for seed in range(200)]
    assert all(len(set(f)) == 4 and f == sorted(f) for f in few) and few[0] == drawn(4, 0)
    # 200 draws of 4 in 18: 44.4 times each, with a standard deviation of 5.9
    times = Counter(window for f in few for window in f)
    assert all(abs(times[window] - 200 * 4 / 18) < 4 * 5.9 for window in every)


def test_one_recording_is_in_memory_at_a_time():
    held: list[weakref.ref] = []

    def recordings():
        for name in "abc":
            made = recording([(20.0, 0, 5.0)], samples=101, name=name)
            assert not any(other() for other in held)
            held.append(weakref.ref(made))
            yield made
            del made

    assert len(log_protocol._windows(recordings(), True, 9, 0, lambda share, text: None)) == len(held) == 3
    assert not any(other() for other in held)
