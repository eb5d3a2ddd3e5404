"""Quantities of scenes made by hand, Wasserstein distances, likelihoods and clusters."""

from dataclasses import replace

import numpy as np
import pytest

from phase_sumo.evaluate.realism.distances import centroid_distances, k_means
from phase_sumo.evaluate.realism.quantities import likelihoods, quantities, samples, wasserstein
from phase_sumo.evaluate.realism.selection import alike, recorded
from phase_sumo.logs.recorded_roads import extended
from phase_sumo.logs.recording import Window
from tests.helpers.steady_recordings import WIDTH, recording, road


def test_wasserstein_is_scipys():
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(0)
    x, y, u, v = rng.normal(size=40), rng.gamma(2.0, size=25), rng.random(40), rng.random(25)
    expected = stats.wasserstein_distance(x, y, u, v)
    assert wasserstein(x, y, u, v) == pytest.approx(float(expected))


def test_wasserstein_of_a_shift_is_the_shift():
    x, once = np.arange(7.0), np.ones(7)
    assert wasserstein(x, x + 2.5, once, once) == pytest.approx(2.5)
    assert np.isnan(wasserstein(x, x, once, 0.0 * once))


def test_quantities_of_a_follower_by_hand():
    """10 m/s behind 8 m/s in one lane, front bumpers 40 m apart, and another car abreast of it."""
    scene = recording([(50.0, 0, 10.0), (90.0, 0, 8.0), (50.0, 1, 10.0)], samples=11)
    q = quantities(scene, extended(scene.network, 60.0, 400.0))
    closing = 2.0 * 0.1 * np.arange(11)
    gap = 40.0 - 4.6 - closing
    assert q.gap[0] == pytest.approx(gap)
    assert np.isnan(q.gap[1:]).all()
    assert q.time_headway[0] == pytest.approx((gap + 4.6) / 10.0)
    assert q.ttc[0] == pytest.approx(gap / 2.0)
    assert np.isinf(q.ttc[1:]).all()
    assert q.nearest[0] == pytest.approx(np.full(11, WIDTH - 1.9))
    assert q.road_edge[0] == pytest.approx(np.full(11, 0.5 * 1.9 - 0.5 * WIDTH))
    assert q.lateral == pytest.approx(np.zeros((3, 11)), abs=1e-9)
    assert q.acceleration[:, 5:] == pytest.approx(np.zeros((3, 6)), abs=1e-9)
    assert np.isnan(q.acceleration[:, :5]).all()
    assert q.km == pytest.approx([0.01, 0.008, 0.01])


def test_acceleration_and_yaw_rate_on_a_curve():
    scene = recording([(20.0, 1, 20.0)], radius=400.0)
    braking = replace(scene, speed=scene.speed - 1.5 * 0.1 * np.arange(31))
    q = quantities(braking, extended(scene.network, 60.0, 400.0))
    assert q.acceleration[0, 5:] == pytest.approx(np.full(26, -1.5))
    assert q.yaw_rate[0, 5:] == pytest.approx(np.full(26, 20.0 / 400.0))


def test_a_lane_change_lasts_as_long_as_it_is_near_the_marking():
    """At 1 m/s sideways the centre is within 0.5 m of the marking for 1 s."""
    scene = recording([(50.0, 0, 20.0)], samples=51)
    y = np.clip(0.1 * np.arange(51) - 0.5, 0.0, WIDTH)
    q = quantities(replace(scene, y=y[None]), extended(scene.network, 60.0, 400.0))
    assert q.changes.tolist() == [1]
    assert samples(q)["lane_change_duration"] == pytest.approx([1.0], abs=0.11)


def test_likelihood_of_one_bin_by_hand():
    """31 samples at one speed: p = 31.1 / (31 + 18 x 0.1) when the same, 0.1 / 32.8 when another."""
    same = recording([(50.0, 0, 10.0)])
    other = recording([(50.0, 0, 20.0)])
    longer = extended(same.network, 60.0, 400.0)
    q, r = quantities(same, longer), quantities(other, longer)
    assert likelihoods(q, q)["speed"] == pytest.approx([31.1 / 32.8])
    assert likelihoods(q, r)["speed"] == pytest.approx([0.1 / 32.8])


def test_a_scene_ends_where_the_log_loses_a_vehicle():
    whole = recording([(50.0, 0, 10.0), (90.0, 1, 12.0), (10.0, 2, 9.0)], samples=31)
    rows = np.array([2, 0])
    window = Window(whole.cut(rows, 0, 31), rows, 5, 20, np.array([25, 15]), 0, np.full(2, 10.0))
    log = recorded(window)
    assert log.present.sum(1).tolist() == [21, 11]
    assert log.x[0] == pytest.approx(whole.x[2, 5:26])
    simulated = alike(replace(log, present=np.ones((2, 21), bool), x=np.ones((2, 21))), log)
    assert simulated.present.tolist() == log.present.tolist()
    assert np.isnan(simulated.x[1, 11:]).all()


def test_k_means_finds_what_was_put_there():
    rng = np.random.default_rng(1)
    centres = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    points = np.concatenate(
        [c + 0.1 * rng.normal(size=(n, 2)) for c, n in zip(centres, (60, 40, 20), strict=True)]
    )
    found = k_means(points, 3, seed=4)
    assert found == pytest.approx(centres, abs=0.1)  # the largest first
    assert np.array_equal(found, k_means(points, 3, seed=4))
    moved = points + np.array([0.0, 0.5])
    expected = [
        np.linalg.norm(moved[i].mean(0) - c)
        for i, c in zip((slice(60), slice(60, 100)), found[:2], strict=True)
    ]
    assert centroid_distances(moved, found)[:2] == pytest.approx(expected)
    assert np.isnan(centroid_distances(points[:60], found)[1:]).all()


def test_a_longer_road_goes_on_straight_and_in_parallel():
    network = road(300.0, radius=500.0, sections=2)
    longer = extended(network, 50.0, 400.0)
    first, last = longer.lanes[0], longer.lanes[-1]
    assert np.array_equal(first.points[1:], network.lanes[0].points)
    assert np.hypot(*(first.points[1] - first.points[0])) == pytest.approx(50.0)
    assert last.length == pytest.approx(network.lanes[-1].length + 400.0)
    ends = [lane.points[-1] - lane.points[-2] for lane in longer.lanes[3:]]
    assert np.allclose(ends, ends[0])
    assert longer.lanes[0].points[-1] == pytest.approx(longer.lanes[3].points[0])
