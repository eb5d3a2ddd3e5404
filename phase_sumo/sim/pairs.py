"""The pools of many (map, regime) tuples as flat tensors: goals for every node, and places to start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from phase_sumo.errors import PhaseError
from phase_sumo.sim.curve_speed import SIDEWAYS, lane_speeds
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.pool import StartGoalPool

AHEAD = 6  # nodes, about metres: pairs that start this close ahead of a node serve it


@dataclass(frozen=True)
class PairTable:
    """Start-goal pairs by node; V nodes and Q pairs of all tuples, one tuple behind the other.

    Attributes:
        node: [V, 4] x, y in m, yaw in rad, curvature in 1/m.
        curve_speed: [V] m/s for the curves ahead in the node's lane (`curve_speed.lane_speeds`).
        onward: [V] next node, straight on, -1 where the road ends; ``hop``: [V] m to it.
        first, count: [V, 2, 2] the pairs of a node: same lane or lane change, any vehicle or trucks; sorted
            by length.
        goal, length, start_speed, goal_speed: [Q] see `StartGoalPool`.
        most: pairs of a node at most.
        lines: where vehicles can start.
    """

    node: Tensor
    curve_speed: Tensor
    onward: Tensor
    hop: Tensor
    first: Tensor
    count: Tensor
    goal: Tensor
    length: Tensor
    start_speed: Tensor
    goal_speed: Tensor
    most: int
    lines: Lines

    @staticmethod
    def of(tuples: list[tuple[LaneGraph, StartGoalPool]], device: torch.device | str) -> PairTable:
        parts: dict[str, list[np.ndarray]] = {}
        nodes = pairs = 0
        starts = []
        for graph, pool in tuples:
            columns = _columns(graph, pool, nodes, pairs)
            starts.append(_starts(graph, columns["count"], nodes))
            nodes, pairs = nodes + len(graph.node_lane), pairs + len(columns["goal"])
            for name, values in columns.items():
                parts.setdefault(name, []).append(values)
        if pairs == 0:
            raise PhaseError("the maps hold no start-goal pairs: convert longer networks")
        tables = {name: torch.from_numpy(np.concatenate(part)).to(device) for name, part in parts.items()}
        return PairTable(**tables, most=int(tables["count"].max()), lines=Lines.of(starts, device))

    def draw(
        self, node: Tensor, change: Tensor, truck: Tensor, longest: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor]:
        """One pair per agent among those that start at or just ahead of its node.

        Args:
            node: [B, N].
            change, truck: [B, N] bool, wanted kind and permission; where a node has no pairs of the wanted
                kind (one lane, say) the other kind serves.
            longest: [B, N] m, no longer path than this.
            uniform: [B, N] in [0, 1).

        Returns:
            index of the pair [B, N] and whether there is any [B, N] bool.
        """
        permission = truck.long()
        chosen, fits = self._among(node, change.long(), permission, longest, uniform)
        other, other_fits = self._among(node, 1 - change.long(), permission, longest, uniform)
        return torch.where(fits, chosen, torch.where(other_fits, other, 0)), fits | other_fits

    def onward_from(
        self, node: Tensor, change: Tensor, truck: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor]:
        """A pair of any length from a node, with a ``change`` or without; the other kind where there is none.

        Returns:
            index of the pair [B, N] and whether there is any [B, N] bool.
        """
        change = torch.where(self.count[node, change, truck.long()] > 0, change, 1 - change)
        first, count = self.first[node, change, truck.long()], self.count[node, change, truck.long()]
        pair = first + (uniform * count).long().clamp_max((count - 1).clamp_min(0))
        return torch.where(count > 0, pair, 0), count > 0

    def _among(
        self, node: Tensor, change: Tensor, truck: Tensor, longest: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor]:
        first, count = self.first[node, change, truck], self.count[node, change, truck]
        place = torch.arange(self.most, device=node.device)
        index = (first.unsqueeze(-1) + place).clamp_max(len(self.length) - 1)
        short = (place < count.unsqueeze(-1)) & (self.length[index] <= longest.unsqueeze(-1))
        count = short.sum(-1)
        return first + (uniform * count).long().clamp_max((count - 1).clamp_min(0)), count > 0


@dataclass(frozen=True)
class Lines:
    """The nodes to start from along chains of lanes, all on one axis in m.

    The axis runs through tuple after tuple, chain after chain. P points, sorted along it.

    Attributes:
        at: [P] float64, place on the axis; ``node``: [P].
        low, high: [P] float64, where the chain of a point begins and ends.
        begin, length: [tuples] float64, part of the axis of every tuple.
        trucks: points that trucks may start from; ``first_truck``, ``truck_count``: [tuples].
    """

    at: Tensor
    node: Tensor
    low: Tensor
    high: Tensor
    begin: Tensor
    length: Tensor
    trucks: Tensor
    first_truck: Tensor
    truck_count: Tensor

    @staticmethod
    def of(
        starts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]], device: torch.device | str
    ) -> Lines:
        """From node, metres to the next, chain and permission for trucks of each tuple's points."""
        at, low, high, begin, length, truck = [], [], [], [], [], []
        offset = 0.0
        for _, hop, chain, allowed in starts:
            place = offset + np.cumsum(hop) - hop
            heads = np.flatnonzero(np.diff(chain, prepend=-1))
            number = np.searchsorted(heads, np.arange(len(chain)), "right") - 1
            ends = np.append(place[heads[1:]], offset + hop.sum())
            at.append(place)
            low.append(place[heads][number] if len(chain) else place)
            high.append(ends[number] if len(chain) else place)
            begin.append(offset)
            length.append(hop.sum())
            truck.append(allowed)
            offset += hop.sum()
        trucks = np.concatenate(truck)
        counts = np.array([int(t.sum()) for t in truck])
        columns = (
            np.concatenate(at),
            np.concatenate([node for node, *_ in starts]),
            np.concatenate(low),
            np.concatenate(high),
            np.array(begin),
            np.array(length),
            np.flatnonzero(trucks),
            np.cumsum(counts) - counts,
            counts,
        )
        return Lines(*(torch.from_numpy(column).to(device) for column in columns))

    def point(self, place: Tensor) -> Tensor:
        """The point at or before each ``place`` on the axis."""
        return (torch.searchsorted(self.at, place.contiguous(), right=True) - 1).clamp_min(0)


