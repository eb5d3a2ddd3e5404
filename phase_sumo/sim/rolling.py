"""Rolling goals: a vehicle that has reached its goal gets the next one instead of leaving.

Episodes of the paper end at the goal. Long-running traffic goes on: the next goal is that of a start-goal
pair of the same pool that starts where the last one ended. Behind the bridge, SUMO's route gives it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.pool import StartGoalPool

AHEAD = 6  # nodes, about metres: pairs that start this close behind a goal go on from it


@dataclass(frozen=True)
class NextGoals:
    """Pairs to go on with, for the nodes of many (map, regime) tuples one behind the other.

    Attributes:
        first, count: [V, 2] the pairs of a node, for any vehicle and for trucks; count 0 where the road ends.
        goal: [Q] goal node of every pair.
    """

    first: Tensor
    count: Tensor
    goal: Tensor

    @staticmethod
    def of(tuples: list[tuple[LaneGraph, StartGoalPool]], device: torch.device | str) -> NextGoals:
        first, count, goal = [], [], []
        node_offset = pair_offset = 0
        for graph, pool in tuples:
            columns = []
            for trucks in (False, True):
                pairs = np.flatnonzero(pool.truck | (not trucks))
                pairs = pairs[np.argsort(pool.start[pairs], kind="stable")]
                begin, number = _pairs_from(graph, pool.start[pairs])
                columns.append((begin + pair_offset, number))
                goal.append(pool.goal[pairs].astype(np.int64) + node_offset)
                pair_offset += len(pairs)
            first.append(np.stack([begin for begin, _ in columns], 1))
            count.append(np.stack([number for _, number in columns], 1))
            node_offset += len(graph.node_lane)
        tables = (torch.from_numpy(np.concatenate(parts)).to(device) for parts in (first, count, goal))
        return NextGoals(*tables)

    def draw(self, node: Tensor, truck: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """The next goal of agents at their goal.

        Args:
            node: [W, N] goal nodes that were reached.
            truck: [W, N] bool.
            uniform: [W, N] in [0, 1).

        Returns:
            next goal node [W, N], and whether there is one [W, N] bool.
        """
        kind = truck.long()
        count = self.count[node, kind]
        pair = self.first[node, kind] + (uniform * count).long().clamp_max((count - 1).clamp_min(0))
        goes_on = count > 0
        return self.goal[torch.where(goes_on, pair, 0)], goes_on


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
