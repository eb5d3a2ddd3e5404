"""Improved IDM and MOBIL against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.fleet.lane_choice import (
    ACCELERATION,
    BRAKING,
    POLITENESS,
    SAFE_BRAKING,
    STANDSTILL,
    TIME_GAP,
    acceleration,
    felt,
    gain,
    safe,
)


def one(speed, target, gap=np.inf, ahead=0.0):
    return float(acceleration(*(np.array([v], float) for v in (speed, target, gap, ahead)))[0])


def test_on_a_free_road_it_is_the_idm():
    assert one(0.0, 30.0) == pytest.approx(ACCELERATION)
    assert one(15.0, 30.0) == pytest.approx(ACCELERATION * 15.0 / 16.0)
    assert one(30.0, 30.0) == pytest.approx(0.0)
    assert -BRAKING < one(36.0, 30.0) < 0.0


@pytest.mark.parametrize("speed", [5.0, 20.0, 30.0])
def test_at_the_desired_gap_behind_an_equal_it_neither_gains_nor_loses_ground(speed):
    wanted = STANDSTILL + TIME_GAP * speed
    assert one(speed, 30.0, wanted, speed) == pytest.approx(0.0, abs=1e-9)
    assert one(speed, 30.0, 0.5 * wanted, speed) == pytest.approx(-3.0 * ACCELERATION)  # a (1 - 2^2)
    assert one(speed, 30.0, 2.0 * wanted, speed) >= 0.0


def test_at_the_desired_speed_a_leader_as_fast_is_no_hindrance():
    assert one(30.0, 30.0, 50.0, 30.0) == pytest.approx(0.0, abs=1e-9)


def test_approaching_a_standing_vehicle_takes_the_braking_of_kinematics():
    """Far out, where s* is v dv / (2 sqrt(a b)), stopping over s costs (v^2 / 2 s)^2 / b."""
    speed, gap = 40.0, 2.0
    kinematic = speed**2 / (2.0 * gap)
    assert one(speed, 40.0, gap, 0.0) == pytest.approx(-(kinematic**2) / BRAKING, rel=0.2)


def test_a_change_counts_the_followers_less_than_oneself():
    assert gain(np.array([1.0]), np.array([-1.0]), np.array([0.5])) == pytest.approx(1.0 - 0.5 * POLITENESS)
    assert felt(np.array([-9.0, 0.5])).tolist() == [-BRAKING, 0.5]


def test_nobody_may_have_to_brake_hard():
    hard, soft = np.array([-SAFE_BRAKING - 0.1]), np.array([-SAFE_BRAKING + 0.1])
    assert safe(soft, soft)
    assert not safe(hard, soft)
    assert not safe(soft, hard)
