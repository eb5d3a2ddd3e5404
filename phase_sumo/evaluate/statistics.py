"""Confidence intervals over seeds, worlds and for counts, without a statistics package.

Runs of several models and seeds are put together as mean, interval and difference of every measure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from phase_sumo.evaluate.measures import Measure

CONFIDENCE = 0.95
RESAMPLES = 10_000  # of a bootstrap


@dataclass(frozen=True)
class Estimate:
    """A mean over ``n`` runs with its confidence interval; low and high are NaN where there is none."""

    mean: float
    low: float
    high: float
    n: int


def mean_interval(values: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """Student's interval of the mean of independent runs: mean ± t_{n-1} s / sqrt(n).

    Values that are not finite (a run without any such event) are left out; one value has no interval.
    """
    kept = np.asarray(values, np.float64)
    kept = kept[np.isfinite(kept)]
    n = len(kept)
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, 0)
    mean = float(kept.mean())
    if n == 1:
        return Estimate(mean, math.nan, math.nan, 1)
    half = t_quantile(0.5 + 0.5 * confidence, n - 1) * float(kept.std(ddof=1)) / math.sqrt(n)
    return Estimate(mean, mean - half, mean + half, n)


def paired_difference(values: ArrayLike, reference: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """`mean_interval` of value - reference, pair by pair: runs of one seed share demand and driver draws."""
    return mean_interval(np.asarray(values, np.float64) - np.asarray(reference, np.float64), confidence)


def bootstrap_mean(values: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """`bootstrap_by` of independent values, worlds say: each is a group of its own (Efron 1979)."""
    return bootstrap_by(values, np.arange(np.size(values)), confidence)


def t_quantile(p: float, freedom: int) -> float:
    """x with P(T <= x) = p for Student's t with an integer number of degrees of freedom, p > 0.5."""
    high = 2.0
    while 0.5 + 0.5 * _t_within(high, freedom) < p:
        high *= 2.0
    return _root(lambda x: 0.5 + 0.5 * _t_within(x, freedom) - p, 0.0, high)


def _t_within(x: float, freedom: int) -> float:
    """P(\\|T\\| <= x), the finite series of Abramowitz & Stegun 26.7.3 and 26.7.4."""
    angle = math.atan(x / math.sqrt(freedom))
    sin, cos = math.sin(angle), math.cos(angle)
    odd = freedom % 2
    term, total = (cos, cos) if odd else (1.0, 1.0)
    if freedom == 1:
        total = 0.0
    for k in range(2 + odd, freedom - 1, 2):
        term *= cos * cos * (k - 1) / k
        total += term
    return 2.0 / math.pi * (angle + sin * total) if odd else sin * total


def poisson_interval(count: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Exact (Garwood 1936) interval of the mean of a Poisson count.

    P(N >= count; low) = P(N <= count; high) = (1 - confidence) / 2, low = 0 for no event. It takes the
    events as independent; collisions that cause each other make the true interval wider.
    """
    tail = 0.5 * (1.0 - confidence)
    top = count + 10.0 * math.sqrt(count + 1.0) + 10.0
    low = 0.0 if count == 0 else _root(lambda m: 1.0 - _poisson_below(count - 1, m) - tail, 0.0, top)
    return low, _root(lambda m: tail - _poisson_below(count, m), 0.0, top)


def _poisson_below(count: int, mean: float) -> float:
    """P(N <= count) of a Poisson variable."""
    if mean <= 0.0:
        return 1.0
    k = np.arange(count + 1)
    log_factorial = np.concatenate(([0.0], np.cumsum(np.log(np.arange(1, count + 1)))))
    return float(np.exp(k * math.log(mean) - mean - log_factorial).sum())


def _root(rising: Callable[[float], float], low: float, high: float) -> float:
    """Bisection to float precision."""
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (low, middle) if rising(middle) > 0.0 else (middle, high)
    return 0.5 * (low + high)


def bootstrap_by(values: ArrayLike, groups: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """Percentile bootstrap of a mean whose values come in groups, scenarios of recordings say.

    Whole groups are drawn with replacement (cluster bootstrap, Davison & Hinkley 1997, section 3.8), since
    the values of one group are alike. Values that are not finite are left out; one group has no interval.
    ``n`` counts the groups.
    """
    values = np.asarray(values, np.float64)
    known = np.isfinite(values)
    if not known.any():
        return Estimate(math.nan, math.nan, math.nan, 0)
    _, group = np.unique(np.asarray(groups)[known], return_inverse=True)
    total, count = np.bincount(group, values[known]), np.bincount(group)
    n, mean = len(count), float(values[known].mean())
    if n == 1:
        return Estimate(mean, math.nan, math.nan, 1)
    drawn = np.random.default_rng(0).integers(n, size=(RESAMPLES, n))
    means = total[drawn].sum(1) / count[drawn].sum(1)
    low, high = np.quantile(means, [0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence])
    return Estimate(mean, float(low), float(high), n)


Row = Mapping[str, Any]


def summarise(
    rows: Sequence[Row], reference: Sequence[Row] | None, table: Mapping[str, Measure]
) -> dict[str, dict[str, Any]]:
    """Every measure of one model over its seeds.

    Args:
        rows: one per seed, measures by name.
        reference: the rows of the model to compare with, in the same order of seeds.

    Returns:
        by name: mean, low, high, n (95 % interval over seeds; NaN for one seed), ``interval`` ("t" or
        "poisson") and ``difference``, the same of the seed-wise difference to the reference, or None.
    """
    summary = {}
    for name, measure in table.items():
        values = column(rows, name)
        found = _pooled_rate(rows, measure) if measure.count else asdict(mean_interval(values))
        found["interval"] = "poisson" if measure.count else "t"
        found["difference"] = (
            asdict(paired_difference(values, column(reference, name))) if reference is not None else None
        )
        summary[name] = found
    return summary


def column(rows: Sequence[Row], name: str) -> np.ndarray:
    """[R] one measure of every run, NaN where a run does not have it."""
    values = (row.get(name) for row in rows)
    return np.array([math.nan if value is None else float(value) for value in values])


def _pooled_rate(rows: Sequence[Row], measure: Measure) -> dict[str, Any]:
    """All events / 1000 vehicle-km of all seeds, with the exact Poisson interval of the count."""
    count = int(np.nansum(column(rows, measure.count)))
    km = float(np.nansum(column(rows, measure.exposure)))
    if km <= 0.0:
        return {"mean": math.nan, "low": math.nan, "high": math.nan, "n": 0}
    low, high = poisson_interval(count)
    return {"mean": 1e3 * count / km, "low": 1e3 * low / km, "high": 1e3 * high / km, "n": len(rows)}
