"""SUMO network -> `LaneNetwork`: which lanes count, how they follow each other, what lies abreast."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from shapely.geometry import LineString

from phase_sumo.bridge.maps.alignment import Connector, align
from phase_sumo.bridge.maps.freeway import freeway_edges, road_class
from phase_sumo.bridge.maps.line_geometry import arc_length, heading, without_spikes, wrap
from phase_sumo.bridge.maps.net_xml import DEFAULT_WIDTH, XmlLane, XmlNet, allows, network_name, parse_net
from phase_sumo.errors import PhaseError
from phase_sumo.sim.lanes import Lane, LaneNetwork, away

NARROWEST = 2.0  # m: no car fits on a lane narrower than this
WIDEST = 20.0  # m
TURNAROUND = 2.2, 20.0  # rad within m: a connection that turns back, which no vehicle of ours drives
WIDEST_GAP = 500.0  # m: no junction is that large
ODD_LENGTH = 0.2, 10.0  # share and m: lanes of one edge have one length, also where they turn
ODD = "lanes have another length than their shape"
NAMED = 5  # lanes in one warning
LONGEST_CHAIN = 16  # internal lanes of one connection

Lanes = dict[str, XmlLane]
Lines = dict[str, np.ndarray]


def read_network(
    path: str | Path, keep: Literal["freeway", "all"] = "freeway", classes: Collection[str] = ()
) -> LaneNetwork:
    """Read a ``.net.xml`` or ``.net.xml.gz``.

    Args:
        path: the network file.
        keep: ``"freeway"`` keeps motorways and trunk roads with their ramps, see `freeway_edges`;
            ``"all"`` keeps every lane that cars or trucks may use.
        classes: further vehicle classes; lanes for these beside the others are kept, too, and those that are
            closed for the time being.

    Raises:
        PhaseError: the file is missing, damaged or holds no lane to keep.
    """
    path = Path(path)
    net = parse_net(path)
    drivable = _drivable(net, classes)
    narrow = sum(lane.width < NARROWEST for lane in drivable.values())
    warnings = [f"{narrow} lanes narrower than {NARROWEST:g} m left out"] if narrow else []
    drivable = {k: v for k, v in drivable.items() if v.width >= NARROWEST}
    kept = drivable
    if keep == "freeway":
        chosen, assumed = freeway_edges(drivable, net)
        if not chosen:
            raise PhaseError(
                f"{path}: no freeway found (road class motorway or trunk, or a speed limit of at least "
                "60 km/h); keep all lanes instead (--keep all)"
            )
        if assumed:
            warnings.append("neither road classes nor speed limits given: roads without turns kept")
        kept = {k: v for k, v in drivable.items() if v.edge in chosen}
        warnings += _left_out(drivable, chosen)
    lines = {k: without_spikes(net.points(v)) for k, v in kept.items()}
    flat = [k for k, line in lines.items() if len(line) < 2]
    if flat:
        warnings.append(f"{len(flat)} lanes without extent left out")
        kept = {k: v for k, v in kept.items() if k not in set(flat)}
        if not kept:
            raise PhaseError(f"{path}: no lane has an extent; write the network again with netconvert")
    network = _assemble(network_name(path), net, kept, drivable, lines, warnings + _odd_lengths(kept, lines))
    x, y = away(np.concatenate([lane.points for lane in network.lanes]))
    return network.moved(-x, -y) if (x, y) != (0.0, 0.0) else network


def odd_lengths(warnings: Sequence[str]) -> list[str]:
    """Those of a network's ``warnings`` that tell of lengths: they concern every run on it."""
    return [text for text in warnings if ODD in text]


