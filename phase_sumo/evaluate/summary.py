"""Runs of several models and seeds put together: mean, interval and difference of every measure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from phase_sumo.evaluate.measures import Measure
from phase_sumo.evaluate.statistics import mean_interval, paired_difference, poisson_interval

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
