"""Kinds of vehicles and how an articulated truck divides into tractor and trailer."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.sim.dimensions import MEAN_LENGTH, MEAN_TRAILER, TRACTOR, TRAILER, mean_shape, split


@pytest.mark.parametrize("overall", [12.5, 14.0, 16.5, 18.75, 22.0, 25.25])
def test_tractor_and_trailer_measure_what_the_whole_does(overall: float):
    tractor, trailer = split(overall)
    assert TRACTOR[0] <= tractor <= TRACTOR[1]
    assert 0.9 * tractor + trailer - 0.9 == pytest.approx(overall)
    row = shape_from_type("trailer", overall, 2.55)  # SUMO's box is divided the same way
    assert (row.length, row.trailer_length) == pytest.approx((float(tractor), float(trailer)))
    assert row.overall_length == pytest.approx(overall)


def test_no_trailer_of_a_usual_length_is_out_of_training_s_range():
    tractor, trailer = split(np.linspace(16.5, 22.5, 50))
    assert TRAILER[0] - 0.01 <= trailer.min() and trailer.max() <= TRAILER[1] + 0.01
    assert TRACTOR[0] <= tractor.min() and tractor.max() <= TRACTOR[1]


def test_the_mean_truck_is_divided_into_the_mean_tractor_and_trailer():
    mean = mean_shape("articulated_truck")
    overall = 0.9 * mean["length"] + mean["trailer_length"] - mean["trailer_setback"]
    assert [float(part) for part in split(overall)] == pytest.approx(
        [MEAN_LENGTH["articulated_truck"], MEAN_TRAILER]
    )
    assert mean_shape("car")["trailer_length"] == 0.0 and mean_shape("rigid_truck")["truck"]
