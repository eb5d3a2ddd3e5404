"""Hand-computed gaps, headways and conflicts."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.evaluate import surrogate_safety
from tests.trajectories import make


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
