"""A long network cut into stretches of about equal driving distance.

Edges are strung together to carriageways, the widest first. A carriageway is cut across all its lanes at
the same share of an edge, away from junctions where it can be. A ramp belongs to the stretch where it
meets a wider carriageway; one between two of them is shared. Every piece of lane lies in one stretch.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from phase_sumo.bridge.maps.line_geometry import arc_length, between
from phase_sumo.sim.lanes import Lane, LaneNetwork


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


LONG = 1.5  # stretches: a carriageway up to this long is not cut
WIDE = 3.0  # stretches: a network larger than this is cut into its carriageways at least
CLEAR = 50.0  # m from junctions that a cut keeps where it can; a taper is 40 m long
SHORTEST = 150.0  # m: shorter pieces are joined to a neighbour
SLACK = 0.15  # stretches by which a cut may move


@dataclass(frozen=True)
class Piece:
    """A part of an edge, as shares of its length, and the section of carriageway that it belongs to."""

    section: int
    start: float
    end: float


def cut(network: LaneNetwork, stretch: float) -> list[LaneNetwork]:
    """Stretches named ``<name>_00``, ``<name>_01`` ..., or the network itself where it is no longer than one.

    Lane ids and SUMO's lane positions stay; lanes are open where they were cut.

    Args:
        network: the whole.
        stretch: driving distance in m that a stretch is to have; 0 does not cut.
    """
    if stretch <= 0:
        return [network]
    roads = carriageways(network)
    corner = np.array([lane.points[[0, -1]] for lane in network.lanes]).reshape(-1, 2)
    size = float(np.hypot(*np.ptp(corner, axis=0)))
    if max(road.length for road in roads) <= LONG * stretch and size <= WIDE * stretch:
        return [network]
    pieces, joined = _sections(roads, stretch)
    return parts(network, _edge_pieces(pieces, joined))


def _sections(roads: list[Carriageway], stretch: float) -> tuple[dict[str, list[Piece]], list[int]]:
    """Cut every carriageway.

    Returns:
        the pieces of every edge in driving order, and for each section the one it is joined to (itself for
        most; -1 for roads too short to be of use that meet no other).
    """
    pieces: dict[str, list[Piece]] = {}
    joined: list[int] = []
    for road in roads:
        before = [e for e in road.before if e in pieces and e not in road.edges]
        after = [e for e in road.after if e in pieces and e not in road.edges]
        at_start = joined[pieces[before[0]][-1].section] if before else -1
        at_end = joined[pieces[after[0]][0].section] if after else -1
        cuts = _cuts(road, stretch, at_start >= 0, at_end >= 0)
        first = len(joined)
        own = list(range(first, first + len(cuts) + 1))
        if at_end >= 0:
            own[-1] = at_end
        if at_start >= 0 and (len(own) > 1 or at_end < 0):
            own[0] = at_start
        if len(own) == 1 and own[0] == first and road.length < SHORTEST:
            own = [-1]
        joined += own
        _share_out(road, cuts, first, pieces)
    if all(section < 0 for section in joined):
        joined = list(range(len(joined)))
    return pieces, joined


def _cuts(road: Carriageway, stretch: float, at_start: bool, at_end: bool) -> list[tuple[int, float]]:
    """Where to cut, as (edge of the road, share of its length).

    Up to half a stretch next to a wider carriageway belongs to that one.
    """
    low, high = 0.5 * stretch * at_start, road.length - 0.5 * stretch * at_end
    if at_start and at_end and high - low < 0.5 * stretch:
        wanted = [0.5 * road.length] if road.length >= 2 * SHORTEST else []
    elif road.length <= LONG * stretch and not (at_start and at_end):
        wanted = []
    else:
        wanted = np.linspace(low, high, max(1, round((high - low) / stretch)) + 1)
        wanted = [float(at) for at in wanted if 0.0 < at < road.length]
    cuts = [_nearest_clear(road, at, SLACK * stretch) for at in wanted]
    return list(dict.fromkeys(cuts))


def _nearest_clear(road: Carriageway, wanted: float, slack: float) -> tuple[int, float]:
    """The place nearest to ``wanted`` m that is away from junctions, or else the nearest end of an edge."""
    begin = np.concatenate(([0.0], np.cumsum(road.lengths)))
    low, high = begin[:-1] + CLEAR, begin[1:] - CLEAR
    at = np.where(low <= high, np.clip(wanted, low, high), np.inf)
    edge = int(np.abs(at - wanted).argmin())
    if abs(at[edge] - wanted) <= slack:
        return edge, float((at[edge] - begin[edge]) / road.lengths[edge])
    inner = begin[1:-1]
    if len(inner) and np.abs(inner - wanted).min() <= slack:
        return int(np.abs(inner - wanted).argmin()), 1.0
    edge = int(np.clip(np.searchsorted(begin, wanted, "right") - 1, 0, len(road.edges) - 1))
    return edge, float((wanted - begin[edge]) / road.lengths[edge])


def _share_out(
    road: Carriageway, cuts: list[tuple[int, float]], section: int, pieces: dict[str, list[Piece]]
) -> None:
    for k, edge in enumerate(road.edges):
        start = 0.0
        pieces[edge] = []
        for at in (share for e, share in cuts if e == k):
            pieces[edge].append(Piece(section, start, at))
            start, section = at, section + 1
        if start < 1.0:
            pieces[edge].append(Piece(section, start, 1.0))


def _edge_pieces(pieces: dict[str, list[Piece]], joined: list[int]) -> dict[str, list[Piece]]:
    """The same with sections numbered as stretches; neighbouring pieces of one stretch are one again."""
    number = {section: k for k, section in enumerate(sorted({s for s in joined if s >= 0}))}
    result: dict[str, list[Piece]] = {}
    for edge, parts in pieces.items():
        kept: list[Piece] = []
        for part in parts:
            stretch = number.get(joined[part.section], -1)
            if kept and kept[-1].section == stretch:
                kept[-1] = replace(kept[-1], end=part.end)
            else:
                kept.append(replace(part, section=stretch))
        result[edge] = kept
    return result


def parts(network: LaneNetwork, pieces: dict[str, list[Piece]]) -> list[LaneNetwork]:
    """The network cut up: section k of the pieces of its edges becomes network k; negative ones are left out.

    A connector whose edge is not among them goes with the lane that it leaves.
    """
    lanes = network.lanes
    source = {b: a for a, b in network.successors if lanes[b].connector}
    of_lane: list[list[Piece]] = [
        pieces.get(lane.edge) or [Piece(pieces[lanes[source[i]].edge][-1].section, 0.0, 1.0)]
        for i, lane in enumerate(lanes)
    ]
    count = 1 + max(part.section for own in of_lane for part in own)
    inside: list[list[tuple[int, Piece]]] = [[] for _ in range(count)]
    place: dict[tuple[int, float], int] = {}  # (lane, start) -> index in its stretch
    for i, own in enumerate(of_lane):
        for part in own:
            if part.section >= 0:
                place[i, part.start] = len(inside[part.section])
                inside[part.section].append((i, part))
    following: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for a, b in network.successors:
        last, first = of_lane[a][-1], of_lane[b][0]
        if last.section == first.section >= 0:
            following[last.section].append((place[a, last.start], place[b, first.start]))
    digits = max(2, len(str(count - 1)))
    return [
        LaneNetwork(
            f"{network.name}_{k:0{digits}d}",
            tuple(_part(lanes[i], part, place, of_lane) for i, part in inside[k]),
            tuple(following[k]),
            network.left_hand,
            geo=network.geo,
            origin=network.origin,
        )
        for k in range(count)
    ]


def _part(lane: Lane, part: Piece, place: dict[tuple[int, float], int], of_lane: list[list[Piece]]) -> Lane:
    def beside(other: int) -> int:
        return place[other, part.start] if other >= 0 and part in of_lane[other] else -1

    left, right = beside(lane.left), beside(lane.right)
    if part.start == 0.0 and part.end == 1.0:
        return replace(lane, left=left, right=right)
    s = arc_length(lane.points)
    points = between(lane.points, part.start * s[-1], part.end * s[-1])
    positions = s / s[-1] * lane.length if lane.positions is None else lane.positions
    inside = np.interp(part.start * s[-1] + arc_length(points), s, positions)
    return replace(
        lane,
        points=points,
        length=float(inside[-1] - inside[0]),
        left=left,
        right=right,
        dead_start=lane.dead_start and part.start == 0.0,
        dead_end=lane.dead_end and part.end == 1.0,
        positions=inside,
    )
