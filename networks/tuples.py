"""The (map, regime) tuples that training runs on, as a table.

Every traffic regime is used on as many maps as the paper has tuples of it: 22 jammed, 22 dense, 22 moderate
and 11 free. The 11 are those maps that offer the most start-goal pairs at the free regime's path lengths
of 106-274 m (pools leave out what is too tightly curved for 31.6 m/s), so that its fast traffic gets the
longest, widest and straightest roads; equals go by name.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from phase_sumo.bridge.convert import build_bundle
from phase_sumo.bridge.network import read_network
from phase_sumo.config import REGIMES, Regime
from phase_sumo.sim.bundle import MapBundle

FILE = "tuples.csv"
Row = tuple[str, str]  # map, regime


def tuples(pairs: Mapping[str, Mapping[str, int]], regimes: tuple[Regime, ...] = REGIMES) -> list[Row]:
    """(map, regime) rows, regime by regime in the config's order, the maps of each by name.

    Args:
        pairs: number of start-goal pairs by map and regime.
        regimes: with the number of tuples of each.
    """
    rows: list[Row] = []
    for regime in regimes:
        ranked = sorted(pairs, key=lambda name: (-pairs[name][regime.name], name))
        chosen = [name for name in ranked[: regime.tuples] if pairs[name][regime.name]]
        rows += [(name, regime.name) for name in sorted(chosen)]
    return rows


def count_pairs(bundle: MapBundle, regimes: tuple[Regime, ...] = REGIMES) -> dict[str, int]:
    """Number of start-goal pairs by regime."""
    return {regime.name: len(pool.start) for regime, pool in zip(regimes, bundle.pools, strict=True)}


def write_tuples(folder: Path) -> Path:
    """Write ``folder/tuples.csv`` for the training networks in ``folder``."""
    bundles = [build_bundle(read_network(path)) for path in sorted(folder.glob("*.net.xml"))]
    rows = tuples({bundle.name: count_pairs(bundle) for bundle in bundles})
    path = folder / FILE
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("map", "regime"))
        writer.writerows(rows)
    return path
