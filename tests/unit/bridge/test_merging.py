"""Who follows whom into a merge of two roads without an acceleration lane."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge.fleet.drivers import Member
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.fleet.target_speeds import BEFORE, Merging
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import lane, nodes, put

MERGE = 500.0  # m, where "road" and "ramp" become "both"
APART = 40.0  # m between them; the ramp's last lane of 60 m is the one that leads on


@pytest.fixture(scope="module")
def road():
    """``road`` and ``far`` + ``ramp`` lead into ``both``; ``far`` also leads to ``exit``."""
    lanes = (
        lane("road", 0, 0, MERGE),
        lane("far", 0, 0, MERGE - 60.0, y=APART),
        lane("ramp", 0, MERGE - 60.0, MERGE, y=APART),
        lane("both", 0, MERGE, 1000),
        lane("exit", 0, MERGE - 60.0, 1000, y=2 * APART),
    )
    return Road(LaneNetwork("merge", lanes, ((0, 3), (1, 2), (2, 3), (1, 4))))


def pairs(road, vehicles, edges=("far", "ramp", "both"), yields=(False,) * 5):
    """(follower, leader, gap) of vehicles (name, m to the merge, y, speed[, wanted speed: PHASE drives])."""
    table = VehicleTable(8)
    for name, way, *rest in vehicles:
        put(table, name, MERGE - way, *rest)
    route = route_lanes(road, edges, truck=False)
    main = route_lanes(road, ("road", "both"), truck=False)
    members = {
        v[0]: Member(main if v[2] == 0.0 else route, (), False, 1.0, 50.0, 2.0)
        for v in vehicles
        if len(v) == 5
    }
    node = nodes(table, road)
    rows, leaders, gaps = Merging(road, table, np.array(yields)).pairs(Occupancy(road, table, node), members)
    return [
        (table.ids[a], table.ids[b], pytest.approx(gap, abs=2.0))
        for a, b, gap in zip(rows.tolist(), leaders.tolist(), gaps, strict=True)
    ]


def test_by_time_of_arrival(road):
    main, ramp = ("m", 60.0, 0.0, 20.0, 20.0), ("r", 50.0, APART, 20.0, 20.0)
    assert pairs(road, [main, ramp]) == [("m", "r", 60.0 - 50.0 - 5.0)]
    assert pairs(road, [("m", 60.0, 0.0, 30.0, 30.0), ramp]) == [("r", "m", 50.0 - 60.0 - 5.0)]


def test_vehicles_of_one_branch_are_left_to_their_lane(road):
    queue = [("m1", 20.0, 0.0, 20.0, 20.0), ("m2", 40.0, 0.0, 20.0, 20.0), ("m3", 80.0, 0.0, 20.0, 20.0)]
    assert pairs(road, queue) == []
    ramp = ("r", 50.0, APART, 20.0, 20.0)
    assert pairs(road, [*queue, ramp]) == [("r", "m2", 5.0), ("m3", "r", 25.0)]


def test_only_those_that_come_to_the_merge(road):
    main, far = ("m", 95.0, 0.0, 20.0, 20.0), ("r", 80.0, APART, 20.0, 20.0)
    assert pairs(road, [main, far]) == [("m", "r", 10.0)]
    assert pairs(road, [main, far], edges=("far", "exit")) == []
    assert pairs(road, [("m", BEFORE + 20.0, 0.0, 20.0, 20.0), far]) == []
    assert pairs(road, [main, ("beyond", -5.0, 0.0, 20.0, 20.0)]) == []


def test_order_does_not_depend_on_rows(road):
    rng = np.random.default_rng(0)
    scene = [(f"v{k}", float(w), float(APART * (k % 2)), 15.0, 15.0) for k, w in enumerate(range(5, 95, 12))]
    expected = pairs(road, scene)
    assert len(expected) == len(scene) - 1
    for _ in range(5):
        assert pairs(road, [scene[k] for k in rng.permutation(len(scene))]) == expected


def test_who_must_give_way_follows_and_slows_nobody(road):
    yields = (False, False, True, False, False)
    main, ramp = ("m", 60.0, 0.0, 20.0, 20.0), ("r", 50.0, APART, 20.0, 20.0)
    assert pairs(road, [main, ramp], yields=yields) == [("r", "m", 50.0 - 60.0 - 5.0)]
    assert pairs(road, [("m", 95.0, 0.0, 10.0, 10.0), ramp], yields=yields) == [], "far enough behind"
    assert pairs(road, [main, ("r", 8.0, APART, 20.0, 20.0)], yields=yields) != [], (
        "let in when all but there"
    )
