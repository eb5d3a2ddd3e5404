"""What vehicles see at a fork, on a lane that forks into two which part slowly."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import follow_lanes, route_lanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.road_map import ABSENT, RoadKind
from tests.helpers.toy_motorway import nodes, put

IN, LEFT, RIGHT = 0, 1, 2
LENGTH = 300.0


@pytest.fixture
def road():
    """``in`` leads on to ``left`` first; the branches part by 1 m in 10."""
    shapes = {
        "in": ((0.0, 0.0), (LENGTH, 0.0)),
        "left": ((LENGTH, 0.0), (2 * LENGTH, 30.0)),
        "right": ((LENGTH, 0.0), (2 * LENGTH, -30.0)),
    }
    lanes = tuple(
        Lane(f"{edge}_0", edge, np.array(xy), 3.6, 30.0, float(np.hypot(*np.subtract(*xy))))
        for edge, xy in shapes.items()
    )
    return Road(LaneNetwork("fork", lanes, ((IN, LEFT), (IN, RIGHT))))


def centres(road: Road, row: int) -> np.ndarray:
    """[n, 2] lane centres in a row of the view."""
    x, y, _, _, kind = road.map.view[row].numpy()
    assert (kind != ABSENT).sum() > 10
    return np.stack((x, y), -1)[kind == RoadKind.LANE_CENTRE]


def view_from(road: Road, edges: tuple[str, ...], lane: int, metres: int) -> int:
    """Row of what a route shows from a place of a lane, -1 if that is what any place shows."""
    first, end, row = route_lanes(road, edges, truck=False).view[lane]
    node = int(road.first[lane]) + metres
    return int(row + node - first) if first <= node < end else -1


def test_the_branch_that_the_route_takes_is_seen_before_the_fork(road):
    there = view_from(road, ("in", "right"), IN, 250)
    x, y = centres(road, there).T
    assert (y[(x > LENGTH + 20)] < 0).sum() >= 3
    assert (y[(x > LENGTH + 20)] > 0).any()  # and the other one as that which forks off
    assert view_from(road, ("in", "left"), IN, 250) == -1  # straight on, as any place shows it
    assert view_from(road, ("in", "right"), IN, 150) == -1  # out of sight


@pytest.mark.parametrize(("edge", "lane", "sign"), [("left", LEFT, 1.0), ("right", RIGHT, -1.0)])
def test_behind_the_fork_only_the_own_branch_is_seen(road, edge, lane, sign):
    there = view_from(road, ("in", edge), lane, 15)  # the centres are 3 m apart
    x, y = centres(road, there).T
    ahead = x > LENGTH + 20
    assert ahead.sum() >= 5 and (sign * y[ahead] > 0).all()
    assert view_from(road, ("in", edge), lane, 80) == -1


def test_places_show_what_they_did(road):
    before = road.map.view.clone()
    route_lanes(road, ("in", "right"), truck=False)
    rows = len(road.map.view)
    assert rows > len(before)
    assert (road.map.view[: len(before)] == before).all()
    route_lanes(road, ("in", "right"), truck=True)  # the same way needs no more
    assert len(road.map.view) == rows
    assert not follow_lanes(road).view.any()


def test_rows_of_several_routes_do_not_mix(road):
    right = centres(road, view_from(road, ("in", "right"), RIGHT, 15))
    left = centres(road, view_from(road, ("in", "left"), LEFT, 15))
    assert (centres(road, view_from(road, ("in", "right"), RIGHT, 15)) == right).all()
    assert (left[:, 1].max() > 1.0) and (right[:, 1].min() < -1.0)


def test_vehicles_see_their_route_at_the_fork_and_their_place_elsewhere(road):
    routes = {
        name: route_lanes(road, ("in", edge), truck=False) for name, edge in (("a", "right"), ("b", "left"))
    }
    table = VehicleTable()
    for name, x in (("a", 270.0), ("b", 270.0), ("sumo", 270.0)):
        put(table, name, x, 0.0, 10.0)
    seen = table.row_of
    rows, _ = road.views.seen(table, nodes(table, road), routes)
    assert rows[[seen["b"], seen["sumo"]]].tolist() == [-1, -1]
    # the reference point, 4 m behind the bumper, is where the road is looked at from
    assert rows[seen["a"]] == view_from(road, ("in", "right"), IN, 266)
    off = np.full(len(table), -1)
    assert (road.views.seen(table, off, routes)[0] == -1).all()


def test_a_vehicle_over_the_line_does_not_see_the_oncoming_lane_as_its_own():
    shapes = {
        "on": ((0.0, 0.0), (400.0, 0.0)),
        "back": ((400.0, 3.6), (0.0, 3.6)),
        "far": ((0.0, 50.0), (400.0, 50.0)),
    }
    lanes = tuple(Lane(f"{edge}_0", edge, np.array(xy), 3.6, 30.0, 400.0) for edge, xy in shapes.items())
    road = Road(LaneNetwork("two ways", lanes, ()))
    assert (
        route_lanes(road, ("far",), truck=False).view[2, 0]
        == route_lanes(road, ("far",), truck=False).view[2, 1]
    )
    table = VehicleTable()
    row = put(table, "a", 104.0, 0.0, 10.0)
    routes = {"a": route_lanes(road, ("on",), truck=False)}
    node = nodes(table, road)
    table["y"][row] = 2.5
    cell = road.map.cell(torch.zeros(1, dtype=torch.long), torch.tensor([[100.0]]), torch.tensor([[2.5]]))
    assert float(road.map.cell_yaw[cell]) == pytest.approx(np.pi, abs=1e-3)  # the place is on the other lane
    rows, places = road.views.seen(table, node, routes)
    assert road.graph.node_yaw[places[row]] == pytest.approx(0.0, abs=1e-3)
    x, y = centres(road, int(rows[row])).T
    assert x.max() > 190.0 and (x > 99.0).all() and np.abs(y).max() < 0.1


@pytest.mark.parametrize("degrees", [2, 10, 25, 60])
def test_every_branch_of_a_fork_is_seen_whatever_their_number_and_angle(degrees):
    """One lane that leads on to six, evenly spread over twice the angle."""
    turns = np.radians(np.linspace(-degrees, degrees, 6))
    ends = [(LENGTH + 200 * np.cos(turn), 200 * np.sin(turn)) for turn in turns]
    shapes = [((0.0, 0.0), (LENGTH, 0.0)), *(((LENGTH, 0.0), end) for end in ends)]
    lanes = tuple(
        Lane(f"e{k}_0", f"e{k}", np.array(xy), 3.6, 30.0, float(np.hypot(*np.subtract(*xy))))
        for k, xy in enumerate(shapes)
    )
    road = Road(LaneNetwork("six", lanes, tuple((0, k) for k in range(1, 7))))
    straight = road.graph.successor[road.first[0] + road.count[0] - 1, 0]
    for k, turn in enumerate(turns, start=1):
        row = view_from(road, ("e0", f"e{k}"), 0, 250)
        if row < 0:  # what any place shows
            assert road.graph.node_lane[straight] == k
        else:
            x, y = centres(road, row).T - np.array([[LENGTH], [0.0]])
            aside = np.abs(y * np.cos(turn) - x * np.sin(turn))
            assert (aside[x > 10.0] < 0.5).sum() >= 3
        x, y = centres(road, view_from(road, ("e0", f"e{k}"), k, 8)).T - np.array([[LENGTH], [0.0]])
        assert np.abs(y * np.cos(turn) - x * np.sin(turn)).max() < 0.1
