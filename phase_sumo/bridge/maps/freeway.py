"""Which edges of a network are freeway: motorways, trunk roads and their ramps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from phase_sumo.bridge.maps.net_xml import XmlLane, XmlNet

FREEWAY_SPEED = 16.7  # m/s: an edge without a road class counts as freeway from here on
RAMP_SPEED = 11.0  # m/s: and, joined to such an edge, as its ramp from here on
UNMARKED_SPEED = 13.8  # m/s: SUMO's default is 13.89, which OpenDRIVE imports have where no speed was given
FREEWAY_CLASSES = ("motorway", "trunk")
TURNS = ("l", "r")  # SUMO's directions of a connection that leads into another road


def road_class(lane: XmlLane) -> str:
    """``"residential"`` of the edge type ``"highway.residential"``; also the last one of combined types."""
    return kind_of_road(lane.kind)


def kind_of_road(edge_type: str) -> str:
    """The same of an edge's type alone."""
    if "highway." not in edge_type:
        return edge_type or "no road class"
    return edge_type.rpartition("highway.")[2].partition("|")[0]


def freeway_edges(lanes: dict[str, XmlLane], net: XmlNet) -> tuple[set[str], bool]:
    """Edges of motorways, trunk roads and their ramps.

    By road class where edges have one (``highway.motorway_link`` ...), else by speed limit; ramps are then
    the one-way roads that join. A network that gives neither keeps the roads from which nothing turns off.

    Args:
        lanes: the drivable ones.
        net: what they are part of.

    Returns:
        ids of edges, and whether they were chosen without any road class or speed limit.
    """
    classed = {lane.edge for lane in lanes.values() if "highway." in lane.kind}
    kept = {
        lane.edge
        for lane in lanes.values()
        if any(name in lane.kind for name in FREEWAY_CLASSES)
        or (lane.edge not in classed and lane.speed >= FREEWAY_SPEED)
    }
    if not kept and not classed:
        return _without_turns(lanes, net), True
    ramps = {v.edge for v in lanes.values() if v.edge not in classed and v.speed >= RAMP_SPEED}
    return kept | _joined(kept, ramps & _one_way(lanes.values()), lanes, net), False


def _joined(kept: set[str], ramps: set[str], lanes: dict[str, XmlLane], net: XmlNet) -> set[str]:
    """Those of ``ramps`` that lead to or come from ``kept``, directly or over other ramps."""
    beside: dict[str, set[str]] = {}
    for c in net.connections:
        if c.source in lanes and c.target in lanes:
            a, b = lanes[c.source].edge, lanes[c.target].edge
            beside.setdefault(a, set()).add(b)
            beside.setdefault(b, set()).add(a)
    found: set[str] = set()
    waiting = deque(kept)
    while waiting:
        new = (beside.get(waiting.popleft(), set()) & ramps) - found - kept
        found |= new
        waiting.extend(new)
    return found


def _one_way(lanes: Iterable[XmlLane]) -> set[str]:
    ends = {lane.edge: (lane.start_node, lane.end_node) for lane in lanes}
    pairs = set(ends.values())
    return {edge for edge, (start, end) in ends.items() if (end, start) not in pairs}


def _without_turns(lanes: dict[str, XmlLane], net: XmlNet) -> set[str]:
    used = [c for c in net.connections if c.source in lanes and c.target in lanes]
    turning = {lanes[name].edge for c in used if c.turn in TURNS for name in (c.source, c.target)}
    fast = {lane.edge for lane in lanes.values() if lane.speed >= UNMARKED_SPEED}
    return fast - turning
