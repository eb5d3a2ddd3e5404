"""Fuel and CO2 from tables: the look-up by hand, the tables against SUMO's own driving cycle."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
import sumolib

from phase_sumo.bridge.sumo.emission_tables import emission_tables
from phase_sumo.evaluate.measures import EmissionTable, emitted
from tests.helpers.trajectories import make

PLANE = EmissionTable(
    np.arange(0.0, 41.0, 10.0),
    np.arange(-4.0, 5.0, 2.0),
    np.add.outer(np.arange(0.0, 41.0, 10.0), 100.0 * np.arange(-4.0, 5.0, 2.0)),
    np.zeros((5, 5)),
)


def test_between_the_points_of_a_plane():
    speed, accel = np.array([3.0, 25.0, 40.0]), np.array([0.5, -1.0, 4.0])
    np.testing.assert_allclose(PLANE.rate(PLANE.fuel, speed, accel), speed + 100.0 * accel)


def test_outside_the_table_its_border_counts():
    assert PLANE.rate(PLANE.fuel, np.array([99.0]), np.array([-9.0])) == pytest.approx([40.0 - 400.0])


def test_sum_over_vehicles_and_time():
    # 20 mg/s + 100 * 1 m/s^2 over two steps of 1 s
    t = make([(0, 0, 0, 0, 20), (1, 0, 0, 20, 20), (2, 0, 0, 40, 20)], accel=1.0)
    fuel, co2 = emitted(t, {"test": PLANE})
    assert fuel == pytest.approx(2 * 120.0 / 1e6)
    assert co2 == 0.0
    assert np.isnan(emitted(t, {})).all()


def test_tables_are_sumos(tmp_path):
    name = "HBEFA4/PC_petrol_Euro-4"
    table = emission_tables([name, "no/such"])
    assert list(table) == [name]
    rng = np.random.default_rng(0)
    speed, accel = rng.uniform(0, 45, 40), rng.uniform(-6, 3, 40)
    cycle, out = tmp_path / "cycle.csv", tmp_path / "out.csv"
    cycle.write_text("".join(f"{i};{v};{a}\n" for i, (v, a) in enumerate(zip(speed, accel, strict=True))))
    tool = sumolib.checkBinary("emissionsDrivingCycle")
    args = [tool, "--timeline-file", str(cycle), "--emission-class", name, "--output", str(out)]
    subprocess.run(args, check=True, capture_output=True)
    rows = np.array([line.split(";") for line in out.read_text().split()], float)
    rates = table[name].rate(table[name].co2, speed, accel), table[name].rate(table[name].fuel, speed, accel)
    np.testing.assert_allclose(rates[0], rows[:, 5], rtol=5e-3, atol=15.0)
    np.testing.assert_allclose(rates[1], rows[:, 9], rtol=5e-3, atol=5.0)