def _columns(graph: LaneGraph, pool: StartGoalPool, nodes: int, pairs: int) -> dict[str, np.ndarray]:
    """The columns of `PairTable` of one tuple, whose nodes and pairs count from the given numbers on."""
    onward = graph.successor[:, 0].astype(np.int64)
    first, count, chosen, number = [], [], [], pairs
    for changes in (False, True):
        for trucks in (False, True):
            index = np.flatnonzero(((pool.lane_changes != 0) == changes) & (pool.truck | (not trucks)))
            index = index[np.lexsort((pool.path_length[index], pool.start[index]))]
            begin, many = _pairs_from(graph, pool.start[index])
            first.append(begin + number)
            count.append(many)
            chosen.append(index)
            number += len(index)
    index = np.concatenate(chosen)
    shape = (len(onward), 2, 2)
    return {
        "node": np.column_stack((graph.node_xy, graph.node_yaw, graph.node_curvature)).astype(np.float32),
        "curve_speed": lane_speeds(graph, SIDEWAYS).astype(np.float32),
        "onward": np.where(onward >= 0, onward + nodes, -1),
        "hop": graph.step[:, 0].astype(np.float32),
        "first": np.stack(first, -1).reshape(shape),
        "count": np.stack(count, -1).reshape(shape),
        "goal": pool.goal[index].astype(np.int64) + nodes,
        "length": pool.path_length[index],
        "start_speed": pool.start_speed[index],
        "goal_speed": pool.goal_speed[index],
    }


def _pairs_from(graph: LaneGraph, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[V] first pair, and number of pairs, of the nearest of the sorted starts at or ahead of each node."""
    node = np.arange(len(graph.node_lane))
    begin, found = _at_or_ahead(graph, start, node)
    onward = graph.successor[graph.lane_end, 0].astype(np.int64)
    over_the_end = ~found & (onward >= 0) & (graph.lane_end - node < AHEAD)
    begin_onward, found_onward = _at_or_ahead(graph, start, np.maximum(onward, 0))
    begin = np.where(over_the_end, begin_onward, begin)
    found = np.where(over_the_end, found_onward, found)
    begin = np.where(found, begin, 0)
    of_start = np.append(start, -1)[begin]
    number = np.searchsorted(start, of_start, "right") - begin
    return begin, np.where(found, number, 0)


def _at_or_ahead(graph: LaneGraph, start: np.ndarray, node: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    begin = np.searchsorted(start, node, "left")
    nearest = np.append(start, -1)[begin].astype(np.int64)
    same_lane = graph.node_lane[nearest] == graph.node_lane[node]
    return begin, (nearest >= 0) & same_lane & (nearest - node <= AHEAD)


def _starts(
    graph: LaneGraph, count: np.ndarray, nodes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nodes with pairs, along chains of lanes: node, m to the next, chain, and whether trucks may start."""
    order, chain = _chains(graph)
    usable = count[order, :, 0].sum(-1) > 0
    # a chain is cut where no pair starts
    cut = (np.diff(chain, prepend=-1) != 0) | np.diff(usable, prepend=False)
    chain = np.cumsum(cut)[usable]
    order = order[usable]
    truck = count[order, :, 1].sum(-1) > 0
    return order + nodes, np.maximum(graph.step[order, 0], 0.1), chain, truck


def _chains(graph: LaneGraph) -> tuple[np.ndarray, np.ndarray]:
    """All nodes, lane behind lane, and the number of their chain; a lane has one lane behind it at most."""
    first = np.flatnonzero(np.diff(graph.node_lane, prepend=-1))
    last = np.append(first[1:], len(graph.node_lane)) - 1
    ahead = graph.successor[last, 0].astype(np.int64)
    following = np.where(ahead >= 0, np.searchsorted(first, ahead, "right") - 1, -1)
    behind = np.full(len(first), -1)
    for lane, onward in enumerate(following.tolist()):
        if onward >= 0 and behind[onward] < 0 and onward != lane:
            behind[onward] = lane
    order, chain, seen = [], [], np.zeros(len(first), bool)
    for head in [*np.flatnonzero(behind < 0).tolist(), *range(len(first))]:
        lane, number = head, len(chain)
        while lane >= 0 and not seen[lane]:
            seen[lane] = True
            order.append(np.arange(first[lane], last[lane] + 1))
            chain.append(np.full(last[lane] + 1 - first[lane], number))
            onward = int(following[lane])
            lane = onward if onward >= 0 and behind[onward] == lane else -1
    return np.concatenate(order), np.concatenate(chain)
