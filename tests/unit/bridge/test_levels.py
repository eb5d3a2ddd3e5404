"""Roads on different levels are told apart by how lanes are connected, whatever the angle."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.maps.convert import flat_stretches
from phase_sumo.bridge.maps.levels import Levels
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.road_map import RoadKind

WIDTH = 3.6


def lane(name: str, points, start: str = "", end: str = "") -> Lane:
    line = np.array(points, np.float64)
    length = float(np.hypot(*np.diff(line, axis=0).T).sum())
    return Lane(f"{name}_0", name, line, WIDTH, 30.0, length, start=start, end=end)


def crossing(degrees: float) -> LaneNetwork:
    """Two roads of 600 m whose middles lie over each other at the origin."""
    turn = np.radians(degrees)
    over = 300.0 * np.array([np.cos(turn), np.sin(turn)])
    lanes = lane("lower", [(-300, 0), (300, 0)], "a", "b"), lane("upper", [-over, over], "c", "d")
    return LaneNetwork("crossing", lanes, ())


def loop() -> LaneNetwork:
    """A ramp that leaves a road at x = 0, turns round and crosses over it at x = 76."""
    angle = np.linspace(-0.5 * np.pi, 0.75 * np.pi, 60)
    circle = np.stack((100 + 80 * np.cos(angle), -100 + 80 * np.sin(angle)), -1)
    ramp = np.concatenate(([(0, 0), (30, -10), (70, -170)], circle, [(300, 300)]))
    lanes = (
        lane("before", [(-300, 0), (0, 0)], "a", "j"),
        lane("after", [(0, 0), (600, 0)], "j", "b"),
        lane("ramp", ramp, "j", "c"),
    )
    return LaneNetwork("loop", lanes, ((0, 1), (0, 2)))


def pieces(levels: Levels, *places: tuple[int, float]) -> list[np.ndarray]:
    """Of places given as lane and share of its length."""
    return [levels.piece(np.array([i]), np.array([share])) for i, share in places]


@pytest.mark.parametrize("degrees", [5, 30, 60, 90, 150, 178])
def test_roads_that_cross_without_a_junction_have_nothing_to_do_with_each_other(degrees):
    network = crossing(degrees)
    levels = Levels(network)
    lower, upper = pieces(levels, (0, 0.5), (1, 0.5))
    assert not levels.touching(lower, upper).any()
    assert not levels.seen(lower, upper).any()
    assert levels.touching(lower, lower).all() and levels.seen(lower, lower).all()
    layer, drawn = levels.layers
    assert {int(layer[lower[0]]), int(layer[upper[0]])} == {0, 1}
    assert len(drawn) == 2
    assert levels.crossing[lower].all() and levels.crossing[upper].all()


@pytest.mark.parametrize("degrees", [20, 60, 90, 160])
def test_each_level_has_its_own_road_edges_throughout(degrees):
    road = Road(crossing(degrees))
    for i in range(2):
        nodes = np.arange(road.first[i] + 5, road.first[i] + road.count[i] - 5)
        xy, layer = road.graph.node_xy[nodes], torch.from_numpy(road.layer[nodes])
        cell = road.map.cell(layer, *(torch.from_numpy(v) for v in xy.T))
        ax, ay, bx, by, kind = (v.numpy() for v in road.map.borders_at(cell))
        normal = np.stack((-np.sin(road.graph.node_yaw[nodes]), np.cos(road.graph.node_yaw[nodes])), -1)
        a = np.stack((ax, ay), -1) - xy[:, None]
        b = np.stack((bx, by), -1) - xy[:, None]
        across = np.sort(np.where(kind == RoadKind.ROAD_EDGE, ((a + b) / 2 * normal[:, None]).sum(-1), 99.0))
        # nothing lies on the way, and both borders are beside it, under and over the other road, too
        along = np.abs(((b - a) * normal[:, None]).sum(-1))
        assert (np.where(kind == RoadKind.ROAD_EDGE, along, 0.0) < 0.1).all()
        assert np.abs(across[:, 0] + WIDTH / 2).max() < 0.1
        assert (np.abs(across - WIDTH / 2) < 0.1).any(1).all()


@pytest.mark.parametrize("degrees", [20, 60, 160])
def test_who_is_lost_is_looked_for_on_the_own_level(degrees):
    road = Road(crossing(degrees))
    there = int(road.first[0] + 300)
    yaw = np.array([np.radians(degrees)])  # it points along the other road, over which it is
    x, y = 3.0 * np.cos(yaw), 3.0 * np.sin(yaw)
    node, _ = road.track(np.array([there]), x, y, yaw)
    assert node[0] < 0 or road.graph.node_lane[node[0]] == 0
    upper = road.levels.of_lane("upper_0", 300.0)
    node, _ = road.track(np.array([-1]), x, y, yaw, np.array([upper]))
    assert road.graph.node_lane[node[0]] == 1


def test_a_ramp_touches_its_road_where_they_part_and_not_where_it_crosses_over():
    levels = Levels(loop())
    road, ramp, far = pieces(levels, (1, 0.02), (2, 0.02), (2, 0.95))
    assert levels.touching(road, ramp).all() and levels.seen(road, ramp).all()
    under, over = pieces(levels, (1, 76 / 600), (2, 0.6))
    assert not levels.touching(under, over).any() and not levels.seen(under, over).any()
    assert levels.crossing[under].all() and not levels.crossing[far].any()


def test_the_two_directions_of_a_road_touch_and_do_not_look_for_each_other():
    lanes = (
        lane("on", [(0, 0), (900, 0)], "a", "b"),
        lane("back", [(900, 3.6), (0, 3.6)], "b", "a"),
    )
    levels = Levels(LaneNetwork("two ways", lanes, ()))
    on, back = pieces(levels, (0, 0.5), (1, 0.5))
    assert levels.touching(on, back).all() and not levels.seen(on, back).any()
    assert not levels.crossing.any()


def test_places_of_lanes_in_sumos_words():
    levels = Levels(crossing(90.0))
    assert levels.of_lane("lower_0", 300.0) == pieces(levels, (0, 0.5))[0][0]
    assert levels.of_lane("elsewhere_0", 1.0) == -1


def test_maps_for_training_hold_one_level_each():
    parts = flat_stretches(crossing(40.0), 0.0)
    assert len({part.name for part in parts}) == len(parts) == 2
    assert [len(Levels(part).layers[1]) for part in parts] == [1, 1]
    metres = sum(float(np.hypot(*np.diff(v.points, axis=0).T).sum()) for p in parts for v in p.lanes)
    assert metres == pytest.approx(1200.0)
    (alone,) = flat_stretches(LaneNetwork("one", (lane("a", [(0, 0), (300, 0)]),), ()), 0.0)
    assert alone.name == "one"
