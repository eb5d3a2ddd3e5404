"""Intervals against printed tables and a worked example."""

from __future__ import annotations

import math

import numpy as np
import pytest

from phase_sumo.evaluate.measures import Measure
from phase_sumo.evaluate.statistics import (
    bootstrap_by,
    bootstrap_mean,
    mean_interval,
    paired_difference,
    poisson_interval,
    summarise,
    t_quantile,
)

# two-sided 95 % points, as printed in any table of Student's t
T_TABLE = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 9: 2.262, 10: 2.228, 30: 2.042, 120: 1.980}
# exact 95 % intervals of a Poisson count (Ulm 1990)
POISSON = {0: (0.0, 3.689), 1: (0.0253, 5.572), 5: (1.623, 11.668), 10: (4.795, 18.390), 100: (81.36, 121.63)}


@pytest.mark.parametrize(("freedom", "value"), T_TABLE.items())
def test_students_t(freedom, value):
    assert t_quantile(0.975, freedom) == pytest.approx(value, abs=6e-4)


def test_one_sided_points():
    assert t_quantile(0.95, 4) == pytest.approx(2.132, abs=6e-4)
    assert t_quantile(0.995, 7) == pytest.approx(3.499, abs=6e-4)


@pytest.mark.parametrize(("count", "bounds"), POISSON.items())
def test_garwoods_interval(count, bounds):
    assert poisson_interval(count) == pytest.approx(bounds, rel=2e-3)


def test_mean_with_interval():
    # mean 3, s = sqrt(2.5), half width 2.776 * sqrt(2.5 / 5)
    found = mean_interval([1, 2, 3, 4, 5, math.nan])
    assert (found.mean, found.n) == (3.0, 5)
    assert (
        found.high - 3.0 == pytest.approx(3.0 - found.low) == pytest.approx(2.7764 * math.sqrt(0.5), rel=1e-4)
    )


def test_one_run_has_no_interval():
    found = mean_interval([4.0])
    assert found.mean == 4.0
    assert math.isnan(found.low)
    assert math.isnan(found.high)
    assert mean_interval([]).n == 0


def test_pairing_takes_out_what_seeds_share():
    difference = paired_difference([11.0, 21.0, 31.0], [10.0, 20.0, 30.0])
    assert (difference.mean, difference.low, difference.high) == (1.0, 1.0, 1.0)


def test_summary_pools_rates_and_compares_seed_by_seed():
    table = {
        "speed": Measure("", "", 0, ""),
        "rate": Measure("", "", 0, "", count="collisions", exposure="km"),
        "nobody": Measure("", "", 0, ""),
    }
    rows = [
        {"speed": 20.0, "rate": 10.0, "collisions": 1, "km": 100.0},
        {"speed": 24.0, "rate": None, "collisions": 4, "km": 400.0},
    ]
    other = [{"speed": 19.0, "rate": 0.0}, {"speed": 22.0, "rate": 0.0}]
    summary = summarise(rows, other, table)
    assert summary["speed"]["mean"] == 22.0
    assert summary["speed"]["difference"]["mean"] == 1.5
    assert summary["speed"]["difference"]["n"] == 2
    assert summary["rate"]["mean"] == 10.0  # 5 in 500 km, not the mean of two rates
    assert summary["rate"]["low"] == pytest.approx(1.623 / 0.5, rel=1e-3)
    assert summary["rate"]["difference"]["n"] == 1
    assert summary["nobody"]["n"] == 0
    assert summarise(rows, None, table)["speed"]["difference"] is None


def test_bootstrap_by_draws_whole_groups():
    """Two groups of equal values: a resample is all of one, all of the other, or half of each."""
    estimate = bootstrap_by([0.0, 0.0, 1.0, 1.0, np.nan], ["a", "a", "b", "b", "b"])
    assert (estimate.mean, estimate.low, estimate.high, estimate.n) == (0.5, 0.0, 1.0, 2)


def test_bootstrap_of_many_normal_values_is_the_normal_interval():
    values = np.random.default_rng(3).normal(5.0, 2.0, size=400)
    estimate = bootstrap_mean(values)
    half = 1.96 * values.std() / 20.0
    assert (estimate.mean, estimate.n) == (pytest.approx(values.mean()), 400)
    assert estimate.low == pytest.approx(values.mean() - half, abs=0.05 * half)
    assert estimate.high == pytest.approx(values.mean() + half, abs=0.05 * half)


def test_one_group_has_no_interval():
    estimate = bootstrap_by([1.0, 3.0], ["a", "a"])
    assert estimate.mean == 2.0 and math.isnan(estimate.low) and estimate.n == 1
