"""Which maps carry which traffic regime (paper: the 77 (map, pool) tuples of Table scenario_stats)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from phase_sumo.config import REGIMES, Regime
from phase_sumo.sim.bundle import MapBundle


def map_regime_tuples(
    maps: Sequence[MapBundle], regimes: Sequence[Regime] = REGIMES
) -> list[tuple[int, int]]:
    """(map, regime) index pairs, regime by regime, maps in their order.

    A regime takes its share of the maps, `Regime.tuples` relative to the regime that has most: with the
    paper's 22, 22, 22 and 11, every map is used jammed, dense and moderate, and half of them free. Those are
    the maps with the most start-goal pairs of the regime, equals by name; maps without any are left out.
    """
    most = max(regime.tuples for regime in regimes)
    rows = []
    for r, regime in enumerate(regimes):
        counts = [len(bundle.pools[r].start) for bundle in maps]
        ranked = sorted(range(len(maps)), key=lambda m: (-counts[m], maps[m].name))
        chosen = ranked[: math.ceil(len(maps) * regime.tuples / most)]
        rows += [(m, r) for m in sorted(chosen) if counts[m]]
    return rows
