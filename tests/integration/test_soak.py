"""A short soak; `make soak` runs the hour."""

from __future__ import annotations

import pytest

from tests.soak import check, soak


@pytest.mark.slow
def test_five_minutes_with_a_hundred_vehicles():
    rows = soak(vehicles=100, seconds=300.0)
    check(rows)
    assert rows[0]["phase_vehicles"] == rows[0]["vehicles"] > 400
    assert rows[0]["running_at_the_end"] > 60
