"""Emission tables of SUMO's own model, one per emission class.

All driver models are rated offline from recorded speed and acceleration by what SUMO's ``emissionsMap`` says
about each class, whether or not the run carried SUMO's emission devices.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import sumolib

from phase_sumo.evaluate.measures import EmissionTable

SPEED = (0.0, 50.0, 0.5)  # m/s: from, to, step
ACCEL = (-10.0, 6.0, 0.1)  # m/s^2


def emission_tables(classes: Iterable[str]) -> dict[str, EmissionTable]:
    """Tables by emission class; one that SUMO cannot rate (it needs more than speed) is left out."""
    tables = {name: _table(name) for name in set(classes)}
    return {name: table for name, table in tables.items() if table is not None}


@cache
def _table(name: str) -> EmissionTable | None:
    args = [sumolib.checkBinary("emissionsMap"), "--emission-class", name]
    for letter, bounds in (("v", SPEED), ("a", ACCEL), ("s", (0.0, 0.0, 1.0))):
        for word, value in zip(("min", "max", "step"), bounds, strict=True):
            args += [f"--{letter}-{word}", f"{value:g}"]
    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as folder:
        path = Path(folder) / "map.csv"
        subprocess.run([*args, "--output", str(path)], capture_output=True, check=False)
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    speed, accel = (a + step * np.arange(0.0, round((b - a) / step) + 1) for a, b, step in (SPEED, ACCEL))
    rates: dict[str, list[float]] = {"fuel": [], "CO2": []}
    for line in lines:
        *_, kind, value = line.split(";")
        if kind in rates:
            rates[kind].append(float(value))
    if any(len(values) != len(speed) * len(accel) for values in rates.values()):
        return None
    fuel, co2 = (np.array(rates[kind]).reshape(len(speed), len(accel)) for kind in ("fuel", "CO2"))
    return EmissionTable(speed, accel, fuel, co2)
