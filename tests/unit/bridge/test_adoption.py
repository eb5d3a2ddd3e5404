"""Who is asked, and how often, before PHASE takes a vehicle over."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from phase_sumo.bridge.fleet.adoption import Adoption
from phase_sumo.bridge.fleet.parameters import Choice
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import lane, nodes, put


def test_a_vehicle_that_waits_for_its_road_is_chosen_once():
    nothing = SimpleNamespace(getParameter=lambda *_: "")
    names = [f"v{i}" for i in range(4)]
    facts = SimpleNamespace(kind="car", type="car", shape=SimpleNamespace(truck=False))
    scene = SimpleNamespace(
        api=SimpleNamespace(vehicle=nothing, vehicletype=nothing),
        table=SimpleNamespace(row_of={name: row for row, name in enumerate(names)}),
        lane_of=dict.fromkeys(names, "main_0"),
        facts=dict.fromkeys(names, facts),
    )
    choice = Choice(share=0.5, deterministic=True)
    adoption = Adoption(scene, None, choice, None, None)  # type: ignore[arg-type]
    nowhere = np.full(4, -1)
    for _ in range(5):
        assert not list(adoption.take_over(nowhere, ()))
        assert adoption.left_to_sumo == {"v1", "v3"}


def test_a_vehicle_that_turns_onto_its_lane_waits_until_it_is_in_line():
    road = Road(LaneNetwork("one", (lane("e", 0, 0, 500),), ()))
    table = VehicleTable(2)
    row = put(table, "a", 200.0, 0.0, 15.0)
    node = nodes(table, road)
    route = SimpleNamespace(getRoute=lambda _: ("e",), getRouteIndex=lambda _: 0, getStops=lambda *_: ())
    scene = SimpleNamespace(api=SimpleNamespace(vehicle=route), table=table)
    lanes = {(("e",), False): route_lanes(road, ("e",), truck=False)}
    adoption = Adoption(scene, road, Choice(), None, lambda *key: lanes[key])  # type: ignore[arg-type]
    for turn, taken in ((0.0, True), (0.08, True), (-0.15, False), (0.5, False), (2 * np.pi, True)):
        table["yaw"][row] = turn
        assert bool(adoption._stretch("a", int(node[row]), truck=False)) == taken