def _odd_lengths(kept: Lanes, lines: Lines) -> list[str]:
    """A warning that names the lanes whose length is not that of their shape."""
    drawn = {k: float(arc_length(lines[k])[-1]) for k in kept}
    odd = [k for k, m in drawn.items() if abs(kept[k].length - m) > max(ODD_LENGTH[0] * m, ODD_LENGTH[1])]
    if not odd:
        return []
    odd.sort(key=lambda k: -abs(kept[k].length - drawn[k]))
    named = ", ".join(f"{k} {kept[k].length:.0f} m, drawn {drawn[k]:.0f} m" for k in odd[:NAMED])
    more = f", and {len(odd) - NAMED} more" if len(odd) > NAMED else ""
    return [
        f"{len(odd)} {ODD} ({named}{more}): SUMO's vehicles drive the "
        "length and PHASE's the shape, so travel times there do not compare; correct length or shape"
    ]


def _drivable(net: XmlNet, classes: Collection[str]) -> Lanes:
    """Lanes outside junctions that cars or trucks may use, and those for other classes beside them."""
    drivable = {k: v for k, v in net.lanes.items() if (v.car or v.truck) and not v.internal}
    if classes:
        edges = {lane.edge for lane in drivable.values()}
        more = {k: v for k, v in net.lanes.items() if v.edge in edges and _is_road(v, classes)}
        drivable = {k: v for k, v in net.lanes.items() if k in drivable or k in more}
    if not drivable:
        raise PhaseError(f"{net.path}: no lane allows cars or trucks; check the lanes' allow/disallow")
    for lane in drivable.values():
        if not 0.0 < lane.width <= WIDEST:
            raise PhaseError(
                f"{net.path}: lane {lane.id!r} has width={lane.width:g}, expected 0 to {WIDEST:g} m; "
                f"correct it, or remove it for SUMO's {DEFAULT_WIDTH} m"
            )
    return drivable


def _is_road(lane: XmlLane, classes: Collection[str]) -> bool:
    """Whether a lane is for vehicles of these classes, or closed."""
    closed = not lane.allow and "all" in (lane.disallow or "").split()
    wide = NARROWEST <= lane.width <= WIDEST
    ours = any(allows(lane.allow, lane.disallow, name) for name in classes)
    return wide and (closed or ours)


def _left_out(drivable: Lanes, chosen: set[str]) -> list[str]:
    """A warning that counts the lanes of other roads by road class."""
    classes = Counter(road_class(lane) for lane in drivable.values() if lane.edge not in chosen)
    if not classes:
        return []
    named = ", ".join(f"{name} {count}" for name, count in classes.most_common())
    return [f"{classes.total()} of {len(drivable)} lanes are not freeway, left out ({named})"]


def _assemble(
    name: str, net: XmlNet, kept: Lanes, drivable: Lanes, own: Lines, warnings: list[str]
) -> LaneNetwork:
    ids = sorted(kept, key=lambda k: (kept[k].edge, kept[k].number))
    index = {lane_id: i for i, lane_id in enumerate(ids)}
    lines = [own[k] for k in ids]
    found = _connectors(net, index)
    connectors = [c for c in found if np.hypot(*(lines[c.target][0] - lines[c.source][-1])) < WIDEST_GAP]
    if len(connectors) < len(found):
        warnings.append(f"{len(found) - len(connectors)} connections over {WIDEST_GAP:g} m or more left out")
    forward = [c for c in connectors if not _turns_back(lines[c.source], lines[c.target])]
    if len(forward) < len(connectors):
        warnings.append(f"{len(connectors) - len(forward)} turnarounds left out")
    beside = {(kept[k].edge, kept[k].number): index[k] for k in ids}
    abreast = [(i, beside[edge, at + 1]) for (edge, at), i in beside.items() if (edge, at + 1) in beside]
    lines, connectors, moved = align(lines, forward, abreast)
    if moved:
        warnings.append(f"{moved} connections with a sideways jump replaced by smooth curves")
    if len(connectors) < len(forward):
        warnings.append(f"{len(forward) - len(connectors)} connections across lanes left out")
    lanes = [_lane(kept[k], line, own[k], beside, net) for k, line in zip(ids, lines, strict=True)]
    lanes = _mark_dead_ends(lanes, net, kept, drivable, index)
    return replace(_join(name, lanes, connectors, net.left_hand, tuple(warnings)), geo=net.geo)


