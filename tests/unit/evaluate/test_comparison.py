"""Resampling windows, and the floor."""

import numpy as np
import pytest

from phase_sumo.evaluate.realism.comparison import Comparison, Traffic, floor, resamples, with_intervals
from phase_sumo.evaluate.realism.quantities import quantities
from phase_sumo.logs.recorded_roads import extended
from tests.helpers.steady_recordings import recording


def traffic(shift=0.0, windows=6, seed=0):
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(windows):
        cars = [(40.0 * k + rng.uniform(0, 9), 0, rng.uniform(15, 25) + shift) for k in range(5)]
        scene = recording(cars, samples=11)
        scenes.append(quantities(scene, extended(scene.network, 60.0, 400.0)))
    window = np.repeat(np.arange(windows), 5)
    return Traffic(rng.normal(size=(5 * windows, 4)) + shift, window, tuple(scenes))


def test_a_window_of_weight_two_is_two_windows():
    real, simulated = traffic(), traffic(1.0, seed=1)
    twice = np.array([2.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    order = [0, 0, 1, 3, 4, 5]

    def repeated(t):
        rows = [np.flatnonzero(t.window == k) for k in order]
        window = np.repeat(np.arange(6), [len(r) for r in rows])
        return Traffic(t.embedding[np.concatenate(rows)], window, tuple(t.scenes[k] for k in order))

    weighted = Comparison(real, simulated).measured(twice, twice)
    plain = Comparison(repeated(real), repeated(simulated)).measured()
    for name in set(weighted) - {"precision", "recall", "w1_lane_change_duration"}:
        assert weighted[name] == pytest.approx(plain[name], rel=1e-9, abs=1e-12), name


def test_windows_of_a_recording_are_drawn_together_where_there_are_enough():
    names = [f"r{k // 3}" for k in range(36)]
    weights, drawn = resamples(names, 0)
    assert drawn == "recording"
    assert (weights.reshape(-1, 12, 3) == weights.reshape(-1, 12, 3)[..., :1]).all()
    weights, drawn = resamples(names[:9], 0)
    assert drawn == "window"
    assert (weights.sum(1) == 9).all()


def test_intervals_hold_the_estimate_and_the_floor_is_below_a_shift():
    real, simulated = traffic(), traffic(3.0, seed=1)
    table, _ = with_intervals(Comparison(real, simulated), resamples([""] * 6, 0)[0])
    bottom = floor(real, 0)
    for name in ("frechet", "energy", "w1_speed"):
        assert table[name]["low"] < table[name]["value"] < table[name]["high"]
        assert bottom[name] < table[name]["value"]
    assert table["w1_speed"]["value"] == pytest.approx(3.0, abs=1.5)
