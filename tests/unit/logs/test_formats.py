"""The same scene, written in every format, comes back as the same recording."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.maps.lanelet2 import read_road
from phase_sumo.logs.lane_matching import lane_places
from phase_sumo.logs.sources import open_source
from phase_sumo.logs.windows import windows
from tests.helpers import log_files
from tests.helpers.log_files import LANES, ROAD, SCENE, WIDTH

HEIGHT = LANES * WIDTH


def _exid(folder):
    log_files.write_levelx(folder / "data", exid=True)
    log_files.write_lanelet2(folder / "maps" / "lanelet2" / "2_somewhere.osm")
    return f"exid:{folder}"


# where the right border of the scene's road begins, and where the road leads, in the recording's coordinates
FORMATS = {
    "tracks": (lambda d: f"tracks:{log_files.write_tracks(d / 'a.csv')}", (0.0, 0.0, 0.0)),
    "tracks_mirrored": (
        lambda d: f"tracks:{log_files.write_tracks(d / 'a.csv', direction=-1)}",
        (0.0, -(LANES + 3) * WIDTH, 0.0),
    ),
    "commonroad": (lambda d: f"commonroad:{log_files.write_commonroad(d / 'a.xml')}", (0.0, 0.0, 0.0)),
    "exid": (_exid, (0.0, 0.0, 0.0)),
    "highd_lower": (
        lambda d: f"highd:{log_files.write_levelx(d, exid=False).parent}",
        (0.0, -20.0 - HEIGHT, 0.0),
    ),
    "highd_upper": (
        lambda d: f"highd:{log_files.write_levelx(d, exid=False, upper=True).parent}",
        (ROAD, -2.0, np.pi),
    ),
    "ngsim": (lambda d: f"ngsim:{log_files.write_ngsim(d / 'a.csv')}", (0.0, -HEIGHT, 0.0)),
    "ngsim_text": (
        lambda d: f"ngsim:{log_files.write_ngsim(d / 'a.txt', header=False)}",
        (0.0, -HEIGHT, 0.0),
    ),
}


@pytest.fixture(params=FORMATS)
def recorded(request, tmp_path):
    if request.param == "commonroad":
        pytest.importorskip("commonroad", reason="commonroad-io is not installed")
    write, frame = FORMATS[request.param]
    (recording,) = open_source(write(tmp_path), read_road)
    return recording, frame


def _placed(frame, x, y):
    x0, y0, turn = frame
    return x0 + x * np.cos(turn) - y * np.sin(turn), y0 + x * np.sin(turn) + y * np.cos(turn)


def test_positions_headings_and_speeds_are_those_of_the_scene(recorded):
    recording, frame = recorded
    time = 0.1 * np.arange(recording.present.shape[1])
    for row, vehicle in enumerate(SCENE):
        here = recording.present[row]
        np.testing.assert_array_equal(here, time > vehicle.begin - 1e-6)
        x, y, yaw = vehicle.at(time[here])
        x, y = _placed(frame, x, y)
        np.testing.assert_allclose(recording.x[row, here], x, atol=0.02)
        np.testing.assert_allclose(recording.y[row, here], y, atol=0.05)
        turn = recording.yaw[row, here] - yaw - frame[2]
        np.testing.assert_allclose(np.sin(turn), 0.0, atol=0.015)
        assert (np.cos(turn) > 0).all()
        np.testing.assert_allclose(recording.speed[row, here], vehicle.speed / np.cos(yaw), atol=0.02)
        assert np.isnan(recording.x[row, ~here]).all()


def test_boxes_types_and_flags(recorded):
    recording, _ = recorded
    np.testing.assert_allclose(recording.length, [v.length for v in SCENE], atol=1e-3)
    np.testing.assert_allclose(recording.width, [v.width for v in SCENE], atol=1e-3)
    assert recording.kind == tuple(v.kind for v in SCENE)
    assert recording.flags == (frozenset(),) * len(SCENE)


def test_sources_are_places_and_scenes(tmp_path):
    """What the user tells apart: not the files of one place, nor the directions of one scene."""
    pytest.importorskip("commonroad", reason="commonroad-io is not installed")
    expected = {
        "tracks": "a/a",
        "tracks_mirrored": "a/a",
        "commonroad": "DEU_Straight",
        "exid": "exid/location 2",
        "highd_lower": "highd",
        "ngsim": "ngsim/a",
    }
    for kind, name in expected.items():
        (tmp_path / kind).mkdir()
        (recording,) = open_source(FORMATS[kind][0](tmp_path / kind), read_road)
        assert recording.source == name
    about = tmp_path / "highd_lower" / "03_recordingMeta.csv"
    lines = about.read_text().splitlines()
    about.write_text(f"locationId,{lines[0]}\n5,{lines[1]}\n")
    (recording,) = open_source(f"highd:{about.parent}")
    assert recording.source == "highd/location 5"


def test_vehicles_are_in_their_lanes(recorded):
    recording, _ = recorded
    places, lanes = lane_places(recording), recording.network.lanes
    at = places.lane[:, 35]  # 3.5 s: before the lane change, and on the first half of the road
    assert (places.lane >= 0)[recording.present].all()
    assert at[0] == at[2] and at[1] == at[3]
    # the first vehicle is in the right-hand lane, two to the right of the second one; x is along the lane
    assert lanes[at[0]].right == -1 and not lanes[at[0]].solid_right
    middle = lanes[at[0]].left
    assert lanes[middle].left == at[1] or lanes[middle].solid_left
    assert (np.cos(recording.yaw - places.yaw)[recording.present] > 0.99).all()
    # its lane change is a lane's width to the left
    y = places.lateral[0]
    assert y[40] == pytest.approx(y[90], abs=0.02) and places.lane[0, 40] != places.lane[0, 90]
    across = places.lateral[0, 41:70]
    assert across.max() > 1.5 and across.min() < -1.5 and across.argmax() < across.argmin()
    assert np.abs([lane.width - WIDTH for lane in lanes]).max() < 0.02


def test_the_one_lane_change_makes_the_window(recorded):
    recording, _ = recorded
    (window,) = windows(recording)
    assert (window.begin, window.steps, window.lane_changes) == (0, 100, 1)
    np.testing.assert_array_equal(window.agents, [0, 1, 2])  # the last vehicle comes later
    np.testing.assert_array_equal(window.last, 100)
