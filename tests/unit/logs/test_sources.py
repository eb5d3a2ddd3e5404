"""What is said about files that are wrong, and the real recordings."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.lanelet2 import read_road
from phase_sumo.errors import PhaseError
from phase_sumo.logs.lane_matching import lane_places
from phase_sumo.logs.sources import open_source, open_sources
from phase_sumo.logs.windows import windows
from tests.helpers import log_files
from tests.helpers.places import NOT_SHARED, SHARED
from tests.helpers.small_nets import SmallNet, lanes_from

DATA = SHARED / "data"


def _edited(path, edit):
    path.write_text(edit(path.read_text()))
    return path


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda s: s.replace("length_m", "len"), "no column length_m; it needs id, t, y_m, length_m"),
        (lambda s: s.replace("x_rear_m", "east"), r"no column x_m \(box centre\) or x_rear_m"),
        (lambda s: s.replace("lane,", "strip,"), "no column lane, from which the road is made"),
        (lambda s: "", "empty file"),
        (lambda s: s.splitlines()[0] + "\n", "no line below its header"),
        (lambda s: s.replace(",22.000,", ",fast,", 1), r"line 212: v_mps = 'fast', expected a number"),
        (lambda s: s.replace(",22.000,", ",", 1), "line 212 has 10 fields, its header 11"),
        (lambda s: s + s.splitlines()[5] + "\n", r"two samples at 0\.40 s"),
    ],
)
def test_damaged_tracks(tmp_path, edit, message):
    path = _edited(log_files.write_tracks(tmp_path / "a.csv"), edit)
    with pytest.raises(PhaseError, match=message):
        list(open_source(f"tracks:{path}"))


def test_recordings_of_one_name_are_told_apart_by_their_sources(tmp_path):
    texts = []
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        texts.append(f"tracks:{log_files.write_tracks(tmp_path / folder / 'a.csv')}")
    names = [recording.name for source in open_sources(texts) for recording in source]
    assert len(set(names)) == len(names) >= 2
    first = names[: len(names) // 2]
    assert names[len(first) :] == [f"{texts[1]}: {name}" for name in first]
    with pytest.raises(PhaseError, match="no such file"):
        open_sources([texts[0], "tracks:nowhere.csv"])


def test_wrong_sources(tmp_path):
    with pytest.raises(PhaseError, match="no such source of recordings; pass commonroad:PATH"):
        open_source("kitti:/data")
    with pytest.raises(PhaseError, match=r"no such file or folder 'nowhere\.csv'"):
        open_source("tracks:nowhere.csv")
    with pytest.raises(PhaseError, match="is a folder; pass one file"):
        open_source(f"ngsim:{tmp_path}")
    for kind, message in (
        ("commonroad", r"no CommonRoad scenario .* in this folder"),
        ("highd", r"no file NN_tracks\.csv in this folder or its data folder"),
    ):
        with pytest.raises(PhaseError, match=message):
            open_source(f"{kind}:{tmp_path}")
    log_files.write_levelx(tmp_path, exid=True)
    with pytest.raises(PhaseError, match="no map of location 2 in maps/lanelet2"):
        open_source(f"exid:{tmp_path}", read_road)
    with pytest.raises(PhaseError, match="the road is in a map file"):
        open_source(f"exid:{tmp_path}")
    log_files.write_lanelet2(tmp_path / "maps" / "lanelet2" / "2_somewhere.osm")
    _edited(tmp_path / "03_tracksMeta.csv", lambda s: s.replace("3,9,", "3,99,"))
    with pytest.raises(PhaseError, match="no line for trackId 9, which"):
        list(open_source(f"exid:{tmp_path}", read_road))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: (d / "04_tracksMeta.csv").unlink(), "04_tracksMeta.csv: cannot be read"),
        (
            lambda d: _edited(d / "04_recordingMeta.csv", lambda s: s.replace("\n3,2,", "\n4,5,")),
            "no map of location 5",
        ),
        (lambda d: _edited(d / "04_tracks.csv", lambda s: s.replace("heading", "h")), "no column heading"),
    ],
)
def test_what_is_wrong_with_the_last_recording_is_said_before_the_first_is_read(tmp_path, edit, message):
    for number in ("03", "04"):
        log_files.write_levelx(tmp_path, exid=True, number=number)
    log_files.write_lanelet2(tmp_path / "maps" / "lanelet2" / "2_somewhere.osm")
    _edited(tmp_path / "03_tracks.csv", lambda s: s.replace(",12;13,", ",", 1))  # damaged, if it is read
    edit(tmp_path)
    with pytest.raises(PhaseError, match=message):
        open_source(f"exid:{tmp_path}", read_road)


@pytest.mark.parametrize("kind", ["tracks", "ngsim"])
def test_headers_are_looked_at_before_a_track_is_read(tmp_path, kind):
    path = tmp_path / "a.csv"
    path.write_text("id,what\n1\n")
    with pytest.raises(PhaseError, match="no column"):
        open_source(f"{kind}:{path}")


def test_recordings_are_read_as_they_are_asked_for(tmp_path):
    for number in ("03", "04"):
        log_files.write_levelx(tmp_path, exid=False, number=number)
    _edited(tmp_path / "04_tracks.csv", lambda s: s + "1,2\n")
    found = open_source(f"highd:{tmp_path}")
    assert next(found).name == "highd/03"
    with pytest.raises(PhaseError, match=r"04_tracks\.csv: line .* has 2 fields"):
        next(found)


def test_a_scenario_that_is_none(tmp_path):
    pytest.importorskip("commonroad", reason="commonroad-io is not installed")
    (tmp_path / "a.xml").write_text("<commonRoad")
    with pytest.raises(PhaseError, match=r"a.xml: no CommonRoad scenario \(ParseError"):
        list(open_source(f"commonroad:{tmp_path}"))


def test_periods_with_the_same_ids_are_recordings_of_their_own(tmp_path):
    found = list(open_source(f"ngsim:{log_files.write_ngsim(tmp_path / 'a.csv', periods=2)}"))
    assert [r.name for r in found] == ["ngsim/a/0", "ngsim/a/15"]
    np.testing.assert_array_equal(found[0].x, found[1].x)


def test_tracks_on_a_network_that_is_given(tmp_path):
    net = SmallNet().edge("road", lanes_from(0.0, 400.0, 1.83, 5.49, 9.15))
    tracks = log_files.write_tracks(tmp_path / "a.csv")
    (own,) = open_source(f"tracks:{tracks}")
    (recording,) = open_source(f"tracks:{tracks}@{net.write(tmp_path / 'a.net.xml')}", read_road)
    assert [lane.id for lane in recording.network.lanes] == ["road_0", "road_1", "road_2"]
    np.testing.assert_array_equal(recording.x, own.x)


@pytest.mark.skipif(not (DATA / "i24").exists(), reason=f"{NOT_SHARED}/data/i24")
def test_i24():
    recordings = list(open_source(f"tracks:{DATA / 'i24' / 'tracks_10hz.csv'}"))
    assert [r.name.partition("/")[2] for r in recordings] == ["i/-1", "i/1", "ii/-1", "ii/1"]
    assert [r.source.partition("/")[2] for r in recordings] == ["i", "i", "ii", "ii"]
    for recording in recordings:
        places = lane_places(recording)
        assert len(recording.network.lanes) == 4
        assert (places.lane >= 0)[recording.present].mean() > 0.995
        assert 0.05 < recording.kind.count("articulated_truck") / len(recording.kind) < 0.3
    # right is right: without snow, traffic is slower lane by lane from the left to the right one
    for recording in recordings[:2]:
        lane = lane_places(recording).lane
        speeds = [float(np.median(recording.speed[lane == k])) for k in range(4)]
        assert speeds == sorted(speeds), speeds


@pytest.mark.skipif(not (DATA / "us101").exists(), reason=f"{NOT_SHARED}/data/us101")
def test_us101():
    pytest.importorskip("commonroad", reason="commonroad-io is not installed")
    (recording,) = open_source(f"commonroad:{DATA / 'us101' / 'USA_US101-23_1_T-1.xml'}")
    places = lane_places(recording)
    assert recording.source == "USA_US101"
    assert recording.present.shape == (57, 141)
    assert (places.lane >= 0)[recording.present].mean() > 0.99
    assert float(np.abs(places.lateral[recording.present]).mean()) < 0.6
    assert not any("overlaps" in flags or "against" in flags for flags in recording.flags)
    (window,) = windows(recording)
    assert len(window.agents) == 57 - sum(~recording.present[:, 0])
    assert len(build_bundle(recording.network).pools[0].start) > 1000
