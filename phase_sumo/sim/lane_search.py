"""Bounded search over the lane graph, lane by lane: what can be reached, along how many metres of path.

A vehicle that enters a lane at a node reaches every node after it, so the search moves from lane to lane
instead of from metre to metre: a *label* says where a lane is entered, and stands for the rest of that lane.
Labels of thousands of starts advance together; they take as many rounds as a path crosses lanes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.curve_speed import braked_to
from phase_sumo.sim.lane_graph import MAX_SUCCESSORS, LaneGraph

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
LAP = 32.0  # m: ways into a lane whose lengths differ by about this much are kept apart (loops, by-passes)
BLOCK = 8192  # starts searched at once: memory does not grow with the map, and a block stays in the cache


@dataclass(frozen=True)
class Transition:
    """The way from each node to the next lane, [V] each.

    Attributes:
        change: what it adds to the signed lane-change count.
        target: node where the next lane is entered, -1 where there is no way.
        length: metres to there.
        truck: every lane entered on the way allows trucks.
    """

    change: int
    target: IntArray
    length: FloatArray
    truck: BoolArray


@dataclass(frozen=True)
class Labels:
    """Lane entries, one row each: every node from ``node`` to its lane's end is reached.

    Attributes:
        start: node the path starts at.
        node: node where it enters the lane.
        change: its signed lane-change count c.
        truck: every lane so far allows trucks.
        length: metres from start to node.
        speed: m/s at the start from which every curve on the way can be braked for.
    """

    start: IntArray
    node: IntArray
    change: IntArray
    truck: BoolArray
    length: FloatArray
    speed: FloatArray

    def take(self, rows: IntArray | BoolArray) -> Labels:
        return Labels(*(getattr(self, f.name)[rows] for f in fields(self)))

    @staticmethod
    def stack(parts: list[Labels]) -> Labels:
        return Labels(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Labels)))


def transitions(graph: LaneGraph, change_length: float) -> list[Transition]:
    """All ways out of a lane: over its end into each successor, and by a lane change to either side."""
    return [
        *_onward(graph),
        *_lane_changes(graph, graph.left, -1, change_length),
        *_lane_changes(graph, graph.right, +1, change_length),
    ]


def _onward(graph: LaneGraph) -> Iterator[Transition]:
    end = graph.lane_end
    rest = graph.along[end] - graph.along
    for column in range(MAX_SUCCESSORS):
        target = graph.successor[:, column].astype(np.int64)[end]
        if (target >= 0).any():
            yield Transition(0, target, rest + graph.step[end, column], graph.node_truck[target])


def _lane_changes(
    graph: LaneGraph, abreast: NDArray[np.int32], sign: int, reach: float
) -> Iterator[Transition]:
    """The earliest lane change from each node on; one table per branch where the new lane forks under way.

    The earliest one is enough: a later one ends further down the same lanes.
    """
    nodes = len(abreast)
    leave = np.flatnonzero(abreast >= 0)
    row, target, length, truck = _landings(
        graph, abreast[leave].astype(np.int64), _open_to(graph, abreast), reach
    )
    begin = leave[row]
    order = np.argsort(begin, kind="stable")
    begin, target, length, truck = begin[order], target[order], length[order], truck[order]
    possible = np.full(nodes, nodes)
    possible[begin] = begin
    nearest = np.minimum.accumulate(possible[::-1])[::-1]
    usable = np.flatnonzero(nearest <= graph.lane_end)
    nearest = nearest[usable]
    branch = np.arange(len(begin)) - np.searchsorted(begin, begin)
    for k in range(int(branch.max(initial=-1)) + 1):
        of_begin = np.full(nodes, -1)
        of_begin[begin[branch == k]] = np.flatnonzero(branch == k)
        way = of_begin[nearest]
        at, way = usable[way >= 0], way[way >= 0]
        table = Transition(sign, np.full(nodes, -1), np.zeros(nodes), np.zeros(nodes, bool))
        table.target[at] = target[way]
        table.length[at] = graph.along[begin[way]] - graph.along[at] + length[way]
        table.truck[at] = truck[way]
        yield table


def _open_to(graph: LaneGraph, abreast: NDArray[np.int32]) -> BoolArray:
    """[V] nodes that may be changed into."""
    is_open = np.zeros(len(abreast), bool)
    is_open[abreast[abreast >= 0]] = True
    # lanes abreast differ in node count on curves: a single node without a partner is no gap
    after = graph.successor[:, 0]
    is_open[after[is_open & (after >= 0)]] = True
    return is_open


def _landings(
    graph: LaneGraph, entered: IntArray, is_open: BoolArray, reach: float
) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
    """Where lane changes end that enter the new lane at ``entered``: row, node, metres, trucks allowed.

    They follow the new lane for ``reach`` metres, over its end where need be, and only over open nodes.
    """
    along, end = graph.along, graph.lane_end
    closed = np.concatenate(([0], np.cumsum(~is_open)))
    found: list[tuple[IntArray, IntArray, FloatArray, BoolArray]] = []
    row, node = np.arange(len(entered)), entered
    length, truck = np.zeros(len(entered)), graph.node_truck[entered]
    while True:
        missing = np.maximum(reach - length, 0.0)
        target = node + np.ceil(missing / graph.spacing[node] - 1e-3).astype(np.int64)
        within = target <= end[node]
        target = np.minimum(target, end[node])
        passable = closed[target + 1] == closed[node]
        length = length + along[target] - along[node]
        done = within & passable
        found.append((row[done], target[done], length[done], truck[done]))
        on, column = np.nonzero((graph.successor[target] >= 0) & (~within & passable)[:, None])
        if not len(on):
            return tuple(np.concatenate(part) for part in zip(*found, strict=True))  # type: ignore[return-value]
        last = target[on]
        node = graph.successor[last, column].astype(np.int64)
        row, length = row[on], length[on] + graph.step[last, column]
        truck = truck[on] & graph.node_truck[node]


def search(
    graph: LaneGraph,
    starts: IntArray,
    truck: BoolArray,
    ways: list[Transition],
    longest: float,
    budget: int,
    speeds: FloatArray,
) -> Iterator[Labels]:
    """Labels of every lane within ``longest`` metres and ``budget`` lane changes, block by block of starts.

    Args:
        starts: [Q] nodes.
        truck: [Q] a truck may start there.
        ways: from `transitions`.
        speeds: [V] m/s, see `curve_speed.lane_speeds`.
    """
    ranks = _Ranks.of(graph, longest, budget)
    for begin in range(0, len(starts), BLOCK):
        block = slice(begin, begin + BLOCK)
        first, count = starts[block], len(starts[block])
        now = Labels(first, first, np.zeros(count, np.int64), truck[block], np.zeros(count), speeds[first])
        known = np.zeros(0, np.int64)
        found: list[Labels] = []
        while len(now.node):
            rank = ranks(now, first[0])
            rows = _leaders(rank, ranks.group, known)
            known = np.sort(np.concatenate((known, rank[rows])))
            now = now.take(rows)
            found.append(now)
            onward = (_followed(now, way, longest, budget, speeds) for way in ways)
            now = Labels.stack([now.take(rows[:0]), *onward])
        labels = Labels.stack(found)
        yield labels.take(_leaders(ranks(labels, first[0]), ranks.group, known[:0]))


def _followed(now: Labels, way: Transition, longest: float, budget: int, speeds: FloatArray) -> Labels:
    change = now.change + way.change
    length = now.length + way.length[now.node]
    target = way.target[now.node]
    rows = np.flatnonzero((target >= 0) & (length <= longest) & (np.abs(change) <= budget))
    return Labels(
        now.start[rows],
        target[rows],
        change[rows],
        now.truck[rows] & way.truck[now.node[rows]],
        length[rows],
        np.minimum(now.speed[rows], braked_to(speeds[target[rows]], length[rows])),
    )


@dataclass(frozen=True)
class _Ranks:
    """Numbers that sort labels by start, lane, c and lap (the group), then trucks and early entries first."""

    lane: IntArray
    offset: IntArray
    lap_offset: FloatArray
    lanes: int
    laps: int
    group: int
    budget: int

    @staticmethod
    def of(graph: LaneGraph, longest: float, budget: int) -> _Ranks:
        lane = graph.node_lane.astype(np.int64)
        counts = np.bincount(lane)
        passed = graph.along - graph.along[graph.lane_start]
        ahead = passed.max()
        laps = int((longest + ahead) / LAP) + 1
        offset = np.arange(len(lane)) - graph.lane_start
        return _Ranks(lane, offset, ahead - passed, len(counts), laps, 2 * int(counts.max()), budget)

    def __call__(self, labels: Labels, first_start: int) -> IntArray:
        lap = ((labels.length + self.lap_offset[labels.node]) / LAP).astype(np.int64)
        rank = (labels.start - first_start) * self.lanes + self.lane[labels.node]
        rank = (rank * (2 * self.budget + 1) + labels.change + self.budget) * self.laps + lap
        return rank * self.group + ~labels.truck * (self.group // 2) + self.offset[labels.node]


def _leaders(rank: IntArray, group: int, known: IntArray) -> IntArray:
    """Rows that lead their group, unless a row of the sorted ``known`` ones does."""
    order = np.argsort(rank)
    rank = rank[order]
    of = rank // group
    leads = np.ones(len(rank), bool)
    leads[1:] = of[1:] != of[:-1]
    if len(known):
        before = known[np.maximum(np.searchsorted(known, rank, side="right") - 1, 0)]
        leads &= (before > rank) | (before // group != of)
    return order[leads]
