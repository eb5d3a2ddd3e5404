"""Polygons of articulated vehicles: where the table has tractor and trailer, and gone with the vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.outputs.trailers import Trailers, outlines_of
from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.bridge.sumo.session import Session
from tests.helpers.places import NETWORKS

NETWORK = NETWORKS / "f01_straight3.net.xml"
CAR, SEMI = shape_from_type("passenger", 5.0, 1.8), shape_from_type("trailer", 22.0, 2.6)


@pytest.fixture
def table():
    table = VehicleTable(4)
    for name, shape in (("car", CAR), ("semi", SEMI)):
        row = table.add(name, shape)
        table.controlled[row] = True
        table["x"][row], table["y"][row], table["yaw"][row] = 100.0, 50.0, 0.5 * np.pi
    table["hitch"][table.row_of["semi"]] = 0.3
    return table


def test_outlines_bend_at_the_hitch(table):
    (tractor, trailer), *_ = outlines_of(table, np.array([table.row_of["semi"]]))
    front = SEMI.length - SEMI.rear_overhang
    np.testing.assert_allclose(tractor[:2].mean(0), (100.0, 50.0 + front), atol=1e-4)
    np.testing.assert_allclose(np.ptp(tractor, axis=0), (SEMI.width, SEMI.length), atol=1e-4)
    # the trailer turns about the hitch by the hitch angle, its tail to the right of a tractor heading north
    axis = trailer[:2].mean(0) - trailer[2:].mean(0)
    assert np.hypot(*axis) == pytest.approx(SEMI.trailer_length, abs=1e-4)
    assert np.arctan2(axis[1], axis[0]) == pytest.approx(0.5 * np.pi - 0.3, abs=1e-5)
    hitch = trailer[:2].mean(0) - SEMI.trailer_setback * axis / np.hypot(*axis)
    np.testing.assert_allclose(hitch, (100.0, 50.0), atol=1e-4)


def test_polygons_follow_and_vanish(table, tmp_path):
    with Session(["-n", str(NETWORK), "--no-step-log", "true"], tmp_path) as session:
        polygon = session.api.polygon
        trailers = Trailers(session.api, table)
        trailers.update()
        assert set(polygon.getIDList()) == {"phase.semi.tractor", "phase.semi.trailer"}
        table["x"][table.row_of["semi"]] += 30.0
        trailers.update()
        (outlines,) = outlines_of(table, np.array([table.row_of["semi"]]))
        for part, outline in zip(("tractor", "trailer"), outlines, strict=True):
            shape = np.array(polygon.getShape(f"phase.semi.{part}"))
            np.testing.assert_allclose(shape[:4], outline, atol=1e-9)
        table.controlled[table.row_of["semi"]] = False  # handed back
        trailers.update()
        assert polygon.getIDList() == ()
