"""Which of SUMO's lanes follow a lane, and how far away they are."""

from __future__ import annotations

from typing import Any

HOPS = 6  # lanes, internal ones counted, that a vehicle may pass within one step of SUMO


class LaneWays:
    """Asks SUMO about lanes when they are first met; what is known outlives the simulation.

    Attributes:
        length: m, of the lanes that were asked about.
    """

    def __init__(self, api: Any) -> None:
        self.length: dict[str, float] = {}
        self._lane = api.lane
        self._known: dict[str, dict[str, dict[str, float]]] = {}

    def ahead(self, lane: str) -> dict[str, dict[str, float]]:
        """Edge -> lanes of it that ``lane`` leads to -> m from its start to theirs; its own edge included."""
        if lane not in self._known:
            found, front = {edge_of(lane): {lane: 0.0}}, {lane: 0.0}
            for _ in range(HOPS - 1):
                reached: dict[str, float] = {}
                for other, metres in front.items():
                    for link in self._lane.getLinks(other):
                        if edge_of(link[4] or link[0]) not in found:
                            reached.setdefault(link[4] or link[0], metres + self._lane.getLength(other))
                for other, metres in reached.items():
                    found.setdefault(edge_of(other), {})[other] = metres
                front = reached
            self._known[lane], self.length[lane] = found, float(self._lane.getLength(lane))
        return self._known[lane]

    def towards(self, last: str, lane: str) -> tuple[str, float] | None:
        """The lane that ``last`` leads to nearest beside ``lane``, maybe itself, and m between the starts."""
        reached = self.ahead(last).get(edge_of(lane))
        if reached is None:
            return None
        source = min(reached, key=lambda other: (abs(index_of(other) - index_of(lane)), other))
        return source, reached[source]


def edge_of(lane: str) -> str:
    return lane.rpartition("_")[0]


def index_of(lane: str) -> int:
    return int(lane.rpartition("_")[2])
