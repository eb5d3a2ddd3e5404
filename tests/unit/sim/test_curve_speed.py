"""Speeds for the curves ahead, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.sim.curve_speed import BRAKING, FASTEST, LONGEST, WINDOW, exit_speeds, lane_speeds
from phase_sumo.sim.lane_graph import build_lane_graph
from phase_sumo.sim.lanes import Lane, LaneNetwork

RADIUS = 60.0


def graph_of(points: np.ndarray):
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    lane = Lane("main_0", "main", points, 3.5, 30.0, length)
    return build_lane_graph(LaneNetwork("small", (lane,), ()))


def straight_then_curve():
    """300 m straight, then half a circle."""
    turn = np.linspace(0.0, np.pi, 400)
    arc = np.stack((300.0 + RADIUS * np.sin(turn), RADIUS * (1.0 - np.cos(turn))), -1)
    return graph_of(np.concatenate(([[0.0, 0.0]], arc)))


def test_the_curve_itself_is_driven_with_the_given_force():
    graph = straight_then_curve()
    speed = lane_speeds(graph, 3.0)
    within = (graph.node_xy[:, 0] > 300.0 + 0.5 * RADIUS) & (np.abs(graph.node_xy[:, 1] - RADIUS) < 30.0)
    assert speed[within] == pytest.approx(np.sqrt(3.0 * RADIUS), rel=0.02)
    assert lane_speeds(graph, 2.0)[within] == pytest.approx(np.sqrt(2.0 * RADIUS), rel=0.02)


def test_it_is_approached_with_even_braking():
    graph = straight_then_curve()
    speed = lane_speeds(graph, 3.0)
    x = graph.node_xy[:, 0].astype(float)
    straight = np.flatnonzero((graph.node_xy[:, 1] < 0.01) & (x > 100.0) & (x < 300.0 - 2 * WINDOW))
    lost = -np.diff(speed[straight] ** 2) / np.diff(x[straight])
    assert lost == pytest.approx(2.0 * BRAKING, rel=1e-3)


def test_a_straight_road_slows_nobody():
    assert (lane_speeds(graph_of(np.array([[0.0, 0.0], [500.0, 0.0]])), 3.0) == FASTEST).all()


def test_a_kink_counts_as_an_arc_as_long_as_the_window():
    angle = 0.4
    end = [200.0 + 200.0 * np.cos(angle), 200.0 * np.sin(angle)]
    speed = lane_speeds(graph_of(np.array([[0.0, 0.0], [200.0, 0.0], end])), 3.0)
    assert speed.min() == pytest.approx(np.sqrt(3.0 * 2 * WINDOW / angle), rel=0.02)


def test_the_way_on_is_braked_for_in_the_lanes_before():
    first, metres = np.array([FASTEST, FASTEST, 10.0, 5.0]), np.array([100.0, 50.0, 30.0, 30.0])
    main = exit_speeds(first, metres, np.array([1, -1, -1, -1]))
    ramp = exit_speeds(first, metres, np.array([1, 2, -1, -1]))
    assert (main == FASTEST).all()
    assert ramp[1] == 10.0
    assert ramp[0] == pytest.approx(np.sqrt(100.0 + 2 * BRAKING * 50.0))


def test_a_ring_of_lanes_settles():
    first = np.array([12.0, FASTEST])
    speed = exit_speeds(first, np.array([40.0, 40.0]), np.array([1, 0]))
    assert speed[1] == 12.0
    assert speed[0] == pytest.approx(np.sqrt(144.0 + 2 * BRAKING * 40.0))


def bent(*turns: float, every: float = 300.0):
    """Straight pieces that meet at angles in degrees."""
    yaw = np.radians(np.cumsum((0.0, *turns)))
    steps = every * np.stack((np.cos(yaw), np.sin(yaw)), -1)
    return graph_of(np.concatenate((np.zeros((1, 2)), np.cumsum(steps, 0))))


@pytest.mark.parametrize(("degrees", "slack"), [(4.0, 0.4), (5.0, 0.4), (7.0, 0.2), (7.0, 0.4)])
def test_a_slight_kink_is_cut_within_the_lane(degrees, slack):
    """An arc that is tangent w m before and behind a corner of theta passes it in w theta / 4."""
    graph = bent(degrees)
    reach = np.clip(4.0 * slack / np.radians(degrees), WINDOW, LONGEST)
    wanted = min(np.sqrt(3.0 * 2.0 * reach / np.radians(degrees)), FASTEST)
    assert lane_speeds(graph, 3.0, slack).min() == pytest.approx(wanted, rel=0.05)
    assert lane_speeds(graph, 3.0).min() == pytest.approx(np.sqrt(3.0 * 12.0 / np.radians(degrees)), rel=0.05)


def test_curves_and_sharp_kinks_are_not_cut():
    curve = straight_then_curve()
    assert lane_speeds(curve, 3.0, 0.4) == pytest.approx(lane_speeds(curve, 3.0), rel=0.02)
    for sharp in (bent(25.0), bent(25.0, -25.0, every=20.0)):
        assert lane_speeds(sharp, 3.0, 0.4) == pytest.approx(lane_speeds(sharp, 3.0), rel=0.02)
