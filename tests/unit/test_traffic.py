"""Hand-computed values of the traffic measures."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.evaluate import traffic
from phase_sumo.evaluate.corridor import along, find_corridor, speed_profile
from phase_sumo.evaluate.trajectories import Trajectories

# edge A (lanes 0, 1; 100 m) -> junction :J (10 m) -> edge B (lane 3; 200 m), and a branch C (lane 4)
LANES = ("A_0", "A_1", ":J_0", "B_0", "C_0")
EDGES = ("A", "A", ":J", "B", "C")
LENGTHS = (100.0, 100.0, 10.0, 200.0, 200.0)
NEXT = ((2, 4), (), (3,), (), ())


def make(rows, period=1.0, lengths=(5.0, 5.0)):
    """Rows of (time, vehicle, lane, position, speed)."""
    rows = np.array(sorted(rows), float).reshape(-1, 5)
    size = len(rows)
    zeros = np.zeros(size)
    return Trajectories(
        time=rows[:, 0],
        vehicle=rows[:, 1].astype(np.int64),
        x=rows[:, 3],
        y=zeros,
        yaw=zeros,
        hitch=zeros,
        speed=rows[:, 4],
        accel=zeros,
        lane=rows[:, 2].astype(np.int64),
        position=rows[:, 3],
        lateral=zeros,
        controlled=np.zeros(size, bool),
        vehicle_ids=tuple(f"v{i}" for i in range(len(lengths))),
        vehicle_types=("car",) * len(lengths),
        shape=np.tile([5.0, 1.8, 3.0, 1.0, 0, 0, 0, 0], (len(lengths), 1)),
        length=np.array(lengths),
        lane_ids=LANES,
        lane_edges=EDGES,
        lane_length=np.array(LENGTHS),
        lane_speed=np.full(5, 30.0),
        lane_next=NEXT,
        period=period,
    )


def test_distance_and_mean_speed():
    # 10 m/s for 2 s and 20 m/s for 1 s: 20 m + 20 m in 3 s
    t = make([(0, 0, 0, 0, 10), (1, 0, 0, 10, 10), (2, 0, 0, 20, 10), (0, 1, 1, 0, 20), (1, 1, 1, 20, 20)])
    assert traffic.vehicle_km(t) == pytest.approx(0.040)
    assert traffic.mean_speed(t) == pytest.approx(40.0 / 3.0)


def test_absence_from_the_observed_road_is_no_distance():
    t = make([(0, 0, 0, 0, 10), (1, 0, 0, 10, 10), (9, 0, 0, 50, 10), (10, 0, 0, 60, 10)])
    assert traffic.vehicle_km(t) == pytest.approx(0.020)


def test_flow_counts_each_passage_once():
    t = make([(0, 0, 0, 40, 20), (1, 0, 0, 60, 20), (2, 0, 0, 80, 20), (0, 1, 0, 45, 70), (1, 1, 2, 5, 70)])
    assert traffic.flow(t, "A", 50.0, 0.0, 10.0) == pytest.approx(2 * 360.0)
    assert traffic.flow(t, "A", 95.0, 0.0, 10.0) == pytest.approx(360.0)


def test_lane_changes_within_an_edge_only():
    t = make([(0, 0, 1, 10, 20), (1, 0, 0, 30, 20), (2, 0, 0, 50, 20), (3, 0, 2, 5, 20), (4, 0, 3, 5, 20)])
    assert traffic.lane_changes(t) == 1


def test_hard_braking_is_counted_in_episodes():
    speeds = [20, 16, 12, 12, 8, 8]  # -4, -4, 0, -4, 0 m/s^2
    t = make([(i, 0, 0, 10 * i, v) for i, v in enumerate(speeds)])
    assert traffic.hard_brakings(t) == 2
    assert traffic.hard_brakings(t, threshold=-4.5) == 0


def test_gap_and_time_to_collision_in_one_lane():
    t = make([(0, 0, 0, 10, 20), (0, 1, 0, 45, 10)])
    f = traffic.following(t)
    assert len(f.gap) == 1
    assert f.gap[0] == pytest.approx(30.0)  # 35 m front to front, leader 5 m long
    assert traffic.time_to_collision(t, f)[0] == pytest.approx(3.0)
    assert traffic.time_headways(t, f) == pytest.approx([35.0 / 20.0])


def test_no_conflict_when_the_leader_is_faster():
    t = make([(0, 0, 0, 10, 10), (0, 1, 0, 45, 20)])
    assert np.isinf(traffic.time_to_collision(t, traffic.following(t))).all()


def test_leader_beyond_the_lane_end_on_the_vehicles_own_way():
    # vehicle 0 goes to B through the junction; vehicle 1 is on B, vehicle 2 on the branch C
    rows = [(0, 0, 0, 90, 20), (9, 0, 3, 50, 20), (0, 1, 3, 20, 10), (0, 2, 4, 5, 10)]
    t = make(rows, lengths=(5.0, 5.0, 5.0))
    f = traffic.following(t)
    pair = {(t.vehicle[a], t.vehicle[b]): g for a, b, g in zip(f.follower, f.leader, f.gap, strict=True)}
    assert pair == {(0, 1): pytest.approx(10.0 + 10.0 + 20.0 - 5.0)}


def test_conflicts_are_counted_in_episodes():
    rows = []
    for i, gap in enumerate([60, 20, 20, 60, 20]):
        rows += [(i, 0, 0, 0, 20), (i, 1, 0, gap + 5, 10)]  # TTC = gap / 10
    t = make(rows)
    f = traffic.following(t)
    assert traffic.conflicts(t, f, 3.0) == 2
    assert traffic.conflicts(t, f, 1.5) == 0


def test_measures_of_no_traffic():
    result = traffic.measures(make([]), ("A", 50.0), 0.0, 10.0)
    assert result["vehicle_km"] == 0.0
    assert result["flow"] == 0.0


def test_corridor_joins_the_busiest_edges():
    t = make([(0, 0, 0, 95, 20), (1, 0, 2, 5, 20), (2, 0, 3, 15, 30), (3, 0, 3, 45, 30)])
    corridor = find_corridor(t)
    assert corridor.start == {"A": 0.0, ":J": 100.0, "B": 110.0}
    np.testing.assert_allclose(along(t, corridor), [95.0, 105.0, 125.0, 155.0])
    assert np.isnan(speed_profile(t, corridor)[1]).all()  # too few samples to say


def test_trajectories_round_trip(tmp_path):
    t = make([(0, 0, 0, 10, 20), (0, 1, 0, 45, 10)])
    t.save(tmp_path / "t.npz")
    again = Trajectories.load(tmp_path / "t.npz")
    assert again.lane_next == t.lane_next
    assert again.vehicle_ids == t.vehicle_ids
    np.testing.assert_allclose(again.position, t.position)
