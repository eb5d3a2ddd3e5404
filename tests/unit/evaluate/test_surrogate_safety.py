"""Who follows whom, how close, and how soon after another, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.evaluate import surrogate_safety
from phase_sumo.evaluate.surrogate_safety import following_pets, lane_change_pets
from tests.helpers.trajectories import make


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


def test_gap_and_time_to_collision_in_one_lane():
    t = make([(0, 0, 0, 10, 20), (0, 1, 0, 45, 10)])
    f = surrogate_safety.following(t)
    assert len(f.gap) == 1
    assert f.gap[0] == pytest.approx(30.0)  # 35 m front to front, leader 5 m long
    assert surrogate_safety.time_to_collision(t, f)[0] == pytest.approx(3.0)
    assert surrogate_safety.time_headways(t, f) == pytest.approx([35.0 / 20.0])


def test_no_conflict_when_the_leader_is_faster():
    t = make([(0, 0, 0, 10, 10), (0, 1, 0, 45, 20)])
    assert np.isinf(surrogate_safety.time_to_collision(t, surrogate_safety.following(t))).all()


def test_leader_beyond_the_lane_end_on_the_vehicles_own_way():
    # vehicle 0 goes to B through the junction; vehicle 1 is on B, vehicle 2 on the branch C
    rows = [(0, 0, 0, 90, 20), (9, 0, 3, 50, 20), (0, 1, 3, 20, 10), (0, 2, 4, 5, 10)]
    t = make(rows, lengths=(5.0, 5.0, 5.0))
    f = surrogate_safety.following(t)
    pair = {(t.vehicle[a], t.vehicle[b]): g for a, b, g in zip(f.follower, f.leader, f.gap, strict=True)}
    assert pair == {(0, 1): pytest.approx(10.0 + 10.0 + 20.0 - 5.0)}


def test_conflicts_are_counted_in_episodes():
    rows = []
    for i, gap in enumerate([60, 20, 20, 60, 20]):
        rows += [(i, 0, 0, 0, 20), (i, 1, 0, gap + 5, 10)]  # TTC = gap / 10
    t = make(rows)
    f = surrogate_safety.following(t)
    assert surrogate_safety.conflicts(t, f, 3.0) == 2
    assert surrogate_safety.conflicts(t, f, 1.5) == 0


def test_braking_that_is_needed_to_avoid_a_crash():
    # closing at 10 m/s on a gap of 20 m: 10^2 / 40; and another pair that opens
    t = make([(0, 0, 0, 10, 20), (0, 1, 0, 35, 10), (0, 2, 1, 10, 10), (0, 3, 1, 35, 20)], lengths=(5.0,) * 4)
    f = surrogate_safety.following(t)
    drac = dict(zip(t.vehicle[f.follower], surrogate_safety.deceleration_to_avoid_crash(t, f), strict=True))
    assert drac == {0: pytest.approx(2.5), 2: 0.0}
    assert surrogate_safety.needed_brakings(t, f) == 0
    assert surrogate_safety.needed_brakings(t, f, threshold=2.0) == 1


def test_gaps_of_moving_followers():
    t = make([(0, 0, 0, 10, 20), (0, 1, 0, 35, 10), (0, 2, 1, 10, 1), (0, 3, 1, 35, 20)], lengths=(5.0,) * 4)
    assert surrogate_safety.moving_gaps(t, surrogate_safety.following(t)) == pytest.approx([20.0])
