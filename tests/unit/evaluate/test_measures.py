"""All measures together, and what they say where nobody drives."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.evaluate.measures import CURVES, MEASURES, curves, measures
from phase_sumo.evaluate.surrogate_safety import following
from phase_sumo.evaluate.traffic import edie_cells
from tests.helpers.trajectories import make


def measured(t):
    return measures(t, following(t), edie_cells(t), ("A", 50.0), {})


def test_no_traffic_has_no_rates():
    found = measured(make([]))
    assert (found["vehicle_km"], found["flow"]) == (0.0, 0.0)
    rest = {name: value for name, value in found.items() if name not in ("vehicle_km", "flow")}
    assert np.isnan(list(rest.values())).all()
    assert set(found) <= set(MEASURES)


def test_rates_are_per_vehicle_kilometre():
    # two vehicles, 60 m each; one changes lane once, and both lose a fifth of their time
    rows = [
        (k, v, lane if k < 2 else 0, 30 + 20 * k - 29 * v, 20)
        for v, lane in ((0, 1), (1, 0))
        for k in range(4)
    ]
    found = measured(make(rows, target=25.0))
    assert found["vehicle_km"] == pytest.approx(0.12)
    assert found["lane_changes_per_km"] == pytest.approx(1 / 0.12)
    assert found["delay_per_km"] == pytest.approx(2 * 3 * 0.2 / 0.12)
    assert found["median_gap"] == pytest.approx(24.0)
    assert np.isnan(found["co2_per_km"])  # nobody knows the emission class


def test_every_value_is_counted_inside_or_outside_the_classes():
    t = make([(0, 0, 0, 10, 20), (1, 0, 0, 30, 20), (0, 1, 0, 45, 10), (1, 1, 0, 55, 10)])
    counts = curves(t, following(t))
    assert set(counts) == set(CURVES)
    assert counts["speed"].sum() == 4
    assert counts["ttc"].sum() == 2
    assert counts["ttc"][6] == 1  # 30 m at 10 m/s: 3 s
    assert counts["ttc"][4] == 1  # 20 m: 2 s
