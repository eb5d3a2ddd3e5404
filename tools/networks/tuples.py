"""The (map, regime) tuples that training runs on, as a table.

Every traffic regime is used on as many maps as the paper has tuples of it: 22 jammed, 22 dense, 22 moderate
and 11 free, see `phase_sumo.sim.tuples`.
"""

from __future__ import annotations

import csv
from pathlib import Path

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import REGIMES
from phase_sumo.sim.tuples import map_regime_tuples

FILE = "tuples.csv"


def write_tuples(folder: Path) -> Path:
    """Write ``folder/tuples.csv`` for the training networks in ``folder``."""
    bundles = [build_bundle(read_network(path)) for path in sorted(folder.glob("*.net.xml"))]
    path = folder / FILE
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("map", "regime"))
        writer.writerows((bundles[m].name, REGIMES[r].name) for m, r in map_regime_tuples(bundles))
    return path
