"""Every pair of the pool against a slow search: metre by metre, start by start, in plain Python.

The slow search knows only the links of the lane graph and what a lane change is: from a node to the one
abreast, then along the new lane for the regime's lane-change length, over nodes that may be changed into.
Pairs must exist there with their lane-change count, path length and truck permission (soundness), and the
lanes and counts that it finds must be in the pool (coverage).
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumo

from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import REGIMES, Regime
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.pool import TIGHTEST, TRUCK_UPSTREAM, StartGoalPool, build_pool, lane_change_length
from tests.helpers.places import ROOT, SHARED

W = 3.6
BUDGET = 3
BUCKET = 0.5  # m: paths to one node whose lengths differ by less are one to the slow search
TOLERANCE = 1.0  # m between the stored path length and one that the slow search finds
COVERED = 0.98  # share of (start, lane, lane changes) groups that must be in the pool
INSIDE = 2.0  # m: groups that reach no further into the path bounds than this are not asked for

SHIPPED = sorted((ROOT / "networks").rglob("*.net.xml"))
REAL = sorted((SHARED / "nets").rglob("*.net.xml"))
A10 = Path(sumo.SUMO_HOME) / "tools" / "game" / "A10KW" / "osm.net.xml"
MOST_STARTS = 400  # of a large network


class SlowSearch:
    """All (node, lane changes) from one start with the lengths of the paths there."""

    def __init__(self, graph: LaneGraph, regime: Regime, trucks: bool) -> None:
        self.ahead = [
            [(int(b), float(d)) for b, d in zip(nodes, steps, strict=True) if b >= 0]
            for nodes, steps in zip(graph.successor, graph.step, strict=True)
        ]
        self.sides = ((graph.left.tolist(), -1), (graph.right.tolist(), +1))
        drivable = graph.bend <= TIGHTEST
        self.allowed = (drivable & (graph.node_truck | (not trucks))).tolist()
        self.longest, self.reach = regime.path_bounds[1], lane_change_length(regime)
        self.open = tuple(self._open(side) for side, _ in self.sides)
        self.landings = cache(self._landings)

    def _open(self, side: list[int]) -> set[int]:
        """Nodes that may be changed into; on curves one between two of them may have no partner."""
        found = {b for b in side if b >= 0}
        return found | {b for a in found for b, _ in self.ahead[a][:1]}

    def _landings(self, node: int, which: int) -> list[tuple[int, float]]:
        """Nodes where a change ends that enters the lane beside at ``node``, and metres to there."""
        found, waiting = [], [(node, 0.0)]
        while waiting:
            at, length = waiting.pop()
            if at in self.open[which] and self.allowed[at]:
                if length >= self.reach - 0.1:
                    found.append((at, length))
                else:
                    waiting += [(b, length + step) for b, step in self.ahead[at]]
        return found

    def __call__(self, start: int) -> dict[tuple[int, int], list[float]]:
        found: dict[tuple[int, int], list[float]] = {}
        seen: set[tuple[int, int, int]] = set()
        waiting = deque([(start, 0, 0.0)] if self.allowed[start] else [])
        while waiting:
            node, change, length = waiting.popleft()
            state = (node, change, round(length / BUCKET))
            if length > self.longest + BUCKET or abs(change) > BUDGET or state in seen:
                continue
            seen.add(state)
            found.setdefault((node, change), []).append(length)
            waiting += [(b, change, length + step) for b, step in self.ahead[node] if self.allowed[b]]
            for which, (side, sign) in enumerate(self.sides):
                if side[node] >= 0:
                    landings = self.landings(side[node], which)
                    waiting += [(b, change + sign, length + run) for b, run in landings]
        return found


def check(graph: LaneGraph, regime: Regime) -> tuple[StartGoalPool, float]:
    """The pool, every pair of it verified, and the share of groups covered."""
    pool = build_pool(graph, regime, BUDGET)
    low, high = regime.path_bounds
    for array in pool.arrays().values():
        assert np.isfinite(array).all()
    assert ((pool.path_length >= low) & (pool.path_length <= high)).all()
    assert (graph.node_upstream[pool.start[pool.truck]] >= TRUCK_UPSTREAM).all()
    any_vehicle, trucks = SlowSearch(graph, regime, False), SlowSearch(graph, regime, True)
    asked = covered = 0
    starts = np.unique(pool.start)
    if not len(starts):
        return pool, 1.0
    order = np.argsort(pool.start, kind="stable")
    rows_of = dict(
        zip(starts.tolist(), np.split(order, np.searchsorted(pool.start[order], starts)[1:]), strict=True)
    )
    for start in starts[:: max(1, len(starts) // MOST_STARTS)].tolist():
        rows = rows_of[start]
        ways, truck_ways = any_vehicle(start), trucks(start) if pool.truck[rows].any() else {}
        for row in rows.tolist():
            goal, change = int(pool.goal[row]), int(pool.lane_changes[row])
            for found in (ways, truck_ways) if pool.truck[row] else (ways,):
                lengths = found.get((goal, change), [])
                assert any(abs(length - pool.path_length[row]) < TOLERANCE for length in lengths), (
                    f"{start} -> {goal}, c = {change}: {pool.path_length[row]:.2f} m, found {lengths}"
                )
        wanted = {
            (int(graph.node_lane[node]), change)
            for (node, change), lengths in ways.items()
            if any(low + INSIDE <= length <= high - INSIDE for length in lengths)
        }
        pairs = zip(graph.node_lane[pool.goal[rows]].tolist(), pool.lane_changes[rows].tolist(), strict=True)
        asked, covered = asked + len(wanted), covered + len(wanted & set(pairs))
    return pool, covered / max(asked, 1)


# --- roads that have everything a search can stumble over ------------------------------------------------


def lane(name: str, points: Any, **values: Any) -> Lane:
    line = np.array(points, float)
    return Lane(name, name, line, W, 30.0, float(np.hypot(*np.diff(line, axis=0).T).sum()), **values)


def arc(radius: float, begin: float, end: float) -> np.ndarray:
    turn = np.linspace(begin, end, max(2, round(radius * abs(end - begin))) + 1)
    return radius * np.stack((np.cos(turn), np.sin(turn)), -1)


def ramp_and_fork() -> LaneNetwork:
    """Two lanes, an on-ramp with an acceleration lane, a fork to the right, trucks not everywhere."""
    lanes = (
        lane("before_0", [(0, 0), (100, 0)], left=1),
        lane("before_1", [(0, W), (100, W)], right=0, allows_truck=False),
        lane("ramp", [(10, -30), (60, -12), (100, -W)]),
        lane("merge_0", [(100, -W), (220, -W)], left=4, dead_end=True),
        lane("merge_1", [(100, 0), (220, 0)], left=5, right=3),
        lane("merge_2", [(100, W), (220, W)], right=4, allows_truck=False),
        lane("after_0", [(220, 0), (300, 0)], left=7),
        lane("after_1", [(220, W), (300, W)], right=6),
        lane("on_0", [(300, 0), (500, 0)], left=9),
        lane("on_1", [(300, W), (500, W)], right=8),
        lane("exit", [(300, 0), (340, -5), (500, -40)]),
    )
    successors = ((0, 4), (1, 5), (2, 3), (4, 6), (5, 7), (6, 8), (7, 9), (6, 10))
    return LaneNetwork("ramp", lanes, successors)


def short_pieces() -> LaneNetwork:
    """Three lanes cut into pieces of 4 to 25 m, so that a lane change crosses many of them."""
    cuts = np.cumsum([0.0, 25, 4, 11.3, 7.7, 20, 5, 18, 9, 25, 25, 4, 16, 25, 12, 25, 25, 25, 25, 25])
    lanes, successors = [], []
    for piece, (a, b) in enumerate(pairwise(cuts)):
        for k in range(3):
            own = len(lanes)
            beside = {"left": own + 1 if k < 2 else -1, "right": own - 1 if k else -1}
            lanes.append(lane(f"p{piece}_{k}", [(a, k * W), (b, k * W)], **beside))
            if piece:
                successors.append((own - 3, own))
    return LaneNetwork("pieces", tuple(lanes), tuple(successors))


def roundabout() -> LaneNetwork:
    """A ring of 75 m with an entry and an exit: paths could go round and round."""
    ring = [lane(f"ring{k}", arc(12.0, 0.5 * np.pi * k, 0.5 * np.pi * (k + 1))) for k in range(4)]
    ends = [lane("in", [(12, -90), (12, -4), (12, 0)]), lane("out", [(-12, 0), (-12, -3), (-14, -90)])]
    return LaneNetwork("roundabout", (*ring, *ends), ((0, 1), (1, 2), (2, 3), (3, 0), (4, 0), (1, 5)))


def by_pass() -> LaneNetwork:
    """A fork whose branches join again after 100 and 150 m."""
    lanes = (
        lane("a", [(0, 0), (80, 0)]),
        lane("short", [(80, 0), (180, 0)]),
        lane("long", [(80, 0), (95, -25), (112, -48), (148, -48), (165, -25), (180, 0)]),
        lane("b", [(180, 0), (300, 0)]),
    )
    return LaneNetwork("by-pass", lanes, ((0, 1), (0, 2), (1, 3), (2, 3)))


def curve(radius: float = 200.0) -> LaneNetwork:
    """Four lanes abreast on a curve, the outer ones longer."""
    lanes = []
    for k in range(4):
        line = arc(radius + k * W, 0.0, 160.0 / radius)
        lanes.append(lane(f"c{k}", line, left=k - 1 if k else -1, right=k + 1 if k < 3 else -1))
    return LaneNetwork("curve", tuple(lanes), ())


def tight_curve() -> LaneNetwork:
    """The outermost lane is a quarter longer; too tight for all but jammed traffic."""
    return curve(40.0)


@pytest.mark.parametrize("regime", REGIMES[:3], ids=lambda regime: regime.name)
@pytest.mark.parametrize("road", [ramp_and_fork, short_pieces, roundabout, by_pass, curve, tight_curve])
def test_every_pair_is_reachable_and_every_lane_covered(road, regime):
    pool, covered = check(build_lane_graph(road()), regime)
    assert len(pool.start) or road in (roundabout, tight_curve) or regime.path_bounds[0] > 70
    assert covered >= COVERED


def test_every_branch_of_a_fork_is_reached_also_by_a_lane_change_across_it():
    network = ramp_and_fork()
    names = [lane.id for lane in network.lanes]
    graph = build_lane_graph(network)
    pool = build_pool(graph, REGIMES[0], BUDGET)
    found = {(names[graph.node_lane[g]], int(c)) for g, c in zip(pool.goal, pool.lane_changes, strict=True)}
    assert {("exit", 0), ("exit", 1), ("on_0", 1), ("on_1", -1), ("merge_1", -1)} <= found


def test_both_ways_round_are_found_where_their_lengths_differ():
    network = by_pass()
    graph = build_lane_graph(network)
    pool = build_pool(graph, replace(REGIMES[2], base_speed=1.0), BUDGET)  # slow enough for the corners
    chosen = (graph.node_lane[pool.start] == 0) & (graph.node_lane[pool.goal] == 3)
    straight = graph.node_xy[pool.goal[chosen], 0] - graph.node_xy[pool.start[chosen], 0]
    longer = pool.path_length[chosen] - straight
    assert ((longer < 1).any(), (longer > 30).any()) == (True, True)


def real_graph(path: Path) -> LaneGraph:
    if not path.is_file():
        pytest.skip(f"{path.name} is not part of this installation")
    return build_lane_graph(read_network(path))


@pytest.mark.parametrize("regime", REGIMES[:2], ids=lambda regime: regime.name)
def test_a_weaving_section(regime):
    _, covered = check(real_graph(ROOT / "networks" / "f06_weave3.net.xml"), regime)
    assert covered >= COVERED


@pytest.mark.slow
@pytest.mark.parametrize("regime", REGIMES, ids=lambda regime: regime.name)
@pytest.mark.parametrize("path", [*SHIPPED, *REAL, A10], ids=lambda path: path.name.split(".")[0])
def test_real_and_shipped_networks(path, regime):
    graph = real_graph(path)
    pool, covered = check(graph, regime)
    if (graph.bend <= TIGHTEST).mean() > 0.9:
        assert len(pool.start) > 100
    assert covered >= COVERED
