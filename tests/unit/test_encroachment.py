"""Post-encroachment times against closed forms at constant speeds."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.evaluate.surrogate_safety import following_pets, lane_change_pets
from tests.trajectories import make


def drive(vehicle, lane, start, speed, until=100.0, begin=0.0, step=0.5):
    """Rows of a vehicle at constant speed from ``start`` m at ``begin`` s."""
    times = np.arange(begin, begin + 60.0, step)
    return [
        (time, vehicle, lane, start + speed * (time - begin), speed)
        for time in times
        if start + speed * (time - begin) < until
    ]


def test_following_at_one_speed():
    # 30 m front to front, 5 m long leader, 10 m/s: the rear leaves the line 2.5 s before the front comes
    t = make(drive(0, 0, 0, 10) + drive(1, 0, 30, 10), period=0.5)
    pets = following_pets(t)
    assert sorted(pets) == [pytest.approx(2.5), np.inf]  # the leader follows nobody


def test_a_faster_follower_comes_sooner():
    # line at 50 m: the leader's rear leaves at 4.0 + 0.5 s, the follower at 20 m/s arrives 1.25 s after 4 s
    t = make(drive(0, 0, 25, 20, begin=4.0) + drive(1, 0, 10, 10), period=0.5)
    assert following_pets(t).min() == pytest.approx(0.75)


def test_overlap_in_time_is_zero_and_far_apart_is_no_encounter():
    beside = make(drive(0, 0, 0, 10) + drive(1, 0, 2, 10), period=0.5)
    assert following_pets(beside).min() == 0.0
    apart = make(drive(0, 0, 0, 10) + drive(1, 0, 0, 10, begin=20.0), period=0.5)
    assert np.isinf(following_pets(apart)).all()


def test_rear_of_a_long_vehicle_leaves_later():
    t = make(drive(0, 0, 0, 10) + drive(1, 0, 40, 10), period=0.5, lengths=(5.0, 25.0))
    assert following_pets(t).min() == pytest.approx(4.0 - 2.5)


def test_lane_change_between_two_vehicles():
    # all at 10 m/s; vehicle 0 enters lane 1 at 3 s with its front at 50 m
    change = [(k, 0, 0 if k < 3 else 1, 20 + 10 * k, 10) for k in range(8)]
    ahead = [(k, 1, 1, 45 + 10 * k, 10) for k in range(6)]  # its front was at 50 m at 0.5 s, its rear at 1 s
    behind = [(k, 2, 1, 5 + 10 * k, 10) for k in range(10)]  # its front reaches 50 m at 4.5 s
    t = make(change + ahead + behind, lengths=(5.0, 5.0, 5.0))
    to_leader, to_follower = lane_change_pets(t)
    assert to_leader == pytest.approx([3.0 - 1.0])
    assert to_follower == pytest.approx([4.5 - 3.5])  # vehicle 0's own rear is there at 3.5 s


def test_lane_change_on_an_empty_road():
    t = make([(k, 0, 0 if k < 3 else 1, 20 + 10 * k, 10) for k in range(8)])
    to_leader, to_follower = lane_change_pets(t)
    assert np.isinf(to_leader).all()
    assert np.isinf(to_follower).all()
    assert len(to_leader) == 1
