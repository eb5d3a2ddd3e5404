"""What a network contains, found in the ``.net.xml`` itself and not in the specs it was made from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import sumolib
from sumolib.net.edge import Edge

STRAIGHT, CURVED = 0.02, 0.25  # rad that a road turns by at most, or at least
LOOP = 2.0  # rad that a loop ramp turns by at least
OPPOSITE = 2.8  # rad between the directions of two carriageways


def features(path: Path) -> set[str]:
    """Names of all features found."""
    root = ElementTree.parse(path).getroot()
    net = sumolib.net.readNet(str(path))
    edges = [edge for edge in net.getEdges() if not edge.isSpecial()]
    main = [edge for edge in edges if not is_ramp(edge)]
    ramps = [edge for edge in edges if is_ramp(edge)]
    found = {f"{edge.getLaneNumber()} lanes" for edge in main}
    found |= {name for edge in main for name in _shape(edge)}
    found |= {name for edge in ramps for name in _ramp(edge)}
    found |= {name for edge in main for name in _mainline(edge)}
    if root.get("lefthand") in ("1", "true"):
        found.add("left-hand traffic")
    if any(node.get("type") == "zipper" for node in root.iter("junction")):
        found.add("zipper")
    if any(lane.get("changeRight") is not None for lane in root.iter("lane")):
        found.add("solid line")
    if any(abs(_wrap(_heading(edge) - _heading(main[0]))) > OPPOSITE for edge in main):
        found.add("two carriageways")
    return found


def is_ramp(edge: Edge) -> bool:
    return "_link" in edge.getType()


def _shape(edge: Edge) -> Iterator[str]:
    turns = _turns(edge)
    if abs(turns.sum()) < STRAIGHT and np.abs(turns).sum() < STRAIGHT:
        yield "straight"
    if abs(turns).sum() > CURVED:
        yield "S-curve" if min(turns.max(), -turns.min()) > STRAIGHT else "curve"


def _ramp(edge: Edge) -> Iterator[str]:
    joins = any(not is_ramp(other) for other in edge.getOutgoing())
    leaves = any(not is_ramp(other) for other in edge.getIncoming())
    kind = "on-ramp" if joins else "off-ramp" if leaves else ""
    if kind and edge.getLaneNumber() == 2:
        yield f"two-lane {kind}"
    if kind:
        yield kind
    if abs(_turns(edge).sum()) > LOOP:
        yield "loop ramp"
    before, after = edge.getIncoming(), edge.getOutgoing()
    if len(before) > 1 and len(after) > 1 and all(map(is_ramp, [*before, *after])):
        yield "collector-distributor road"


def _mainline(edge: Edge) -> Iterator[str]:
    goes_on = any(not is_ramp(after) for after in edge.getOutgoing())
    for i, lane in enumerate(edge.getLanes()):
        sources = [source.getEdge() for source in lane.getIncoming()]
        targets = [connection.getTo() for connection in lane.getOutgoing()]
        from_ramp, to_ramp = any(map(is_ramp, sources)), any(map(is_ramp, targets))
        if from_ramp and to_ramp:
            yield "weaving lane"
        if goes_on and not targets:
            yield "acceleration lane" if from_ramp else "lane drop"
        if edge.getIncoming() and not sources:
            yield "deceleration lane" if to_ramp else "lane addition"
        if to_ramp and len(targets) > 1:
            yield "option lane"
        if to_ramp and i == edge.getLaneNumber() - 1:
            yield "left exit"
        if lane.allows("passenger") and not lane.allows("trailer"):
            yield "lane without trucks"


def _turns(edge: Edge) -> np.ndarray:
    """Turn in rad from each piece of the middle line to the next."""
    steps = np.diff(np.array(edge.getShape())[:, :2], axis=0)
    steps = steps[np.hypot(*steps.T) > 0.5]
    return _wrap(np.diff(np.arctan2(steps[:, 1], steps[:, 0])))


def _heading(edge: Edge) -> float:
    points = np.array(edge.getShape())
    x, y = points[-1, :2] - points[0, :2]
    return float(np.arctan2(y, x))


def _wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi
