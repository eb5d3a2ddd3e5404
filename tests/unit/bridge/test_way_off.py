"""How far PHASE drives towards roads that are SUMO's, on a hand-made off-ramp of two lanes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.bridge.fleet.way_off import WayOff
from phase_sumo.sim.curve_speed import BRAKING
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import lane

LIMITS = {"street_0": 14.0, ":x_0_0": 12.0, "left_0": 9.0}
LINKS = {
    "off_0": (("street_0", True, True, False, ":x_0_0", "M"), ("left_0", True, True, False, "", "m")),
    "off_1": (("left_0", True, True, False, "", "m"),),
}


@pytest.fixture
def road():
    return Road(LaneNetwork("off", (lane("off", 0, 0, 400, left=1), lane("off", 1, 0, 400, right=0)), ()))


def way_off(road, leader=None, speed=0.0):
    """``leader``: id and gap in m of whom SUMO sees ahead."""
    lanes = SimpleNamespace(getLinks=LINKS.get, getMaxSpeed=LIMITS.get)
    vehicles = SimpleNamespace(
        getLeader=lambda _, look: leader if leader and leader[1] < look else None, getSpeed=lambda _: speed
    )
    return WayOff(SimpleNamespace(lane=lanes, vehicle=vehicles), road)


def test_lanes_that_lead_on_are_known_with_what_is_allowed_there(road):
    ends = way_off(road)
    assert ends.lanes("off", "street") == {0: 12.0}
    assert ends.lanes("off", "left") == {0: 9.0, 1: 9.0}
    assert ends.lanes("off", "off") == {}  # observed itself


def test_the_route_needs_the_lane_that_leads_on_and_slows_down_before_its_end(road):
    route = route_lanes(road, ("off",), truck=False, leave={0: 12.0})
    assert route.changes.tolist() == [0, 1] and route.side.tolist() == [0, -1]
    assert route.exit_speed[0] == pytest.approx(12.0)
    assert route_lanes(road, ("off",), truck=False).changes.tolist() == [0, 0]
    start = np.sqrt(12.0**2 + 2 * BRAKING * 50.0)
    assert start < 30.0  # a vehicle at the limit of 30 must slow down there


@pytest.mark.parametrize(
    ("lane_index", "room", "speed", "leader", "theirs", "free"),
    [
        (0, 40.0, 14.0, None, 0.0, True),
        (0, 9.0, 14.0, None, 0.0, False),  # at the end
        (0, 4.0, 2.0, None, 0.0, False),
        (1, 40.0, 14.0, None, 0.0, False),  # must change lanes
        (0, 40.0, 25.0, None, 0.0, False),  # too fast for what follows
        (0, 40.0, 14.0, ("q", 30.0), 0.0, False),  # the tail of a queue
        (0, 40.0, 14.0, ("q", 30.0), 14.0, True),  # somebody who drives
        (0, 40.0, 14.0, ("q", 80.0), 0.0, True),
    ],
)
def test_sumo_takes_over_early_only_where_it_must(road, lane_index, room, speed, leader, theirs, free):
    route = route_lanes(road, ("off",), truck=False, leave={0: 12.0})
    ends = way_off(road, leader, theirs)
    node = int(road.first[lane_index] + 400 - room)
    assert ends.is_free("a", route, node, room, speed) == free
