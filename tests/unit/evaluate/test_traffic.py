"""Hand-computed values of the traffic measures.

Flow, density and speed of cells whose vehicles are spaced by hand.
"""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.evaluate import traffic
from phase_sumo.evaluate.traffic import along, edie_cells, find_corridor, speed_profile
from phase_sumo.evaluate.trajectories import Trajectories
from tests.helpers.trajectories import make


def test_even_stream_has_its_closed_form():
    # lane 3 is 200 m long: 10 m/s, a vehicle every 20 m = every 2 s, for 120 s
    rows = [
        (float(time), k, 3, 10.0 * (time - 2 * k), 10.0)
        for k in range(-10, 61)
        for time in range(121)
        if 0.0 <= time - 2 * k <= 20
    ]
    number = {k: i for i, k in enumerate(sorted({r[1] for r in rows}))}
    t = make([(a, number[k], *rest) for a, k, *rest in rows], lengths=(5.0,) * len(number))
    cells = edie_cells(t, cell=100.0, duration=60.0)
    assert len(cells.flow) == 4  # two places, two slices
    np.testing.assert_allclose(cells.density, 50.0, rtol=0.03)
    np.testing.assert_allclose(cells.flow, 1800.0, rtol=0.03)
    np.testing.assert_allclose(cells.speed, 10.0)
    np.testing.assert_allclose(cells.flow, 3.6 * cells.density * cells.speed)


def test_each_lane_is_a_cell_of_its_own_and_junctions_are_none():
    rows = [(k, v, lane, 10.0 + 2 * k, 2.0) for v, lane in ((0, 0), (1, 1), (2, 2)) for k in range(11)]
    cells = edie_cells(make(rows, lengths=(5.0,) * 3), cell=100.0, duration=10.0)
    # one vehicle on 100 m all the time, 20 m driven in 10 s
    assert cells.density == pytest.approx([10.0, 10.0])
    assert cells.flow == pytest.approx([72.0, 72.0])


def test_a_run_shorter_than_a_slice_has_no_cells():
    assert len(edie_cells(make([(0, 0, 0, 0, 10), (1, 0, 0, 10, 10)])).flow) == 0
    assert len(edie_cells(make([])).flow) == 0


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
    changes = traffic.lane_changes(t)
    assert t.time[changes.after].tolist() == [1.0]


def test_hard_braking_is_counted_in_episodes():
    speeds = [20, 16, 12, 12, 8, 8]  # -4, -4, 0, -4, 0 m/s^2
    t = make([(i, 0, 0, 10 * i, v) for i, v in enumerate(speeds)])
    assert traffic.hard_brakings(t) == 2
    assert traffic.hard_brakings(t, threshold=-4.5) == 0


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


def test_delay_is_the_time_beyond_that_at_the_own_target_speed():
    # 40 m in 2 s at 20 m/s; at the target of 25 m/s the same way takes 1.6 s
    t = make([(0, 0, 0, 0, 20), (1, 0, 0, 20, 20), (2, 0, 0, 40, 20)], target=25.0)
    assert traffic.delay(t) == pytest.approx(0.4)
    assert traffic.delay(make([(0, 0, 0, 0, 20), (1, 0, 0, 20, 20)], target=0.0)) == 0.0  # no target known


def test_jerk_is_the_change_of_acceleration_between_steps():
    speeds = [10, 11, 13, 13]  # 1, 2, 0 m/s^2
    t = make([(i, 0, 0, 10 * i, v) for i, v in enumerate(speeds)])
    np.testing.assert_allclose(traffic.jerk(t), [1.0, -2.0])
