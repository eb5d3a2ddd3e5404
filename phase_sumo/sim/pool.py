"""The offline pool of start-goal pairs of one map in one traffic regime."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from phase_sumo.config import Regime
from phase_sumo.sim.lane_graph import MAX_SUCCESSORS, LaneGraph

START_SPACING = 2.0  # m between sampled starts along a lane
GOALS_PER_GROUP = 3  # goals per start, lane reached and lane-change count, spread over the path length
LANE_CHANGE_TIME = 2.5  # s at the regime's base speed: the shortest stretch asked for a lane change
SHORTEST_LANE_CHANGE = 15.0  # m
TRUCK_UPSTREAM = 20.0  # m of road behind a truck's start
MAX_STARTS = 12000  # larger maps are sampled more coarsely


@dataclass(frozen=True)
class StartGoalPool:
    """Start-goal pairs (paper: Synthetic Scenario Generation).

    Attributes:
        start, goal: [Q] int32 node indices of the lane graph.
        path_length: [Q] float32, m, within the regime's D_min..D_max.
        lane_changes: [Q] int8, signed count c: left -1, right +1.
        truck: [Q] bool, every lane of the path allows trucks and a trailer fits behind the start.
    """

    start: np.ndarray
    goal: np.ndarray
    path_length: np.ndarray
    lane_changes: np.ndarray
    truck: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        return {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass(frozen=True)
class _Frontier:
    """States of the search after equally many metres, one row each.

    Attributes:
        start: position in the list of starts.
        node, change: where the state is and its signed lane-change count.
        truck: every node so far allows trucks.
        length: exact path length in m.
    """

    start: np.ndarray
    node: np.ndarray
    change: np.ndarray
    truck: np.ndarray
    length: np.ndarray

    def take(self, rows: np.ndarray) -> _Frontier:
        return _Frontier(*(getattr(self, f.name)[rows] for f in fields(self)))

    def unique(self, nodes: int, budget: int) -> _Frontier:
        """One state per (start, node, change); trucks that are allowed win over those that are not."""
        key = (self.start * nodes + self.node) * (2 * budget + 1) + self.change + budget
        order = np.argsort(2 * key + ~self.truck, kind="stable")
        key = key[order]
        first = np.ones(len(key), bool)
        first[1:] = key[1:] != key[:-1]
        return self.take(order[first])


def _stack(parts: list[_Frontier]) -> _Frontier:
    return _Frontier(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(_Frontier)))


@dataclass(frozen=True)
class _LaneChange:
    """Where a lane change ends that begins at a node: [V, 4] nodes (-1 padded) and path lengths in m."""

    target: np.ndarray
    length: np.ndarray
    truck: np.ndarray


def build_pool(graph: LaneGraph, regime: Regime, max_lane_changes: int = 3, seed: int = 0) -> StartGoalPool:
    """Bounded breadth-first search from sampled starts, all starts at once, metre by metre.

    A lane change is one transition that ends `lane_change_length` metres further on in the adjacent lane
    and must stay allowed all the way. Pairs the map has no room for simply do not exist.
    """
    rng = np.random.default_rng(seed)
    starts = _sample_starts(graph, rng)
    reach = round(lane_change_length(regime))
    changes = [(-1, _lane_change(graph, graph.left, reach)), (1, _lane_change(graph, graph.right, reach))]
    found = _search(graph, starts, changes, reach, regime.path_bounds, max_lane_changes)
    return _select(graph, starts, found, regime.path_bounds, rng)


def lane_change_length(regime: Regime) -> float:
    """Metres along the road that a lane change takes at least in this regime."""
    return max(SHORTEST_LANE_CHANGE, LANE_CHANGE_TIME * regime.base_speed)


def _sample_starts(graph: LaneGraph, rng: np.random.Generator) -> np.ndarray:
    """About every second node, at random offsets."""
    spacing = max(START_SPACING, len(graph.node_lane) / MAX_STARTS)
    count = int(len(graph.node_lane) / spacing)
    return np.minimum((np.arange(count) + rng.random(count)) * spacing, len(graph.node_lane) - 1).astype(
        np.int64
    )


def _lane_change(graph: LaneGraph, abreast: np.ndarray, reach: int) -> _LaneChange:
    """Follow the adjacent lane for ``reach`` nodes while the change into it stays allowed."""
    open_to = np.zeros(len(abreast), bool)
    open_to[abreast[abreast >= 0]] = True
    # lanes abreast differ in node count on curves: a single node without a partner is no gap
    after = graph.successor[:, 0]
    open_to[after[open_to & (after >= 0)]] = True
    step = graph.step
    target = np.full((len(abreast), MAX_SUCCESSORS), -1, np.int64)
    target[:, 0] = abreast
    length = np.zeros(target.shape)
    truck = np.broadcast_to(graph.node_truck[:, None], target.shape).copy()
    for _ in range(reach):
        target, length, truck = _advance(graph, step, target, length, truck)
        target[(target >= 0) & ~open_to[target]] = -1
    return _LaneChange(target, length, truck)


def _advance(
    graph: LaneGraph, step: np.ndarray, target: np.ndarray, length: np.ndarray, truck: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One node ahead in every column of the [V, 4] tables; a fork fills free columns."""
    rows = np.arange(len(target))
    valid = target >= 0
    fork_rows = rows[(valid & (graph.successor[target, 1] >= 0)).any(1)]
    ahead = np.where(valid, graph.successor[target, 0], -1)
    further = length + np.where(ahead >= 0, step[target, 0], 0.0)
    allowed = truck & graph.node_truck[ahead]
    for row in fork_rows:
        free = iter(np.flatnonzero(ahead[row] < 0))
        for column in np.flatnonzero(valid[row]):
            for k in range(1, MAX_SUCCESSORS):
                node = graph.successor[target[row, column], k]
                slot = next(free, None) if node >= 0 else None
                if slot is not None:
                    ahead[row, slot] = node
                    further[row, slot] = length[row, column] + step[target[row, column], k]
                    allowed[row, slot] = truck[row, column] & graph.node_truck[node]
    return ahead.astype(np.int64), further, allowed


