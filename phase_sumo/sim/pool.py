"""The offline pool of start-goal pairs of one map in one traffic regime."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from phase_sumo.config import Regime
from phase_sumo.sim.curve_speed import SIDEWAYS, lane_speeds
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.lane_search import Labels, search, transitions

START_SPACING = 3.0  # m between sampled starts along a lane
GOALS_PER_GROUP = 3  # goals per start, lane reached and lane-change count, spread over the path length
LANE_CHANGE_TIME = 2.5  # s at the regime's base speed: the shortest stretch asked for a lane change
SHORTEST_LANE_CHANGE = 15.0  # m
TIGHTEST = 1.0 / 12.0  # 1/m: no path leads over nodes that are curved more tightly
TRUCK_UPSTREAM = 20.0  # m of road behind a truck's start


@dataclass(frozen=True)
class StartGoalPool:
    """Start-goal pairs (paper: Synthetic Scenario Generation).

    Attributes:
        start, goal: [Q] int32 node indices of the lane graph.
        path_length: [Q] float32, m, within the regime's D_min..D_max.
        lane_changes: [Q] int8, signed count c: left -1, right +1.
        truck: [Q] bool, every lane of the path allows trucks and a trailer fits behind the start.
        start_speed: [Q] float32, m/s from which a car can brake for every curve on the way (`curve_speed`).
        goal_speed: [Q] float32, the same for the curves from the goal on.
    """

    start: np.ndarray
    goal: np.ndarray
    path_length: np.ndarray
    lane_changes: np.ndarray
    truck: np.ndarray
    start_speed: np.ndarray
    goal_speed: np.ndarray

    @staticmethod
    def empty() -> StartGoalPool:
        kinds = (np.int32, np.int32, np.float32, np.int8, bool, np.float32, np.float32)
        return StartGoalPool(*(np.zeros(0, kind) for kind in kinds))

    def arrays(self) -> dict[str, np.ndarray]:
        return {f.name: getattr(self, f.name) for f in fields(self)}


def build_pool(graph: LaneGraph, regime: Regime, max_lane_changes: int = 3, seed: int = 0) -> StartGoalPool:
    """Bounded search from sampled starts, then a few random goals in every lane and lane-change count found.

    A lane change is one transition that ends `lane_change_length` metres further on in the adjacent lane
    and must stay allowed all the way. Nodes that are curved more tightly than `TIGHTEST` are left out. Pairs
    the map has no room for simply do not exist.

    Cost and memory grow with the length of lane: per km some 3,300 pairs of 22 bytes, and a peak of 0.35 MB
    while searching, lane graph included (measured on 117 km of three-lane freeway).
    """
    rng = np.random.default_rng(seed)
    drivable = graph.bend <= TIGHTEST
    if not drivable.any():
        return StartGoalPool.empty()
    speeds = lane_speeds(graph, SIDEWAYS)[drivable]
    graph = graph.restricted(drivable)
    starts = _sample_starts(graph, rng)
    truck = graph.node_truck[starts] & (graph.node_upstream[starts] >= TRUCK_UPSTREAM)
    ways = transitions(graph, lane_change_length(regime))
    low, high = regime.path_bounds
    bounds = np.linspace(low, high, GOALS_PER_GROUP + 1)
    pools = [
        _goals(graph, labels, a, b, speeds, rng)
        for labels in search(graph, starts, truck, ways, high, max_lane_changes, speeds)
        for a, b in pairwise(bounds)
    ]
    pool = StartGoalPool(
        *(np.concatenate([getattr(p, f.name) for p in pools]) for f in fields(StartGoalPool))
    )
    node = np.flatnonzero(drivable).astype(np.int32)
    return replace(pool, start=node[pool.start], goal=node[pool.goal])


def lane_change_length(regime: Regime) -> float:
    """Metres along the road that a lane change takes at least in this regime."""
    return max(SHORTEST_LANE_CHANGE, LANE_CHANGE_TIME * regime.base_speed)


def _sample_starts(graph: LaneGraph, rng: np.random.Generator) -> np.ndarray:
    """[Q] one node per `START_SPACING` metres, at random offsets, in rising order."""
    nodes = len(graph.node_lane)
    count = int(np.ceil(nodes / START_SPACING))
    starts = (np.arange(count) + rng.random(count)) * START_SPACING
    return np.minimum(starts, nodes - 1).astype(np.int64)


def _goals(
    graph: LaneGraph, labels: Labels, low: float, high: float, speeds: np.ndarray, rng: np.random.Generator
) -> StartGoalPool:
    """A random goal per label among the nodes of its lane at a path length of ``low`` to ``high`` metres."""
    spacing = graph.spacing[labels.node]
    rest = graph.lane_end[labels.node] - labels.node
    nearest = np.maximum(np.ceil((low - labels.length) / spacing), 0.0)
    farthest = np.minimum(np.floor((high - labels.length) / spacing), rest)
    drawn = nearest + np.floor(rng.random(len(rest)) * (farthest - nearest + 1.0))
    goal = labels.node + np.clip(drawn, 0, rest).astype(np.int64)
    length = labels.length + graph.along[goal] - graph.along[labels.node]
    chosen = np.flatnonzero((nearest <= farthest) & (length >= low) & (length <= high))
    return StartGoalPool(
        start=labels.start[chosen].astype(np.int32),
        goal=goal[chosen].astype(np.int32),
        path_length=length[chosen].astype(np.float32),
        lane_changes=labels.change[chosen].astype(np.int8),
        truck=labels.truck[chosen],
        start_speed=labels.speed[chosen].astype(np.float32),
        goal_speed=speeds[goal[chosen]].astype(np.float32),
    )
