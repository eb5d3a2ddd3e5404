"""The start-goal pool on small roads; tests/properties/test_pool_search.py checks every single pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import POOLS, REGIMES, Regime
from phase_sumo.sim.curve_speed import BRAKING, FASTEST, SIDEWAYS, WINDOW
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.pool import (
    GOALS_PER_GROUP,
    TRUCK_UPSTREAM,
    StartGoalPool,
    build_pool,
    lane_change_length,
)
from phase_sumo.sim.synthetic_road import freeway
from tests.helpers.small_nets import SmallNet, lanes_from
from tests.helpers.straight_road import straight_network

W = 3.6
JAMMED, DENSE = REGIMES[:2]
BUDGET = 2
State = tuple[int, int]  # node, signed lane changes


def ramp_road(tmp_path, **lane_values) -> LaneGraph:
    """Two lanes with an on-ramp, an acceleration lane and, further on, a fork to the right.

    ``lane_values`` are XML attributes of the ramp and the exit.
    """
    extra = {0: lane_values} if lane_values else {}
    net = SmallNet().edge("before", lanes_from(0, 60, 0, W))
    net.edge("ramp", [[(10, -20), (40, -5), (60, -W)]], extra)
    net.edge("merge", lanes_from(60, 120, -W, 0, W), {0: {"acceleration": "1"}})
    net.edge("after", lanes_from(120, 160, 0, W))
    net.edge("on", lanes_from(160, 220, 0, W)).edge("exit", [[(160, 0), (220, -12)]], extra)
    net.connect("before", "merge", (0, 1), (1, 2)).connect("ramp", "merge", (0, 0))
    net.connect("merge", "after", (1, 0), (2, 1)).connect("after", "on", (0, 0), (1, 1))
    net.connect("after", "exit", (0, 0))
    return build_lane_graph(read_network(net.write(tmp_path / "ramp.net.xml")))


def reachable(graph: LaneGraph, start: int, longest: float, trucks: bool) -> dict[State, tuple[float, float]]:
    """Shortest and longest way to every (node, lane changes); sideways steps are free and always allowed."""
    found: dict[State, tuple[float, float]] = {}
    waiting: list[tuple[State, float]] = [((start, 0), 0.0)]
    while waiting:
        (node, change), length = waiting.pop()
        low, high = found.get((node, change), (np.inf, -np.inf))
        if length > longest or abs(change) > BUDGET or (low - 1e-3 <= length <= high + 1e-3):
            continue
        if trucks and not graph.node_truck[node]:
            continue
        found[node, change] = (min(low, length), max(high, length))
        for ahead, step in zip(graph.successor[node], graph.step[node], strict=True):
            if ahead >= 0:
                waiting.append(((int(ahead), change), length + float(step)))
        for side, sign in ((graph.left, -1), (graph.right, 1)):
            if side[node] >= 0:
                waiting.append(((int(side[node]), change + sign), length))
    return found


def rows_by_start(pool: StartGoalPool, count: int) -> list[np.ndarray]:
    """Row numbers of ``count`` starts spread over the pool."""
    starts = np.unique(pool.start)
    return [np.flatnonzero(pool.start == s) for s in starts[:: max(1, len(starts) // count)]]


@pytest.fixture(scope="module")
def ramp(tmp_path_factory) -> tuple[LaneGraph, StartGoalPool]:
    graph = ramp_road(tmp_path_factory.mktemp("ramp"))
    return graph, build_pool(graph, JAMMED, BUDGET)


def test_every_pair_is_reachable_within_the_bounds(ramp):
    graph, pool = ramp
    low, high = JAMMED.path_bounds
    assert low <= pool.path_length.min()
    assert pool.path_length.max() <= high
    for rows in rows_by_start(pool, 40):
        ways = reachable(graph, int(pool.start[rows[0]]), high, trucks=False)
        for row in rows:
            shortest, longest = ways[int(pool.goal[row]), int(pool.lane_changes[row])]
            assert shortest - 0.6 <= pool.path_length[row] <= longest + 0.6


def test_every_lane_reachable_without_a_lane_change_has_a_goal(ramp):
    graph, pool = ramp
    low, high = JAMMED.path_bounds
    for rows in rows_by_start(pool, 40):
        ways = reachable(graph, int(pool.start[rows[0]]), high, trucks=False)
        expected = {
            int(graph.node_lane[node])
            for (node, change), way in ways.items()
            if change == 0 and way[1] >= low
        }
        straight = rows[pool.lane_changes[rows] == 0]
        # a goal needs the lane within the bounds: the last metre at either end may differ
        assert expected == set(graph.node_lane[pool.goal[straight]].tolist())


def test_goals_on_the_exit_the_ramp_and_across_the_merge_exist(ramp):
    graph, pool = ramp
    assert (graph.node_xy[pool.goal, 1] < -8).any(), "exit"
    from_ramp = graph.node_xy[pool.start, 1] < -5
    assert (pool.lane_changes[from_ramp] == -1).any(), "leaves the acceleration lane to the left"
    assert not (pool.lane_changes[from_ramp] > 0).any()


def test_lane_changes_are_counted_to_the_right(straight_map):
    lane = straight_map.graph.node_lane  # 0 is the rightmost
    for pool in straight_map.pools:
        counted = pool.lane_changes.astype(int)
        np.testing.assert_array_equal(counted, lane[pool.start].astype(int) - lane[pool.goal])
        assert set(counted.tolist()) == {-2, -1, 0, 1, 2}


def test_a_lane_change_gets_the_room_it_needs(straight_map):
    for regime, pool in zip(POOLS, straight_map.pools, strict=True):
        needed = np.abs(pool.lane_changes) * (lane_change_length(regime) - 1.0)
        assert (pool.path_length >= needed).all()
        assert (pool.path_length[np.abs(pool.lane_changes) == 1] < 1.5 * lane_change_length(regime)).any()


def test_the_budget_of_lane_changes_is_kept():
    graph = build_lane_graph(straight_network(lanes=5, length=200.0))
    for budget in (0, 1, 3):
        changes = build_pool(graph, JAMMED, budget).lane_changes
        assert np.abs(changes).max() == budget


def test_lengths_are_spread_over_the_bounds(straight_map):
    for regime, pool in zip(REGIMES, straight_map.pools[: len(REGIMES)], strict=True):
        low, high = regime.path_bounds
        third = ((pool.path_length - low) / (high - low) * GOALS_PER_GROUP).astype(int)
        share = np.bincount(np.minimum(third, GOALS_PER_GROUP - 1)) / len(third)
        assert share.min() > 0.2


def test_trucks_stay_on_lanes_that_allow_them_and_have_room_behind(tmp_path):
    graph = ramp_road(tmp_path, disallow="truck")
    pool = build_pool(graph, JAMMED, BUDGET)
    assert pool.truck.any()
    assert (graph.node_upstream[pool.start[pool.truck]] >= TRUCK_UPSTREAM).all()
    for rows in rows_by_start(pool, 20):
        start = int(pool.start[rows[0]])
        ways = reachable(graph, start, JAMMED.path_bounds[1], trucks=True)
        for row in rows[pool.truck[rows]]:
            assert (int(pool.goal[row]), int(pool.lane_changes[row])) in ways
        fits = graph.node_upstream[start] >= TRUCK_UPSTREAM
        straight = rows[(pool.lane_changes[rows] == 0)]
        open_to_trucks = [(int(g), 0) in ways for g in pool.goal[straight]]
        np.testing.assert_array_equal(pool.truck[straight], np.array(open_to_trucks) & fits)


def test_the_same_seed_gives_the_same_pool():
    graph = build_lane_graph(straight_network(lanes=2, length=150.0))
    first, again, other = (build_pool(graph, JAMMED, seed=seed) for seed in (3, 3, 4))
    for name, array in first.arrays().items():
        np.testing.assert_array_equal(array, again.arrays()[name])
    assert not np.array_equal(first.goal, other.goal)


def test_a_road_too_short_for_the_regime_has_an_empty_pool():
    graph = build_lane_graph(straight_network(lanes=2, length=60.0))
    long_ways: Regime = replace(JAMMED, path_bounds=(80.0, 120.0))
    pool = build_pool(graph, long_ways)
    assert len(pool.start) == 0
    assert pool.arrays()["truck"].dtype == bool


def test_as_many_pairs_per_lane_km_on_long_roads_as_on_short_ones():
    graphs = [build_lane_graph(freeway(lane_km)) for lane_km in (30, 90)]
    for regime in REGIMES:
        few, many = (len(build_pool(g, regime).start) / len(g.node_lane) for g in graphs)
        assert few == pytest.approx(many, rel=0.05)


@pytest.mark.parametrize("length", [0.5, 2.0, 100.0])
def test_a_lone_lane_however_short_has_a_pool(length):
    pool = build_pool(build_lane_graph(straight_network(lanes=1, length=length)), JAMMED)
    assert (len(pool.start) > 0) == (length > JAMMED.path_bounds[0])


def bend(radius: float, turn: float = np.pi / 2) -> LaneGraph:
    """200 m straight, an arc, 200 m straight; the straight before it is a lane of its own."""
    angle = np.linspace(0.0, turn, 60)
    arc = radius * np.stack((np.sin(angle), 1.0 - np.cos(angle)), -1)
    end = arc[-1] + 200.0 * np.array([np.cos(turn), np.sin(turn)])
    shapes = {"a": np.array([[-200.0, 0.0], [-20.0, 0.0]])}
    shapes["b"] = np.concatenate(([[-20.0, 0.0]], arc, [end]))
    lanes = tuple(
        Lane(f"{edge}_0", edge, xy, 3.6, 30.0, float(np.hypot(*np.diff(xy, axis=0).T).sum()))
        for edge, xy in shapes.items()
    )
    return build_lane_graph(LaneNetwork("bend", lanes, ((0, 1),)))


def test_no_path_leads_over_a_bend_that_nobody_can_drive():
    for radius, driven in ((8.0, False), (15.0, True), (80.0, True)):
        graph = bend(radius, np.pi)
        pool = build_pool(graph, JAMMED)
        assert len(pool.start) > 50
        middle = np.linalg.norm(graph.node_xy - radius, axis=1).argmin()
        assert ((pool.start <= middle) & (pool.goal >= middle)).any() == driven


@pytest.mark.parametrize("regime", [JAMMED, DENSE], ids=lambda regime: regime.name)
@pytest.mark.parametrize("radius", [20.0, 80.0])
def test_pairs_know_from_which_speed_their_curves_can_be_braked_for(radius, regime):
    graph = bend(radius)
    pool = build_pool(graph, regime)
    xy = graph.node_xy.astype(float)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T)))  # one lane goes on from the other
    in_curve = np.minimum(np.sqrt(SIDEWAYS / np.maximum(np.abs(graph.curvature(WINDOW)), 1e-9)), FASTEST)

    def slowest(first: int, last: int) -> float:
        """From the curves between two nodes, each braked for by itself."""
        way = along[first : last + 1] - along[first]
        return float(np.sqrt(in_curve[first : last + 1] ** 2 + 2.0 * BRAKING * way).min())

    ends = graph.lane_end[pool.goal]
    assert (pool.goal > graph.lane_end[pool.start]).any()  # a curve behind the end of the lane counts
    for node, speed in ((pool.start, pool.start_speed), (pool.goal, pool.goal_speed)):
        wanted = [slowest(a, b) for a, b in zip(node.tolist(), ends.tolist(), strict=True)]
        assert min(wanted) < 1.05 * np.sqrt(SIDEWAYS * radius) and max(wanted) == FASTEST
        assert speed == pytest.approx(np.array(wanted), rel=1e-4)
