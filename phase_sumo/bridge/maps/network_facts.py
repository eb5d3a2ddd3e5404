"""What a network holds beside the roads that PHASE drives: counted for the check before a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.maps.net_xml import open_xml

# right of way at a connection, by SUMO's letter; a traffic light's are told by its id
SIGNS = {"m": "give way", "s": "stop", "w": "all-way stop", "=": "right before left", "Z": "zipper"}


@dataclass(frozen=True)
class Crossing:
    """A connection between two edges and who may go there first.

    Attributes:
        source, target: edges.
        light: id of the traffic light, or "".
        state: SUMO's letter of the right of way.
    """

    source: str
    target: str
    light: str
    state: str


@dataclass(frozen=True)
class NetworkFacts:
    """Edges outside junctions and their connections.

    Attributes:
        kinds: edge -> its type as SUMO names it, or "".
        lane_metres: edge -> m of lane.
        crossings: where somebody may have to wait.
    """

    kinds: dict[str, str] = field(default_factory=dict)
    lane_metres: dict[str, float] = field(default_factory=dict)
    crossings: list[Crossing] = field(default_factory=list)

    def lights(self, edges: frozenset[str]) -> list[str]:
        """Traffic lights between two of the edges."""
        return sorted({c.light for c in self._between(edges) if c.light})

    def signs(self, edges: frozenset[str]) -> Counter[str]:
        """Pairs of those edges by the sign that stands between them."""
        pairs = {(c.source, c.target, c.state) for c in self._between(edges) if not c.light}
        return Counter(SIGNS[state] for _, _, state in pairs if state in SIGNS)

    def _between(self, edges: frozenset[str]) -> Iterator[Crossing]:
        return (c for c in self.crossings if c.source in edges and c.target in edges)


def network_facts(path: Path) -> NetworkFacts:
    """Read a ``.net.xml`` or ``.net.xml.gz``; the last one is remembered while the file stays as it is."""
    stat = path.stat()
    return _read(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=1)
def _read(path: Path, *_: int) -> NetworkFacts:
    facts = NetworkFacts()
    with open_xml(path, "pass a SUMO .net.xml or .net.xml.gz", "write it again with netconvert") as file:
        for _, element in etree.iterparse(file, tag=("edge", "connection"), huge_tree=True):
            if element.tag == "edge" and element.get("function") in (None, "normal"):
                name = element.get("id", "")
                facts.kinds[name] = element.get("type", "")
                facts.lane_metres[name] = sum(float(e.get("length", 0)) for e in element.iterchildren("lane"))
            elif element.tag == "connection" and (element.get("tl") or element.get("state") in SIGNS):
                get = element.get
                facts.crossings.append(
                    Crossing(get("from", ""), get("to", ""), get("tl", ""), get("state", ""))
                )
            element.clear()
    return facts
