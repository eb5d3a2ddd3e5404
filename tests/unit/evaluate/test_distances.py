"""Distances between sets of points against independent packages and closed forms."""

import numpy as np
import pytest

from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.realism import distances
from phase_sumo.evaluate.realism.distances import (
    GAMMAS,
    coverage,
    energy_distance,
    frechet,
    mmd,
    pair_sums,
)


def sets(n=60, m=45, size=5, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, size)), 0.7 * rng.normal(size=(m, size)) @ rng.normal(size=(size, size)) + 0.4


def three(x, y):
    return pair_sums(x, x), pair_sums(y, y), pair_sums(x, y)


def test_frechet_is_the_formula_with_scipys_square_root():
    linalg = pytest.importorskip("scipy.linalg")
    x, y = sets()
    s, t = np.cov(x.T), np.cov(y.T)
    apart = ((x.mean(0) - y.mean(0)) ** 2).sum()
    expected = apart + np.trace(s + t - 2 * linalg.sqrtm(s @ t).real)
    assert frechet(x, y) == pytest.approx(expected, rel=1e-9)


def test_frechet_of_diagonal_gaussians_is_the_closed_form():
    """Points at ± a sqrt(d) on the axes have a diagonal covariance known exactly."""
    axes = np.concatenate((np.eye(3), -np.eye(3)))
    x, y = axes * [1.0, 2.0, 3.0], axes * [2.0, 2.0, 1.0] + [4.0, 0.0, 3.0]
    share = 2 / 5  # two points of six off the centre on each axis, n - 1 = 5
    assert frechet(x, y) == pytest.approx(25.0 + share * (1.0 + 0.0 + 4.0))


def test_frechet_of_fewer_points_than_dimensions():
    """Points on one line, moved: only the means are apart."""
    x = np.outer([0.0, 1.0, 3.0], np.ones(40))
    assert frechet(x, x) == pytest.approx(0.0, abs=1e-9)
    assert frechet(x, x + 0.5) == pytest.approx(10.0)


def test_a_point_of_weight_two_is_two_points():
    x, y = sets(12, 9)
    twice = np.r_[np.full(4, 2), np.ones(8)]
    doubled = np.concatenate((x[:4], x))
    assert frechet(x, y, twice) == pytest.approx(frechet(doubled, y))
    group = np.repeat([0, 1], [4, 8])
    xx, xy = pair_sums(x, x, group, group), pair_sums(x, y, group)
    resampled = xx.weighted([2, 1], [2, 1]), pair_sums(y, y), xy.weighted([2, 1], [1])
    assert energy_distance(*resampled) == pytest.approx(energy_distance(*three(doubled, y)))
    assert mmd(*resampled) == pytest.approx(mmd(*three(doubled, y)))


@pytest.mark.slow  # dcor compiles itself when it is first imported
def test_energy_distance_is_dcors_without_a_root():
    dcor = pytest.importorskip("dcor")
    x, y = sets()
    assert energy_distance(*three(x, y)) == pytest.approx(float(dcor.energy_distance(x, y)), rel=1e-9)


def test_energy_distance_by_plain_loops():
    x, y = sets(7, 5)

    def mean(a, b):
        return np.mean([np.linalg.norm(p - q) for p in a for q in b])

    expected = 2 * mean(x, y) - mean(x, x) - mean(y, y)
    assert energy_distance(*three(x, y)) == pytest.approx(expected)


def test_mmd_by_plain_loops():
    x, y = sets(7, 5)

    def mean(a, b, gamma, distinct):
        pairs = [(i, j) for i in range(len(a)) for j in range(len(b)) if not (distinct and i == j)]
        return np.mean([np.exp(-gamma * ((a[i] - b[j]) ** 2).sum()) for i, j in pairs])

    for unbiased in (False, True):
        expected = [
            mean(x, x, g, unbiased) + mean(y, y, g, unbiased) - 2 * mean(x, y, g, False) for g in GAMMAS
        ]
        assert mmd(*three(x, y), unbiased=unbiased) == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_mmd_of_two_gaussians_is_the_closed_form():
    """E k(X, Y) = (1 + 2 g (s^2 + t^2))^(-D/2) exp(-g |m|^2 / (1 + 2 g (s^2 + t^2)))."""
    rng, size, s, t, shift = np.random.default_rng(3), 4, 10.0, 14.0, 6.0
    x, y = s * rng.normal(size=(3000, size)), t * rng.normal(size=(3000, size)) + shift

    def kernel(variance, apart, gamma):
        wide = 1 + 2 * gamma * variance
        return wide ** (-size / 2) * np.exp(-gamma * apart / wide)

    expected = [
        kernel(2 * s * s, 0, g) + kernel(2 * t * t, 0, g) - 2 * kernel(s * s + t * t, size * shift**2, g)
        for g in GAMMAS
    ]
    assert mmd(*three(x, y), unbiased=True) == pytest.approx(expected, rel=0.12)


@pytest.mark.filterwarnings("ignore")
def test_precision_and_recall_are_prdcs(capsys):
    prdc = pytest.importorskip("prdc")
    x, y = sets(80, 70, 3)
    found = coverage(x, y)
    expected = prdc.compute_prdc(x, y, nearest_k=3)
    assert found.precise.mean() == pytest.approx(expected["precision"])
    assert found.recalled.mean() == pytest.approx(expected["recall"])
    assert 0.0 < found.precise.mean() < 1.0 > found.recalled.mean() > 0.0


def test_blocks_change_nothing(monkeypatch):
    x, y = sets()
    whole = [energy_distance(*three(x, y)), *mmd(*three(x, y)), coverage(x, y).precise.mean()]
    monkeypatch.setattr(distances, "BLOCK", 7)
    parts = [energy_distance(*three(x, y)), *mmd(*three(x, y)), coverage(x, y).precise.mean()]
    assert parts == pytest.approx(whole, rel=1e-9)


def test_a_set_is_at_no_distance_from_itself():
    x, _ = sets()
    assert energy_distance(*three(x, x)) == pytest.approx(0.0, abs=1e-9)
    assert mmd(*three(x, x)) == pytest.approx(np.zeros(5), abs=1e-12)
    assert frechet(x, x) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.full((4, 2), np.nan), np.zeros(5)])
def test_what_is_no_set_of_points_is_refused(bad):
    with pytest.raises(PhaseError, match="finite points"):
        frechet(bad, np.zeros((4, 3)))