def _search(
    graph: LaneGraph,
    starts: np.ndarray,
    changes: list[tuple[int, _LaneChange]],
    reach: int,
    bounds: tuple[float, float],
    budget: int,
) -> _Frontier:
    """Every state whose path length lies within the bounds."""
    step = graph.step
    waiting: dict[int, list[_Frontier]] = {
        0: [
            _Frontier(
                np.arange(len(starts)),
                starts.astype(np.int64),
                np.zeros(len(starts), np.int64),
                graph.node_truck[starts] & (graph.node_upstream[starts] >= TRUCK_UPSTREAM),
                np.zeros(len(starts)),
            )
        ]
    }
    found: list[_Frontier] = []
    depth = 0
    while waiting:
        arrived = waiting.pop(depth, None)
        if arrived is not None:
            now = _stack(arrived)
            now = now.take(np.flatnonzero(now.length <= bounds[1])).unique(len(step), budget)
            found.append(now.take(np.flatnonzero(now.length >= bounds[0])))
            if len(now.node):
                waiting.setdefault(depth + 1, []).append(_ahead(graph, step, now))
                for sign, change in changes:
                    waiting.setdefault(depth + reach, []).append(_sideways(now, sign, change, budget))
        depth += 1
    return _stack(found)


def _ahead(graph: LaneGraph, step: np.ndarray, now: _Frontier) -> _Frontier:
    row, column = np.nonzero(graph.successor[now.node] >= 0)
    node = now.node[row]
    ahead = graph.successor[node, column].astype(np.int64)
    return _Frontier(
        now.start[row],
        ahead,
        now.change[row],
        now.truck[row] & graph.node_truck[ahead],
        now.length[row] + step[node, column],
    )


def _sideways(now: _Frontier, sign: int, change: _LaneChange, budget: int) -> _Frontier:
    within = np.abs(now.change + sign) <= budget
    row, column = np.nonzero((change.target[now.node] >= 0) & within[:, None])
    node = now.node[row]
    return _Frontier(
        now.start[row],
        change.target[node, column],
        now.change[row] + sign,
        now.truck[row] & change.truck[node, column],
        now.length[row] + change.length[node, column],
    )


def _select(
    graph: LaneGraph,
    starts: np.ndarray,
    found: _Frontier,
    bounds: tuple[float, float],
    rng: np.random.Generator,
) -> StartGoalPool:
    """A random goal per start, lane reached, lane-change count and third of the length range."""
    span = (bounds[1] - bounds[0]) / GOALS_PER_GROUP
    third = np.minimum((found.length - bounds[0]) // span, GOALS_PER_GROUP - 1).astype(np.int64)
    lane = graph.node_lane[found.node]
    order = np.lexsort((rng.random(len(lane)), third, found.change, lane, found.start))
    groups = np.stack((found.start, lane, found.change, third))[:, order]
    first = np.ones(len(order), bool)
    first[1:] = (groups[:, 1:] != groups[:, :-1]).any(0)
    chosen = found.take(order[first])
    return StartGoalPool(
        start=starts[chosen.start].astype(np.int32),
        goal=chosen.node.astype(np.int32),
        path_length=chosen.length.astype(np.float32),
        lane_changes=chosen.change.astype(np.int8),
        truck=chosen.truck,
    )