def _turns_back(before: np.ndarray, after: np.ndarray) -> bool:
    turn = wrap(heading(after[1] - after[0]) - heading(before[-1] - before[-2]))
    reach = float(np.hypot(*(after[0] - before[-1])))
    return abs(turn) > TURNAROUND[0] and reach < TURNAROUND[1]


def _connectors(net: XmlNet, index: dict[str, int]) -> list[Connector]:
    """One connector per connection between kept lanes, its ``via`` chain concatenated."""
    onward: dict[str, str | None] = {}
    for c in net.connections:
        if net.lanes[c.source].internal:
            onward[c.source] = c.via
    connectors: dict[tuple[str, str], Connector] = {}
    for c in net.connections:
        if c.source not in index or c.target not in index:
            continue
        chain: list[XmlLane] = []
        via = c.via
        while via is not None and len(chain) < LONGEST_CHAIN:
            chain.append(net.lanes[via])
            via = onward.get(via)
        inner = np.concatenate([net.points(part) for part in chain]) if chain else None
        parts = tuple((part.id, part.edge, part.length) for part in chain)
        connectors[c.source, c.target] = Connector(index[c.source], index[c.target], parts, inner)
    return list(connectors.values())


def _lane(
    lane: XmlLane,
    line: np.ndarray,
    own: np.ndarray,
    beside: dict[tuple[str, int], int],
    net: XmlNet,
) -> Lane:
    up, up_solid = _neighbour(beside.get((lane.edge, lane.number + 1)), lane.change_up)
    down, down_solid = _neighbour(beside.get((lane.edge, lane.number - 1)), lane.change_down)
    left, right = (
        ((down, down_solid), (up, up_solid)) if net.left_hand else ((up, up_solid), (down, down_solid))
    )
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
        class_limits=tuple(net.class_speeds.get(lane.kind, {}).items()),
        positions=_positions(lane.length, line, own),
        start=lane.start_node,
        end=lane.end_node,
    )


def _positions(length: float, line: np.ndarray, own: np.ndarray) -> np.ndarray | None:
    """SUMO's lane position where ``line`` was smoothed: that of the nearest point of SUMO's own line.

    They grow everywhere, also where a tight curve has one nearest point for many, so that each is one place.
    """
    if np.array_equal(line, own):
        return None
    sumo = LineString(own)
    at = np.asarray(shapely.line_locate_point(sumo, shapely.points(line))) * length / sumo.length
    step = np.diff(arc_length(line)) * length / sumo.length
    grown = np.concatenate(([0.0], np.cumsum(np.maximum(np.diff(at), 0.1 * step))))
    return at[0] + grown * (at[-1] - at[0]) / grown[-1] if at[-1] > at[0] else at[0] + grown


def _neighbour(other: int | None, allowed: bool) -> tuple[int, bool]:
    """Index of the lane next to one (-1 where it may not be entered) and whether the line is solid."""
    if other is None:
        return -1, False
    return (other, False) if allowed else (-1, True)


def _mark_dead_ends(
    lanes: list[Lane],
    net: XmlNet,
    kept: Lanes,
    drivable: Lanes,
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
    starts = np.cumsum([0.0] + [length for _, _, length in c.chain])
    return Lane(
        id=c.chain[0][0] if c.chain else f"{before.id}->{after.id}",
        edge=c.chain[0][1] if c.chain else f"{before.edge}->{after.edge}",
        points=c.line,
        width=min(before.width, after.width),
        speed_limit=min(before.speed_limit, after.speed_limit),
        length=float(starts[-1]) if c.chain else float(arc_length(c.line)[-1]),
        allows_car=before.allows_car and after.allows_car,
        allows_truck=before.allows_truck and after.allows_truck,
        connector=True,
        parts=tuple((part, float(s)) for (part, _, _), s in zip(c.chain, starts, strict=False)),
        start=before.end,
        end=after.start,
    )
