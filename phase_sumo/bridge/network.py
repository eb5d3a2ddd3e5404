"""SUMO network -> `LaneNetwork`: which lanes count, how they follow each other, what lies abreast."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from shapely.geometry import LineString

from phase_sumo.bridge.alignment import Connector, align
from phase_sumo.bridge.lines import heading, without_duplicates, wrap
from phase_sumo.bridge.net_xml import XmlLane, XmlNet, network_name, parse_net
from phase_sumo.errors import PhaseError
from phase_sumo.sim.lanes import Lane, LaneNetwork

FREEWAY_SPEED = 16.7  # m/s: an edge without a road class counts as freeway from here on
RAMP_SPEED = 11.0  # m/s: and, joined to such an edge, as its ramp from here on
TURNAROUND = 2.2, 20.0  # rad within m: a connection that turns back, which no vehicle of ours drives
FREEWAY_CLASSES = ("motorway", "trunk")


def read_network(path: str | Path, keep: Literal["freeway", "all"] = "freeway") -> LaneNetwork:
    """Read a ``.net.xml`` or ``.net.xml.gz``.

    Args:
        path: the network file.
        keep: ``"freeway"`` keeps motorways and trunk roads with their ramps: by road class where edges
            have one (``highway.motorway_link`` ...), else by speed limit. ``"all"`` keeps every lane that
            cars or trucks may use.

    Raises:
        PhaseError: the file is missing, damaged or holds no lane to keep.
    """
    path = Path(path)
    net = parse_net(path)
    drivable = {k: v for k, v in net.lanes.items() if (v.car or v.truck) and not v.internal}
    if not drivable:
        raise PhaseError(f"{path}: no lane allows cars or trucks; check the lanes' allow/disallow")
    kept = {k: v for k, v in drivable.items() if without_duplicates(v.points).shape[0] >= 2}
    warnings = []
    if len(kept) < len(drivable):
        warnings.append(f"{len(drivable) - len(kept)} lanes without extent left out")
    if keep == "freeway":
        chosen = freeway_edges(kept, net)
        if not chosen:
            raise PhaseError(
                f"{path}: no freeway found (road class motorway or trunk, or a speed limit of at least "
                f"{FREEWAY_SPEED} m/s); keep all lanes instead"
            )
        dropped = sum(lane.edge not in chosen for lane in kept.values())
        if dropped:
            warnings.append(f"{dropped} of {len(kept)} lanes are not freeway, left out")
        kept = {k: v for k, v in kept.items() if v.edge in chosen}
    return _assemble(network_name(path), net, kept, drivable, warnings)


def freeway_edges(lanes: dict[str, XmlLane], net: XmlNet) -> set[str]:
    """Edges of motorways, trunk roads and their ramps."""
    classed = {lane.edge for lane in lanes.values() if "highway." in lane.kind}
    kept = {
        lane.edge
        for lane in lanes.values()
        if any(name in lane.kind for name in FREEWAY_CLASSES)
        or (lane.edge not in classed and lane.speed >= FREEWAY_SPEED)
    }
    one_way = _one_way_edges(lanes)
    ramps = {v.edge for v in lanes.values() if v.edge not in classed and v.speed >= RAMP_SPEED} & one_way
    links = [
        (lanes[c.source].edge, lanes[c.target].edge)
        for c in net.connections
        if c.source in lanes and c.target in lanes
    ]
    while True:
        joined = {b for a, b in links if a in kept} | {a for a, b in links if b in kept}
        if not (joined & ramps) - kept:
            return kept
        kept |= joined & ramps


def _one_way_edges(lanes: dict[str, XmlLane]) -> set[str]:
    ends = {lane.edge: (lane.start_node, lane.end_node) for lane in lanes.values()}
    pairs = set(ends.values())
    return {edge for edge, (start, end) in ends.items() if (end, start) not in pairs}


def _assemble(
    name: str, net: XmlNet, kept: dict[str, XmlLane], drivable: dict[str, XmlLane], warnings: list[str]
) -> LaneNetwork:
    ids = sorted(kept, key=lambda k: (kept[k].edge, kept[k].index))
    index = {lane_id: i for i, lane_id in enumerate(ids)}
    lines = [without_duplicates(kept[k].points) for k in ids]
    connectors = _connectors(net, index)
    forward = [c for c in connectors if not _turns_back(lines[c.source], lines[c.target])]
    if len(forward) < len(connectors):
        warnings.append(f"{len(connectors) - len(forward)} turnarounds left out")
    connectors = forward
    beside = [(kept[k], f"{kept[k].edge}_{kept[k].index + 1}") for k in ids]
    abreast = [(index[lane.id], index[other]) for lane, other in beside if other in index]
    lines, connectors, moved = align(lines, connectors, abreast)
    if moved:
        warnings.append(f"{moved} connections with a sideways jump replaced by smooth curves")
    lanes = [_lane(kept[k], line, kept, index, net.left_hand) for k, line in zip(ids, lines, strict=True)]
    lanes = _mark_dead_ends(lanes, net, kept, drivable, index)
    return _join(name, lanes, connectors, net.left_hand, tuple(warnings))


def _turns_back(before: np.ndarray, after: np.ndarray) -> bool:
    turn = wrap(heading(after[1] - after[0]) - heading(before[-1] - before[-2]))
    reach = float(np.hypot(*(after[0] - before[-1])))
    return abs(turn) > TURNAROUND[0] and reach < TURNAROUND[1]


def _connectors(net: XmlNet, index: dict[str, int]) -> list[Connector]:
    """One connector per connection between kept lanes, its ``via`` chain concatenated."""
    onward: dict[str, tuple[str, str | None]] = {}
    for c in net.connections:
        if c.source in net.lanes and net.lanes[c.source].internal:
            onward[c.source] = (c.target, c.via)
    connectors = []
    for c in net.connections:
        if c.source not in index or c.target not in index:
            continue
        chain: list[XmlLane] = []
        via = c.via
        while via is not None and via in net.lanes and len(chain) < 8:
            chain.append(net.lanes[via])
            via = onward.get(via, (c.target, None))[1]
        connectors.append(Connector(index[c.source], index[c.target], tuple(chain)))
    return connectors


def _lane(
    lane: XmlLane, line: np.ndarray, kept: dict[str, XmlLane], index: dict[str, int], left_hand: bool
) -> Lane:
    up, up_solid = _neighbour(lane, +1, lane.change_up, kept, index)
    down, down_solid = _neighbour(lane, -1, lane.change_down, kept, index)
    left, right = ((down, down_solid), (up, up_solid)) if left_hand else ((up, up_solid), (down, down_solid))
    return Lane(
        id=lane.id,
        edge=lane.edge,
        points=line,
        width=lane.width,
        speed_limit=lane.speed,
        length=lane.length,
        left=left[0],
        right=right[0],
        solid_left=left[1],
        solid_right=right[1],
        allows_car=lane.car,
        allows_truck=lane.truck,
        positions=_positions(lane, line),
    )


def _positions(lane: XmlLane, line: np.ndarray) -> np.ndarray | None:
    """SUMO's lane position where ``line`` was smoothed: that of the nearest point of SUMO's own line."""
    if np.array_equal(line, without_duplicates(lane.points)):
        return None
    own = LineString(lane.points)
    at = shapely.line_locate_point(own, shapely.points(line)) * lane.length / own.length
    return np.maximum.accumulate(at)


def _neighbour(
    lane: XmlLane, step: int, allowed: bool, kept: dict[str, XmlLane], index: dict[str, int]
) -> tuple[int, bool]:
    """Index of the lane next to ``lane`` (-1 where it may not be entered) and whether the line is solid."""
    suffix = f"_{lane.index + step}"
    other = kept.get(f"{lane.edge}{suffix}")
    if other is None:
        return -1, False
    return (index[other.id], False) if allowed else (-1, True)


def _mark_dead_ends(
    lanes: list[Lane],
    net: XmlNet,
    kept: dict[str, XmlLane],
    drivable: dict[str, XmlLane],
    index: dict[str, int],
) -> list[Lane]:
    """Tell lanes that end or begin within the road from those that leave or enter the network.

    A lane without a successor is a dead end when another lane of its edge goes on; it is an exit when the
    whole edge ends or when it goes on to a road that was left out.
    """
    out = {c.source for c in net.connections if c.target in drivable}
    into = {c.target for c in net.connections if c.source in drivable}
    goes_on = {c.source for c in net.connections if c.source in index and c.target in index}
    comes_from = {c.target for c in net.connections if c.source in index and c.target in index}
    edges_on = {kept[i].edge for i in goes_on}
    edges_from = {kept[i].edge for i in comes_from}
    return [
        replace(
            lane,
            dead_end=lane.id not in out and lane.edge in edges_on,
            dead_start=lane.id not in into and lane.edge in edges_from,
        )
        for lane in lanes
    ]


def _join(
    name: str, lanes: list[Lane], connectors: list[Connector], left_hand: bool, warnings: tuple[str, ...]
) -> LaneNetwork:
    """Append a lane per connector, or link the two lanes directly where their ends coincide."""
    successors: list[tuple[int, int]] = []
    joined: dict[tuple[int, int], int] = {}
    for c in connectors:
        if c.line is None:
            successors.append((c.source, c.target))
            continue
        joined[c.source, c.target] = len(lanes)
        successors += [(c.source, len(lanes)), (len(lanes), c.target)]
        lanes.append(_connector_lane(c, lanes))
    for (a, b), i in joined.items():
        # connectors lie abreast where both their ends do
        left = joined.get((lanes[a].left, lanes[b].left), -1)
        right = joined.get((lanes[a].right, lanes[b].right), -1)
        solid_left, solid_right = lanes[a].solid_left, lanes[a].solid_right
        lanes[i] = replace(lanes[i], left=left, right=right, solid_left=solid_left, solid_right=solid_right)
    return LaneNetwork(name, tuple(lanes), tuple(dict.fromkeys(successors)), left_hand, warnings)


def _connector_lane(c: Connector, lanes: list[Lane]) -> Lane:
    before, after = lanes[c.source], lanes[c.target]
    assert c.line is not None
    geometric = float(np.linalg.norm(np.diff(c.line, axis=0), axis=1).sum())
    starts = np.cumsum([0.0] + [part.length for part in c.chain])
    return Lane(
        id=c.chain[0].id if c.chain else f"{before.id}->{after.id}",
        edge=c.chain[0].edge if c.chain else f"{before.edge}->{after.edge}",
        points=c.line,
        width=min(before.width, after.width),
        speed_limit=min(before.speed_limit, after.speed_limit),
        length=float(starts[-1]) if c.chain else geometric,
        allows_car=before.allows_car and after.allows_car,
        allows_truck=before.allows_truck and after.allows_truck,
        connector=True,
        parts=tuple((part.id, float(s)) for part, s in zip(c.chain, starts, strict=False)),
    )
