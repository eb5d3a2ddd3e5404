"""Who is asked, and how often, before PHASE takes a vehicle over."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from phase_sumo.bridge.fleet.adoption import Adoption
from phase_sumo.bridge.fleet.parameters import Choice
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.sim.lanes import Lane, LaneNetwork
from tests.helpers.toy_motorway import lane, nodes, put


def test_a_vehicle_that_waits_for_its_road_is_chosen_once():
    nothing = SimpleNamespace(getParameter=lambda *_: "", getLine=lambda _: "")
    names = [f"v{i}" for i in range(4)]
    facts = SimpleNamespace(kind="car", type="car", shape=SimpleNamespace(truck=False))
    scene = SimpleNamespace(
        api=SimpleNamespace(vehicle=nothing, vehicletype=nothing),
        session=SimpleNamespace(refused=KeyError),
        table=SimpleNamespace(row_of={name: row for row, name in enumerate(names)}),
        lane_of=dict.fromkeys(names, "main_0"),
        facts=dict.fromkeys(names, facts),
    )
    choice = Choice(share=0.5, deterministic=True)
    adoption = Adoption(scene, None, choice, None, None, None)  # type: ignore[arg-type]
    nowhere = np.full(4, -1)
    for _ in range(5):
        assert not list(adoption.take_over(nowhere, ()))
        assert adoption.left_to_sumo == {"v1", "v3"}


def test_a_vehicle_that_turns_onto_its_lane_waits_until_it_is_in_line():
    road = Road(LaneNetwork("one", (lane("e", 0, 0, 500),), ()))
    table = VehicleTable(2)
    row = put(table, "a", 200.0, 0.0, 15.0)
    node = nodes(table, road)
    route = SimpleNamespace(
        getRoute=lambda _: ("e",),
        getRouteIndex=lambda _: 0,
        getMaxSpeed=lambda _: 50.0,
        getSpeedFactor=lambda _: 1.0,
    )
    scene = SimpleNamespace(api=SimpleNamespace(vehicle=route), table=table)
    stretch, room = (("e",), route_lanes(road, ("e",), truck=False)), [np.inf]
    plans = SimpleNamespace(stretch=lambda *_: stretch, stop_room=lambda *_: room[0])
    ways = SimpleNamespace(bar=lambda *_, **__: None)
    adoption = Adoption(scene, road, Choice(), None, plans, ways)  # type: ignore[arg-type]
    for turn, taken in ((0.0, True), (0.04, True), (0.08, False), (-0.15, False), (2 * np.pi, True)):
        table["yaw"][row] = turn
        assert bool(adoption._stretch("a", int(node[row]))) == taken
    table["yaw"][row], table["speed"][row] = 0.08, 5.0  # slowly it drifts less
    assert adoption._stretch("a", int(node[row]))
    table["yaw"][row], table["speed"][row] = 0.0, 15.0
    assert not adoption._stretch("a", 2)  # its tail is not on the road
    for room[0], taken in ((-20.0, False), (0.0, False), (200.0, False), (400.0, True)):  # m to a stop
        assert bool(adoption._stretch("a", int(node[row]))) == taken


def test_wheels_and_trailers_stand_as_the_road_bends():
    """A tractor on a circle of 60 m turns its wheels by atan(L / R), and sin(hitch) = base / R behind it."""
    radius, turn = 60.0, np.linspace(0.0, 1.5, 200)
    points = radius * np.stack((np.sin(turn), 1.0 - np.cos(turn)), -1)
    road = Road(LaneNetwork("bend", (Lane("e_0", "e", points, 3.6, 30.0, 90.0),), ()))
    table = VehicleTable(2)
    row = table.add("a", shape_from_type("trailer", 16.5, 2.5))
    adoption = Adoption(SimpleNamespace(api=None, table=table), road, Choice(), None, None, None)  # type: ignore[arg-type]
    adoption._steer(row, 60)
    assert table["steer"][row] == pytest.approx(np.arctan(table["wheelbase"][row] / radius), rel=0.05)
    assert table["hitch"][row] == pytest.approx(np.arcsin(table["trailer_base"][row] / radius), rel=0.05)
    table["hitch"][row] = 0.2
    adoption._steer(row, 60)
    assert table["hitch"][row] == np.float32(0.2)  # it was seen to move
