from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.sumo.conventions import (
    angle_from_yaw,
    front_from_reference,
    reference_from_front,
    shape_from_type,
    shapes,
    vehicle_kind,
    yaw_from_angle,
)


@pytest.mark.parametrize(
    ("angle", "yaw"), [(0.0, np.pi / 2), (90.0, 0.0), (180.0, -np.pi / 2), (270.0, np.pi), (45.0, np.pi / 4)]
)
def test_compass_points(angle, yaw):
    assert yaw_from_angle(angle) == pytest.approx(yaw)
    assert angle_from_yaw(yaw) == pytest.approx(angle)


def test_angles_round_trip_and_stay_in_range():
    angle = np.linspace(0.0, 359.999, 1001)
    yaw = yaw_from_angle(angle)
    assert ((yaw > -np.pi) & (yaw <= np.pi)).all()
    np.testing.assert_allclose(angle_from_yaw(yaw), angle, atol=1e-9)


def test_front_bumper_lies_ahead_of_the_rear_axle():
    x, y = front_from_reference(10.0, 5.0, np.pi / 2, 3.84)
    assert (float(x), float(y)) == pytest.approx((10.0, 8.84))


def test_positions_round_trip():
    rng = np.random.default_rng(0)
    x, y, yaw, overhang = rng.normal(size=(4, 100))
    back = reference_from_front(*front_from_reference(x, y, yaw, overhang), yaw, overhang)
    np.testing.assert_allclose(back, (x, y), atol=1e-12)


@pytest.mark.parametrize(
    ("vehicle_class", "length", "kind"),
    [
        ("passenger", 4.8, "car"),
        ("truck", 7.1, "rigid_truck"),
        ("truck", 18.0, "articulated_truck"),
        ("trailer", 16.5, "articulated_truck"),
        ("bus", 18.0, "rigid_truck"),
        ("bicycle", 1.6, None),
    ],
)
def test_kinds(vehicle_class, length, kind):
    assert vehicle_kind(vehicle_class, length) == kind


@pytest.mark.parametrize("vehicle_class", ["passenger", "truck", "trailer"])
@pytest.mark.parametrize("length", [4.5, 12.0, 16.5, 22.4])
def test_overall_length_is_sumos_length(vehicle_class, length):
    row = shape_from_type(vehicle_class, length, 2.5)
    if vehicle_class == "trailer" and length < 12.0:
        pytest.skip("no trailer combination is that short")
    assert row.overall_length == pytest.approx(length)


def test_long_combination_has_the_proportions_of_a_wb67():
    row = shape_from_type("trailer", 22.4, 2.59)
    assert 6.0 <= row.length <= 8.0
    assert 15.5 <= row.trailer_length <= 17.0
    assert 12.2 <= row.trailer_base <= 13.9
    assert row.truck


def test_car_has_no_trailer():
    shape = shapes([shape_from_type("passenger", 5.0, 1.8)])
    assert not bool(shape.articulated.any())
    assert float(shape.wheelbase) == pytest.approx(3.0)
    assert float(shape.front_overhang) == pytest.approx(4.0)
