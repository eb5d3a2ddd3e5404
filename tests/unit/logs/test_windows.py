"""Lane changes and windows, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from phase_sumo.errors import PhaseError
from phase_sumo.logs.lane_matching import lane_changes, lane_places
from phase_sumo.logs.recorded_roads import Strip, strip_road
from phase_sumo.logs.windows import windows
from tests.helpers.recordings import recording_of

T = 250  # samples
X = 2.0 * np.arange(T)
BORDER = 1.8  # m, y of the marking between the first two lanes


def _changes(y, x=X, **kwargs):
    recording = recording_of(x[None], y[None], **kwargs)
    return lane_changes(recording, lane_places(recording))


def _ramp(begin, end, low=0.0, high=3.6):
    return low + (high - low) * np.clip((np.arange(T) - begin) / (end - begin), 0.0, 1.0)


def test_a_lane_change_counts_once_from_firmly_here_to_firmly_there():
    found = _changes(_ramp(100, 137))  # 3.6 / 37 m per sample: 13.4 samples to 1.3 m, 23.6 to 2.3 m
    assert found.vehicle.tolist() == [0]
    assert (found.begin[0], found.end[0]) == (113, 124)


def test_jitter_at_a_marking_and_riding_on_it_do_not_count():
    wobble = BORDER + 0.45 * np.sin(np.arange(T))
    assert len(_changes(wobble).vehicle) == 0
    # over to the marking and back
    assert (
        len(
            _changes(np.where(np.arange(T) < 125, _ramp(50, 80, 0.0, 2.2), _ramp(140, 170, 2.2, 0.0))).vehicle
        )
        == 0
    )


def test_there_and_back_are_two_and_a_gap_hides_one():
    y = np.where(np.arange(T) < 125, _ramp(50, 80), _ramp(150, 180, 3.6, 0.0))
    assert len(_changes(y).vehicle) == 2
    x = X.copy()
    x[60:70] = np.nan
    assert len(_changes(y, x).vehicle) == 1


def test_going_on_into_the_next_lanelet_or_taking_a_fork_is_no_lane_change():
    def strip(name, x0, x1, y0, y1, successors=()):
        middle, up = np.array([[x0, y0], [x1, y1]]), np.array([0.0, 1.8])
        return Strip(name, middle + up, middle - up, -1, -1, False, False, successors)

    road = strip_road(
        "fork",
        [
            strip("a", 0, 200, 0, 0, (1, 2)),
            strip("straight", 200, 500, 0, 0),
            strip("exit", 200, 500, 0, -20),
        ],
    )
    assert len(_changes(0.0 * X, network=road).vehicle) == 0
    assert len(_changes(-20.0 / 300.0 * np.maximum(X - 200.0, 0.0), network=road).vehicle) == 0
    # but leaving the straight lane for the exit once they are apart is one
    away = -np.clip((X - 280.0) * 0.2, 0.0, 20.0 / 300.0 * np.maximum(X - 200.0, 0.0))
    assert len(_changes(away, network=road).vehicle) == 1


def _three():
    """Drives on; changes lanes in samples 113..124; is lost after sample 60 and seen again from 80 on."""
    x = np.stack((X, X + 60.0, X + 120.0))
    x[2, 61:80] = np.nan
    return recording_of(x, np.stack((0.0 * X, _ramp(100, 137), 7.2 + 0.0 * X)))


def _begins(found):
    """Samples of the whole recording, from where the first vehicle is."""
    return [round(w.recording.x[0, w.begin] / 2.0) for w in found]


def test_windows_do_not_overlap_and_the_last_one_may_be_shorter():
    found = windows(_three(), lane_changes_only=False)
    assert _begins(found) == [0, 100] and [w.steps for w in found] == [100, 100]  # 4.9 s are left: too short
    *_, last = windows(_three(), lane_changes_only=False, shortest=4.0)
    assert _begins([last]) == [200] and last.steps == 49
    assert _begins(windows(_three(), 10.0, False, stride=5.0)) == [0, 50, 100, 150]


def test_a_window_holds_its_agents_and_ten_seconds_before_and_nothing_of_the_recording():
    whole = replace(_three(), length=np.array([4.0, 5.0, 18.0]), kind=("car", "car", "articulated_truck"))
    late = windows(whole, 3.0, False, stride=7.0)[2]  # from sample 140 on
    assert (late.begin, late.steps) == (100, 30)
    np.testing.assert_array_equal(late.recording.x, whole.x[:, 40:171])
    gone = windows(whole, 1.0, False, stride=6.5)[1]  # at sample 65 the last vehicle is lost
    assert gone.agents.tolist() == [0, 1] and gone.recording.kind == ("car", "car")
    np.testing.assert_array_equal(gone.recording.length, [4.0, 5.0])
    np.testing.assert_array_equal(gone.recording.x, whole.x[:2, :76])
    assert not any(np.shares_memory(gone.recording.x, a) for a in (whole.x, whole.y))


def test_drivers_like_to_drive_what_most_do_in_their_lane_all_day():
    slow = np.broadcast_to(np.where(np.arange(T) < 200, 20.0, 30.0), (2, T))  # 20 % of the time at 30 m/s
    recording = recording_of(
        np.stack((X, X)), np.stack((0.0 * X, 3.6 + 0.0 * X)), speed=slow - [[0.0], [7.0]]
    )
    first = windows(recording, 5.0, lane_changes_only=False)[0]
    assert first.lane_speed.tolist() == [30.0, 23.0]


def test_only_windows_with_a_whole_lane_change_are_kept():
    (only,) = windows(_three())
    assert _begins([only]) == [100] and only.lane_changes == 1
    assert _begins(windows(_three(), seconds=1.2, stride=0.1, shortest=1.2)) == [112, 113]
    assert windows(_three(), seconds=1.0, stride=0.1, shortest=1.0) == []


def test_agents_are_those_there_at_the_begin_until_they_are_lost():
    first, second = windows(_three(), lane_changes_only=False)
    assert first.agents.tolist() == [0, 1, 2] and first.last.tolist() == [100, 100, 60]
    assert second.last.tolist() == [200, 200, 200]
    (late,) = windows(_three(), seconds=17.9, stride=20.0, shortest=17.9, lane_changes_only=False)
    assert late.steps == 179
    recording = recording_of(np.stack((X, X)), np.stack((0.0 * X, 30.0 + 0.0 * X)))  # one far from the road
    assert windows(recording, lane_changes_only=False)[0].agents.tolist() == [0]


def test_flagged_vehicles_can_be_left_out():
    flagged = replace(_three(), flags=(frozenset(), frozenset({"jumps"}), frozenset({"breaks"})))
    assert windows(flagged, lane_changes_only=False, without=frozenset({"jumps"}))[0].agents.tolist() == [
        0,
        2,
    ]
    assert windows(flagged, without=frozenset({"jumps"})) == []  # it was the one that changed lanes
    with pytest.raises(PhaseError, match="no flag wobbles; there are breaks, overlaps"):
        windows(flagged, without=frozenset({"wobbles"}))
    with pytest.raises(PhaseError, match="seconds 0: pass at least"):
        windows(flagged, seconds=0.0)
