"""Tractor and trailer in sumo-gui: SUMO draws an articulated vehicle as one straight box."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.vehicles import boxes

PARTS = ("tractor", "trailer")
COLOURS = ((230, 160, 0, 255), (150, 150, 165, 255))
LAYER = 200  # above SUMO's vehicles
CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])  # in half lengths and half widths


class Trailers:
    """Two polygons ``phase.<vehicle>.tractor`` and ``.trailer`` per articulated vehicle under the policy."""

    def __init__(self, api: ModuleType, table: VehicleTable) -> None:
        self._api, self._table = api, table
        self._drawn: set[str] = set()

    def update(self) -> None:
        """After every step: draw who is there, take away who left."""
        table, polygon = self._table, self._api.polygon
        rows = np.flatnonzero(table.controlled & (table["trailer_length"] > 0))
        present = {table.ids[row] for row in rows.tolist()}
        for vehicle in self._drawn - present:
            for part in PARTS:
                polygon.remove(_name(vehicle, part))
        for row, outlines in zip(rows.tolist(), outlines_of(table, rows).tolist(), strict=True):
            vehicle = table.ids[row]
            for part, outline, colour in zip(PARTS, outlines, COLOURS, strict=True):
                if vehicle in self._drawn:
                    polygon.setShape(_name(vehicle, part), outline)
                else:
                    polygon.add(_name(vehicle, part), outline, colour, True, "phase", LAYER)
        self._drawn = present


def outlines_of(table: VehicleTable, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """[n, 2, 4, 2] corners in SUMO's m of the tractors and trailers of some rows."""
    box = boxes(table.shape(), table.state())[:, :, 0, torch.from_numpy(rows)].double().numpy()
    x, y, cos, sin, half_length, half_width = box.transpose(0, 2, 1)[..., None]
    ahead, left = half_length * CORNERS[:, 0], half_width * CORNERS[:, 1]
    corners = np.stack((x + cos * ahead - sin * left, y + sin * ahead + cos * left), -1)
    return corners + table.origin


def _name(vehicle: str, part: str) -> str:
    return f"phase.{vehicle}.{part}"
