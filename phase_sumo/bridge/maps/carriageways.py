"""Edges strung together to carriageways, the widest first."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from phase_sumo.bridge.maps.line_geometry import arc_length
from phase_sumo.sim.lanes import LaneNetwork


@dataclass(frozen=True)
class Carriageway:
    """Consecutive edges.

    Attributes:
        edges: ids in driving order.
        lengths: mean lane length of each edge in m.
        before, after: edges that lead to the first and come from the last one.
    """

    edges: tuple[str, ...]
    lengths: tuple[float, ...]
    before: tuple[str, ...]
    after: tuple[str, ...]

    @property
    def length(self) -> float:
        return sum(self.lengths)


def carriageways(network: LaneNetwork) -> list[Carriageway]:
    """Every edge in one carriageway; each follows as many lanes as it can and is as long as it can."""
    metres: dict[str, list[float]] = {}
    for lane in network.lanes:
        if not lane.connector:
            metres.setdefault(lane.edge, []).append(float(arc_length(lane.points)[-1]))
    after, before = _neighbours(network)
    order = sorted(metres, key=lambda e: (-len(metres[e]), -sum(metres[e]), e))
    taken: set[str] = set()
    result = []
    for edge in order:
        if edge in taken:
            continue
        chain = [edge]
        taken.add(edge)
        for onward, at in ((after, len(chain)), (before, 0)):
            while True:
                end = chain[-1] if at else chain[0]
                free = [
                    (lanes, len(metres[e]), e) for e, lanes in onward.get(end, {}).items() if e not in taken
                ]
                if not free:
                    break
                best = max(free)[2]
                taken.add(best)
                chain.insert(len(chain) if at else 0, best)
        result.append(
            Carriageway(
                tuple(chain),
                tuple(float(np.mean(metres[e])) for e in chain),
                tuple(before.get(chain[0], {})),
                tuple(after.get(chain[-1], {})),
            )
        )
    return result


def _neighbours(network: LaneNetwork) -> tuple[dict[str, Counter[str]], dict[str, Counter[str]]]:
    """Edges after and before each edge, with the number of lanes that lead there."""
    lanes = network.lanes
    source = {b: a for a, b in network.successors if lanes[b].connector}
    after: dict[str, Counter[str]] = {}
    before: dict[str, Counter[str]] = {}
    for a, b in network.successors:
        if lanes[b].connector:
            continue
        one, two = lanes[source.get(a, a)].edge, lanes[b].edge
        after.setdefault(one, Counter())[two] += 1
        before.setdefault(two, Counter())[one] += 1
    return after, before
