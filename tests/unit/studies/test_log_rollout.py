"""Recorded windows in SUMO: where lanes lie, where vehicles start, and that they drive on."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.logs.lane_matching import lane_places
from phase_sumo.logs.recorded_roads import extended
from phase_sumo.logs.sources import open_source
from phase_sumo.logs.windows import windows
from phase_sumo.studies.log_rollout import roll_out
from phase_sumo.studies.log_scenario import write_road
from tests.helpers.places import NOT_SHARED, SHARED
from tests.helpers.standin import Standin
from tests.helpers.steady_recordings import recording, road

US101 = SHARED / "data" / "us101"
CARS = [(60.0, 0, 20.0), (100.0, 0, 18.0), (70.0, 1, 22.0), (130.0, 2, 25.0)]


def farthest(points, lines):
    """m of the points [P, 2] from the nearest of some polylines."""
    dense = np.concatenate([np.linspace(a, b, 200) for line in lines for a, b in pairwise(line)])
    return max((float(np.hypot(*(dense - p).T).min()) for p in points), default=0.0)


@pytest.mark.parametrize("left_hand", [False, True])
@pytest.mark.parametrize("radius", [0.0, 300.0])
def test_lanes_lie_in_sumo_where_they_were(tmp_path, radius, left_hand):
    network = replace(road(300.0, radius, sections=2), left_hand=left_hand)
    sumo = write_road(network, tmp_path)
    back = read_network(sumo.path, "all")
    for lane in network.lanes:
        lines = [other.points for other in back.lanes]
        assert farthest(lane.points[1:-1], lines) < 0.05
        assert farthest(lane.points, lines) < 0.5  # half a junction, along the road
    for lane in back.lanes:
        assert farthest(lane.points[1:-1], [other.points for other in network.lanes]) < 0.05
    assert sumo.number == ((2, 1, 0) if left_hand else (0, 1, 2)) * 2
    assert back.left_hand == left_hand
    assert [lane.left >= 0 for lane in back.lanes if not lane.connector].count(True) == 4
    assert sumo.route("e0", "e1") == ["e0", "e1"]


@pytest.mark.skipif(not US101.exists(), reason=f"{NOT_SHARED}/data/us101")
def test_a_recorded_map_keeps_its_place(tmp_path):
    (recorded,) = open_source(f"commonroad:{US101 / 'USA_US101-23_1_T-1.xml'}")
    back = read_network(write_road(recorded.network, tmp_path).path, "all")
    lines = [lane.points for lane in back.lanes]
    distance = [farthest(lane.points, lines) for lane in recorded.network.lanes]
    assert np.median(distance) < 0.05
    assert max(distance) < 0.5


@pytest.mark.parametrize("model", ["phase", "idm"])
@pytest.mark.parametrize("left_hand", [False, True])
@pytest.mark.parametrize("radius", [0.0, 400.0])
def test_rollouts_start_as_recorded_and_drive_on(tmp_path, model, radius, left_hand):
    network = replace(road(radius=radius), left_hand=left_hand)
    log = recording(CARS, radius=radius, lengths=[4.6, 18.0, 4.6, 4.6], network=network)
    (window,) = windows(log, 2.0, lane_changes_only=False, shortest=2.0, stride=2.0)
    longer = extended(log.network, 60.0, 300.0)
    where = lane_places(window.recording, longer)
    found = roll_out(window, write_road(longer, tmp_path), where, model, Standin())
    assert found.present.all()
    assert found.x.shape == (4, 21)
    moved = np.hypot(found.x[:, 0] - log.x[:, 0], found.y[:, 0] - log.y[:, 0])
    # a trailer bends with the road; its record is one straight box
    assert (moved < [0.02, 0.2 if radius and model == "phase" else 0.02, 0.02, 0.02]).all()
    assert found.speed[:, 0] == pytest.approx(log.speed[:, 0], abs=0.01)
    step = np.hypot(np.diff(found.x), np.diff(found.y)) / 0.1
    assert step == pytest.approx(found.speed[:, 1:], abs=0.4)
    assert np.abs(np.diff(found.speed)).max() < 0.5  # nobody brakes in an emergency at the start
    there = lane_places(found, longer).lane
    assert (there >= 0).all() and (there[:, 0] == where.lane[:, 0]).all()


@pytest.mark.skipif(not US101.exists(), reason=f"{NOT_SHARED}/data/us101")
def test_who_starts_within_a_junction_is_there_from_the_first_sample(tmp_path):
    """Two of this scene's do, where lanelets end."""
    (recorded,) = open_source(f"commonroad:{US101 / 'USA_US101-23_1_T-1.xml'}")
    longer = extended(recorded.network, 60.0, 300.0)
    sumo = write_road(longer, tmp_path)
    for window in windows(recorded, 1.0, lane_changes_only=False, stride=5.0, shortest=1.0):
        found = roll_out(window, sumo, lane_places(window.recording, longer), "phase", Standin())
        at = window.begin
        assert found.present.all()
        assert found.x[:, 0] == pytest.approx(window.recording.x[:, at], abs=0.02)
        assert found.speed[:, 0] == pytest.approx(window.recording.speed[:, at], abs=0.01)
        # nobody takes the way that it was put on its place for its speed
        step = np.hypot(np.diff(found.x), np.diff(found.y))
        assert step[:, 0] == pytest.approx(0.1 * window.recording.speed[:, at], abs=0.2)


@pytest.mark.parametrize("left_hand", [False, True])
def test_sumos_drivers_keep_their_place_in_the_lane(tmp_path, left_hand):
    straight = recording(CARS, network=replace(road(), left_hand=left_hand))
    log = replace(straight, y=straight.y + np.array([[0.6], [-0.6], [0.3], [0.0]]))
    (window,) = windows(log, 3.0, lane_changes_only=False, shortest=3.0)
    longer = extended(log.network, 60.0, 300.0)
    where = lane_places(window.recording, longer)
    found = roll_out(window, write_road(longer, tmp_path), where, "idm")
    assert found.y[:, :5] == pytest.approx(log.y[:, :5], abs=0.02)


def test_the_same_seed_gives_the_same_rollout(tmp_path):
    log = recording(CARS)
    window, longer = windows(log, 1.0, False, shortest=1.0)[0], extended(log.network, 60.0, 200.0)
    sumo, where = write_road(longer, tmp_path), lane_places(window.recording, longer)
    first, again = (roll_out(window, sumo, where, "idm", seed=2) for _ in range(2))
    assert np.array_equal(first.x, again.x)
