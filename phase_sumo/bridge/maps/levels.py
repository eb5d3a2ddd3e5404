"""Which places of a network lie on one road, told from how its lanes are connected and never from angles.

Roads that cross without a common junction are on different levels: who drives on one cannot see, touch or
reach the other. Edges are cut into pieces of about `PIECE` metres, and what the pieces of an edge have in
common with others near by is worked out once.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from itertools import pairwise, product

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.maps.stretches import Piece, parts
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.near import pairs_within, ranges
from phase_sumo.sim.polylines import Polylines

PIECE = 50.0  # m
REACH = 150.0  # m along the road: who is farther from the next common lane is not seen
JUNCTION = 100.0  # m from a junction within which the roads that meet there may still touch
SPACING = 2.0  # m between the points at which overlaps are looked for
OVERLAP = 0.5  # m by which surfaces overlap at least where one road lies over another
ALONGSIDE = 5  # points in a row: lanes that overlap longer than where one follows the other
AROUND = 40.0  # m of road before and behind a crossing that are told apart, too
Near = dict[int, float]


class Levels:
    """Pieces of road and what they have to do with each other.

    Attributes:
        count: number of pieces P.
    """

    def __init__(self, network: LaneNetwork) -> None:
        self._network = network
        numbers = {name: k for k, name in enumerate(dict.fromkeys(lane.edge for lane in network.lanes))}
        self._edge = np.array([numbers[lane.edge] for lane in network.lanes], np.int64)
        self._lane = {lane.id: i for i, lane in enumerate(network.lanes)}
        self._part = {part: (i, at) for i, lane in enumerate(network.lanes) for part, at in lane.parts}
        metres = np.zeros(len(numbers))
        np.maximum.at(metres, self._edge, Polylines.of([lane.points for lane in network.lanes]).length)
        self._pieces = np.maximum(np.rint(metres / PIECE), 1).astype(np.int64)
        self._first = np.cumsum(self._pieces) - self._pieces
        self._metres = np.repeat(metres / self._pieces, self._pieces)
        self.count = int(self._pieces.sum())
        last = self._first + self._pieces - 1
        self._after: list[set[int]] = [set() for _ in range(self.count)]
        self._before: list[set[int]] = [set() for _ in range(self.count)]
        links = {(int(last[self._edge[a]]), int(self._first[self._edge[b]])) for a, b in network.successors}
        within = set(range(self.count - 1)) - set(last.tolist())
        for a, b in [*links, *((p, p + 1) for p in within)]:
            self._after[a].add(b)
            self._before[b].add(a)
        self._in_line, self._seen, self._touching = self._relations()

    def piece(self, lane: IntArray, share: FloatArray) -> IntArray:
        """[n] pieces of places on lanes [n] of the network, given as shares [n] of their length."""
        edge = self._edge[lane]
        within = (share * self._pieces[edge]).astype(np.int64)
        return self._first[edge] + np.clip(within, 0, self._pieces[edge] - 1)

    def of_nodes(self, graph: LaneGraph) -> IntArray:
        """[V] piece of every node of the network's lane graph."""
        passed = np.arange(len(graph.node_lane)) - graph.lane_start
        return self.piece(graph.node_lane, passed / np.maximum(graph.lane_end - graph.lane_start, 1))

    def of_lane(self, lane: str, position: float) -> int:
        """The piece at one of SUMO's lane positions in m, -1 on a lane that is not in the network."""
        index, start = self._part.get(lane, (self._lane.get(lane, -1), 0.0))
        if index < 0:
            return -1
        share = (start + position) / max(self._network.lanes[index].length, 1e-3)
        return int(self.piece(np.array([index]), np.array([share]))[0])

    def in_line(self, a: IntArray, b: IntArray) -> BoolArray:
        """[n] whether one piece leads to the other within `REACH`, or they are the same."""
        return _holds(self._in_line, a * self.count + b)

    def seen(self, a: IntArray, b: IntArray) -> BoolArray:
        """[n] whether drivers look for each other: in line, behind one fork or before one merge."""
        return _holds(self._seen, a * self.count + b)

    def touching(self, a: IntArray, b: IntArray) -> BoolArray:
        """[n] whether vehicles there may touch: they see each other or are near a common junction."""
        return _holds(self._touching, a * self.count + b)

    def _relations(self) -> tuple[IntArray, IntArray, IntArray]:
        """Sorted keys a * P + b of the pairs for which `in_line`, `seen` and `touching` hold."""
        down = [self._reached(self._after, p, REACH) for p in range(self.count)]
        up: list[list[int]] = [[] for _ in down]
        for p, found in enumerate(down):
            for q in found:
                up[q].append(p)
        in_line = [(p, q) for p, found in enumerate(down) for q in found]
        in_line += [(q, p) for p, q in in_line]
        groups: list[Iterable[int]] = [up[q] for q, before in enumerate(self._before) if len(before) > 1]
        groups += [down[p] for p, after in enumerate(self._after) if len(after) > 1]
        seen = in_line + [pair for group in groups for pair in product(group, repeat=2)]
        touching = seen + [pair for group in self._junctions() for pair in product(group, repeat=2)]
        return tuple(self._keys(pairs) for pairs in (in_line, seen, touching + self._opposite()))  # type: ignore[return-value]

    def _keys(self, pairs: list[tuple[int, int]]) -> IntArray:
        a, b = np.array(pairs, np.int64).reshape(-1, 2).T
        return np.unique(a * self.count + b)

    def _reached(self, onward: list[set[int]], start: int, reach: float) -> Near:
        """Pieces that begin at most ``reach`` m behind the end of one, with these distances; itself, too."""
        found, waiting = {start: -float(self._metres[start])}, [start]
        while waiting:
            p = waiting.pop()
            metres = found[p] + float(self._metres[p])
            for q in onward[p] if metres <= reach else ():
                if metres < found.get(q, np.inf):
                    found[q] = metres
                    waiting.append(q)
        return found

    def _ends(self) -> tuple[list[str], list[str]]:
        """Junctions at which each edge starts and ends, "" where they are not known."""
        start, end = [""] * len(self._first), [""] * len(self._first)
        for lane, edge in zip(self._network.lanes, self._edge.tolist(), strict=True):
            start[edge], end[edge] = lane.start, lane.end
        return start, end

    def _junctions(self) -> list[Iterable[int]]:
        """For each junction the pieces within `JUNCTION` of it."""
        groups: dict[str, set[int]] = {}
        for edge, (start, end) in enumerate(zip(*self._ends(), strict=True)):
            first, last = int(self._first[edge]), int(self._first[edge] + self._pieces[edge] - 1)
            groups.setdefault(start, set()).update(self._reached(self._after, first, JUNCTION))
            groups.setdefault(end, set()).update(self._reached(self._before, last, JUNCTION))
        return [group for name, group in groups.items() if name]

    def _opposite(self) -> list[tuple[int, int]]:
        """Pieces beside each other of the two directions of one road."""
        start, end = self._ends()
        by_ends = {(a, b): k for k, (a, b) in enumerate(zip(start, end, strict=True)) if a and b and a != b}
        pairs = []
        for (a, b), edge in by_ends.items():
            other = by_ends.get((b, a), -1)
            for k in range(int(self._pieces[edge]) if other >= 0 else 0):
                mirrored = int((1.0 - (k + 0.5) / self._pieces[edge]) * self._pieces[other])
                beside = range(max(mirrored - 1, 0), min(mirrored + 2, int(self._pieces[other])))
                pairs += [(int(self._first[edge]) + k, int(self._first[other]) + at) for at in beside]
        return pairs

    @cached_property
    def layers(self) -> tuple[IntArray, BoolArray]:
        """Pieces sorted into layers, of which each is a flat road.

        Returns:
            [P] layer of each piece; [K, P] the pieces whose lanes are drawn in each layer, which reach a
            little farther than those that belong to it.
        """
        layer = np.zeros(self.count, np.int64)
        (over, beside), crossing = self._overlaps, self.crossing
        if not len(over):
            return layer, np.ones((1, self.count), bool)
        together = [pair for pair in beside.tolist() if crossing[pair].all()]
        together += [(p, q) for p in np.flatnonzero(crossing).tolist() for q in self._after[p] if crossing[q]]
        cluster = _clusters(self.count, together)
        for name, colour in _colours(cluster[over], np.bincount(cluster[crossing], minlength=self.count)):
            layer[crossing & (cluster == name)] = colour
        drawn = [~(crossing & (layer > 0))]
        glued = [set[int]() for _ in range(self.count)]
        for a, b in beside.tolist():
            glued[a].add(b)
        for k in range(1, int(layer.max()) + 1):
            own = self._grown(layer == k, glued, ~crossing)
            layer[own & ~crossing] = k
            drawn.append(self._grown(layer == k, glued, ~crossing))
        return layer, np.array(drawn)

    def _grown(self, kept: BoolArray, glued: list[set[int]], free: BoolArray) -> BoolArray:
        """Pieces ``kept`` with the ``free`` ones within `AROUND` of them and those that lie beside these."""
        result = kept.copy()
        waiting = [
            q
            for p in np.flatnonzero(kept).tolist()
            for onward in (self._after, self._before)
            for q in self._reached(onward, p, AROUND)
        ]
        while waiting:
            p = waiting.pop()
            if free[p] and not result[p]:
                result[p] = True
                waiting += glued[p]
        return result

    @cached_property
    def crossing(self) -> BoolArray:
        """[P] pieces over or under another road."""
        result = np.zeros(self.count, bool)
        result[self._overlaps[0].ravel()] = True
        return result

    @cached_property
    def _overlaps(self) -> tuple[IntArray, IntArray]:
        """[n, 2] pieces that lie over each other on different levels, and [m, 2] alongside on one."""
        lines = Polylines.of([lane.points for lane in self._network.lanes])
        samples = lines.samples(SPACING)
        xy = lines.at(samples)
        lane = np.repeat(np.arange(len(samples.counts)), samples.counts)
        piece = self.piece(lane, ranges(samples.counts) / (samples.counts[lane] - 1))
        width = np.array([lane.width for lane in self._network.lanes])
        a, b = pairs_within(xy, xy, float(width.max()) - OVERLAP)
        near = (piece[a] != piece[b]) & (lane[a] != lane[b])
        a, b = a[near], b[near]
        near = np.hypot(*(xy[a] - xy[b]).T) < 0.5 * (width[lane[a]] + width[lane[b]]) - OVERLAP
        a, b = a[near], b[near]
        one = self.touching(piece[a], piece[b])
        over = np.unique(np.stack((piece[a], piece[b]), 1)[~one], axis=0)
        a, b = a[one], b[one]
        points = np.unique(np.stack((piece[a], piece[b], lane[a], a), 1), axis=0)[:, :3]
        beside, count = np.unique(points, axis=0, return_counts=True)
        return over, np.unique(beside[count >= ALONGSIDE, :2], axis=0)

    def drawn(self, pieces: BoolArray) -> LaneNetwork:
        """The network of the given pieces [P] alone."""
        return self._cut(np.where(pieces, 0, -1))[0]

    def flat(self) -> list[LaneNetwork]:
        """The network, or one for each layer where roads lie over each other."""
        layer, drawn = self.layers
        return [self._network] if len(drawn) == 1 else self._cut(layer)

    def _cut(self, section: IntArray) -> list[LaneNetwork]:
        """A network for each section of the pieces [P], negative ones left out."""
        cuts: dict[str, list[Piece]] = {}
        for i, edge in enumerate(self._edge.tolist()):
            count, first = int(self._pieces[edge]), int(self._first[edge])
            ends = np.flatnonzero(np.diff(section[first : first + count])) + 1
            bounds = [0, *ends.tolist(), count]
            cuts[self._network.lanes[i].edge] = [
                Piece(int(section[first + a]), a / count, b / count) for a, b in pairwise(bounds)
            ]
        return parts(self._network, cuts)


def _holds(keys: IntArray, asked: IntArray) -> BoolArray:
    if not len(keys):
        return np.zeros(len(asked), bool)
    return keys[np.minimum(np.searchsorted(keys, asked), len(keys) - 1)] == asked


def _clusters(count: int, together: list[tuple[int, int]]) -> IntArray:
    """[count] the first of all that are linked with each."""
    parent = list(range(count))

    def root(p: int) -> int:
        while parent[p] != p:
            parent[p] = p = parent[parent[p]]
        return p

    for a, b in together:
        low, high = sorted((root(a), root(b)))
        parent[high] = low
    return np.array([root(p) for p in range(count)])


def _colours(apart: IntArray, size: IntArray) -> list[tuple[int, int]]:
    """Clusters with layers: the largest first, each in the lowest that none of those ``apart`` [n, 2] has."""
    others: dict[int, set[int]] = {}
    for a, b in apart.tolist():
        others.setdefault(a, set()).add(b)
    given: dict[int, int] = {}
    for name in sorted(others, key=lambda name: (-int(size[name]), name)):
        used = {given[other] for other in others[name] if other in given}
        given[name] = next(k for k in range(len(used) + 1) if k not in used)
    return list(given.items())
