"""Flow, density and speed of cells whose vehicles are spaced by hand."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.evaluate.traffic import edie_cells
from tests.trajectories import make


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
