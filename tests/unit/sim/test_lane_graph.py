"""The lane graph: nodes every metre, links along and across, what is known at a node."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import Lane, LaneNetwork
from tests.helpers.straight_road import straight_network

W = 3.6


def lane(name: str, points: list[tuple[float, float]], **values: Any) -> Lane:
    line = np.array(points, float)
    run = float(np.hypot(*np.diff(line, axis=0).T).sum())
    values = {"length": run} | values
    return Lane(name, name, line, W, 30.0, **values)


def arc(radius: float, angle: float, start: float = 0.0) -> list[tuple[float, float]]:
    """Points every metre or so on a left-hand arc about (0, 0)."""
    turn = np.linspace(start, start + angle, max(2, round(radius * angle)) + 1)
    return list(zip(radius * np.cos(turn), radius * np.sin(turn), strict=True))


def graph_of(lanes: list[Lane], *successors: tuple[int, int]) -> LaneGraph:
    return build_lane_graph(LaneNetwork("small", tuple(lanes), successors))


def test_nodes_are_a_metre_apart_and_linked_in_order():
    graph = build_lane_graph(straight_network(lanes=2, length=100.0))
    assert len(graph.node_lane) == 2 * 101
    np.testing.assert_allclose(graph.node_xy[:101, 0], np.arange(101))
    np.testing.assert_array_equal(graph.successor[:100, 0], np.arange(1, 101))
    assert graph.successor[100].tolist() == [-1] * 4
    np.testing.assert_allclose(graph.step[:100], np.tile([1.0, 0.0, 0.0, 0.0], (100, 1)))
    np.testing.assert_allclose(graph.node_yaw, 0.0)
    np.testing.assert_allclose(graph.node_curvature, 0.0)


def test_nodes_abreast_on_a_straight_road():
    graph = build_lane_graph(straight_network(lanes=3, length=100.0))
    node = np.arange(101)
    np.testing.assert_array_equal(graph.left[:101], node + 101)
    np.testing.assert_array_equal(graph.right[:101], -1)
    np.testing.assert_array_equal(graph.right[202:], node + 101)
    np.testing.assert_array_equal(graph.left[202:], -1)


def test_lane_position_scales_with_the_length_that_sumo_states():
    graph = graph_of([lane("a", [(0, 0), (100, 0)], length=120.0)])
    np.testing.assert_allclose(graph.node_position, 1.2 * np.arange(101), rtol=1e-6)


def test_lane_position_follows_the_positions_given_per_point():
    given = lane("a", [(0, 0), (50, 0), (100, 0)], positions=np.array([0.0, 60.0, 100.0]))
    position = graph_of([given]).node_position
    np.testing.assert_allclose(position[[0, 25, 50, 75, 100]], [0, 30, 60, 80, 100])


def test_a_coinciding_start_is_not_doubled():
    graph = graph_of([lane("a", [(0, 0), (50, 0)]), lane("b", [(50, 0), (80, 0)])], (0, 1))
    np.testing.assert_allclose(graph.node_xy[:, 0], np.arange(81))
    assert graph.successor[50, 0] == 51
    assert graph.node_lane[50] == 0
    assert graph.node_lane[51] == 1
    assert graph.node_position[51] == pytest.approx(1.0)


def test_a_lane_shorter_than_a_metre_keeps_the_chain():
    lanes = [lane("a", [(0, 0), (50, 0)]), lane("b", [(50, 0), (50.4, 0)]), lane("c", [(50.4, 0), (80.4, 0)])]
    graph = graph_of(lanes, (0, 1), (1, 2))
    node, x = 0, [0.0]
    while graph.successor[node, 0] >= 0:
        node = graph.successor[node, 0]
        x.append(float(graph.node_xy[node, 0]))
    assert x[-1] == pytest.approx(80.4)
    assert np.diff(x).min() > 0
    assert set(graph.node_lane) == {0, 1, 2}


def test_yaw_and_curvature_on_an_arc():
    left = lane("left", arc(200.0, 0.5))
    right = lane("right", arc(150.0, 0.5)[::-1])
    graph = graph_of([left, right])
    inner = np.concatenate([np.arange(30, 70), np.arange(101 + 30, 101 + 45)])
    expected = np.where(inner < 101, 1 / 200, -1 / 150)
    np.testing.assert_allclose(graph.node_curvature[inner], expected, rtol=0.02)
    x, y = graph.node_xy[50]
    assert graph.node_yaw[50] == pytest.approx(np.arctan2(y, x) + np.pi / 2, abs=1e-3)


def test_a_fork_lists_the_straight_branch_first():
    lanes = [
        lane("a", [(0, 0), (60, 0)]),
        lane("exit", [(60, 0), (100, -20)]),
        lane("on", [(60, 0), (120, 0)]),
    ]
    graph = graph_of(lanes, (0, 1), (0, 2))
    end = int(np.flatnonzero(graph.node_lane == 0)[-1])
    straight, exit_, *rest = graph.successor[end]
    assert graph.node_lane[straight] == 2
    assert graph.node_lane[exit_] == 1
    assert rest == [-1, -1]


def test_upstream_is_the_longest_way_back_and_capped():
    lanes = [lane("a", [(0, 0), (80, 0)]), lane("b", [(40, -5), (80, 0)]), lane("c", [(80, 0), (120, 0)])]
    graph = graph_of(lanes, (0, 2), (1, 2))
    of_lane = [graph.node_upstream[graph.node_lane == k] for k in range(3)]
    assert of_lane[0][30] == pytest.approx(30.0)
    assert of_lane[0][80] == pytest.approx(60.0)
    assert of_lane[1][-1] == pytest.approx(np.hypot(40, 5), abs=0.01)
    np.testing.assert_allclose(of_lane[2], 60.0)


def test_trucks_are_marked_lane_by_lane():
    graph = graph_of(
        [lane("a", [(0, 0), (10, 0)]), lane("b", [(10, 0), (20, 0)], allows_truck=False)], (0, 1)
    )
    np.testing.assert_array_equal(graph.node_truck, graph.node_lane == 0)


def test_lanes_that_drift_apart_stop_being_abreast():
    lanes = [lane("a", [(0, 0), (100, 0)], left=1), lane("b", [(0, W), (100, W + 10)], right=0)]
    graph = graph_of(lanes)
    gap = W + 0.1 * np.arange(101)
    clear = np.abs(gap - 1.75 * W) > 0.15
    np.testing.assert_array_equal((graph.left[:101] >= 0)[clear], (gap < 1.75 * W)[clear])


def test_abreast_on_a_curve_means_the_same_bearing():
    inner, outer = lane("in", arc(100.0, 1.0), right=1), lane("out", arc(100.0 + W, 1.0), left=0)
    graph = graph_of([inner, outer])
    bearing = np.arctan2(graph.node_xy[:, 1], graph.node_xy[:, 0])
    for side in (graph.left, graph.right):
        node = np.flatnonzero(side >= 0)
        assert len(node) > 90
        assert np.abs(bearing[side[node]] - bearing[node]).max() < 0.6 / 100.0


def test_only_the_common_stretch_of_two_lanes_is_abreast():
    lanes = [lane("long", [(0, 0), (100, 0)], left=1), lane("short", [(30, W), (70, W)], right=0)]
    graph = graph_of(lanes)
    beside = graph.left[:101]
    np.testing.assert_array_equal(np.flatnonzero(beside >= 0), np.arange(29, 72))
    inner = np.arange(30, 71)
    np.testing.assert_allclose(graph.node_xy[beside[inner], 0], graph.node_xy[inner, 0])
    np.testing.assert_array_equal(graph.right[101:], np.arange(30, 71))


def test_lanes_of_unequal_length_are_abreast_where_they_are_nearest():
    """One lane is digitised with a bend at its end: equal shares of length would be metres apart."""
    bent = [(0.0, 0.0), (200.0, 0.0), (203.0, -12.0)]
    graph = graph_of([lane("bent", bent, left=1), lane("straight", [(0, W), (200, W)], right=0)])
    node = np.flatnonzero(graph.left[graph.node_lane == 0] >= 0)
    assert {*range(200)} <= set(node.tolist())
    apart = graph.node_xy[graph.left[node[:200]], 0] - graph.node_xy[node[:200], 0]
    assert np.abs(apart).max() <= 0.51
