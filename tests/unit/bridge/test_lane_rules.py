"""What lanes allow a class of vehicles now."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from phase_sumo.bridge.fleet.class_rules import ClassRules
from phase_sumo.bridge.fleet.lane_rules import LaneRules
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import BRAKING, kept_stretch, limits_ahead, route_lanes
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import lane

EVERYONE = ("passenger", "bus", "truck")


class Lanes:
    """SUMO's answers about lanes."""

    def __init__(self) -> None:
        self.limits: dict[str, float] = {}
        self.closed: dict[str, tuple[str, ...]] = {}
        self.changes: dict[tuple[str, int], tuple[str, ...]] = {}

    def getMaxSpeed(self, name):
        return self.limits.get(name, 30.0)

    def getDisallowed(self, name):
        return self.closed.get(name, ())

    def getChangePermissions(self, name, way):
        return self.changes.get((name, way), EVERYONE)


@pytest.fixture
def road():
    """Two lanes, a way across a junction for each, two lanes; the line between the last two is solid."""
    lanes = (
        lane("a", 0, 0, 300, left=1),
        lane("a", 1, 0, 300, right=0),
        lane(":j_0", 0, 300, 310, connector=True, left=3, parts=((":j_0_0", 0.0),)),
        lane(":j_0", 1, 300, 310, connector=True, right=2, parts=((":j_0_1", 0.0),)),
        lane("b", 0, 310, 600, solid_left=True, class_limits=(("truck", 22.0),)),
        lane("b", 1, 310, 600, solid_right=True),
    )
    return Road(LaneNetwork("toy", lanes, ((0, 2), (2, 4), (1, 3), (3, 5))))


@pytest.fixture
def sumo():
    return Lanes()


def rules_of(road, sumo, name="passenger") -> tuple[LaneRules, ClassRules]:
    rules = LaneRules(SimpleNamespace(lane=sumo), road)
    return rules, rules.of(name)


def test_every_class_has_its_own_lanes_and_lines(road, sumo):
    sumo.closed["a_1"] = ("bus",)
    sumo.changes["b_0", 1] = ("truck",)
    rules, car = rules_of(road, sumo)
    bus, truck = rules.of("bus"), rules.of("truck")
    assert car.allowed.all()
    assert bus.allowed.tolist() == [True, False, True, False, True, True]
    assert (car.left.tolist(), truck.left.tolist()) == (
        [True, False, True, False, False, False],
        [True, False, True, False, True, False],
    )
    assert car.right[5], "over a solid line that SUMO allows to cross"


def test_a_class_has_its_own_limit_until_a_sign_says_less(road, sumo):
    rules, truck = rules_of(road, sumo, "truck")
    assert truck.limit[4:].tolist() == [22.0, 30.0]
    assert np.isinf(truck.cap).all()
    sumo.limits |= {"b_0": 15.0, "b_1": 15.0}
    assert rules.update(1.0, ()) == set()
    assert truck.limit[4:].tolist() == [22.0, 15.0]
    assert truck.cap[4] == 15.0


def test_lanes_are_asked_every_second_and_edges_that_changed_are_told(road, sumo):
    rules, car = rules_of(road, sumo)
    assert rules.update(1.0, ()) == set()
    sumo.closed["b_0"] = EVERYONE
    assert rules.update(1.5, ()) == set()
    assert rules.update(2.0, ()) == {"b"}
    assert not car.allowed[4]
    assert car.barred[[0, 2, 4]].all()
    assert not car.barred[[1, 3, 5]].any()
    sumo.closed.clear()
    assert rules.update(3.0, ()) == {"b"}
    assert car.allowed.all()


def test_permissions_to_change_are_asked_where_vehicles_are(road, sumo):
    rules, car = rules_of(road, sumo)
    sumo.changes["a_0", 1] = ()
    assert rules.update(1.0, ("b",)) == set()
    assert rules.update(2.0, ("a", "b")) == {"a"}
    assert not car.left[0]


def test_a_closed_lane_is_left_at_once(road, sumo):
    sumo.closed["b_0"] = EVERYONE
    _, car = rules_of(road, sumo)
    route = route_lanes(road, ("a", "b"), truck=False, rules=car)
    assert route.changes[[0, 1, 4, 5]].tolist() == [1, 0, 1, 0]
    assert (route.side[0], route.side[4]) == (1, 1)
    assert route.room[4] == 0.0
    assert route.room[0] == pytest.approx(310.0, abs=2.0)


def test_who_may_not_cross_a_line_has_to_change_before(road, sumo):
    sumo.closed["b_1"] = ("truck",)
    sumo.changes["b_1", -1] = ("passenger",)
    _, truck = rules_of(road, sumo, "truck")
    route = route_lanes(road, ("a", "b"), truck=True, rules=truck)
    assert np.isinf(route.changes[5])
    assert route.changes[[0, 1]].tolist() == [0, 1]


def test_a_stretch_ends_before_a_closed_road(road, sumo):
    sumo.closed |= {"b_0": EVERYONE, "b_1": EVERYONE}
    _, car = rules_of(road, sumo)
    assert kept_stretch(road, ("a", "b"), 0, car) == ("a",)


def test_vehicles_brake_for_lower_limits_ahead(road, sumo):
    sumo.limits |= {"b_0": 10.0}
    _, car = rules_of(road, sumo)
    route = route_lanes(road, ("a", "b"), truck=False, rules=car)
    node = np.array([0, 250, road.first[4] + 5])
    speed = limits_ahead(road, [route] * 3, node, np.full(3, 1.1), np.zeros(3))
    before = np.sqrt(11.0**2 + 2.0 * BRAKING * (300 + 10 - 250))
    assert speed == pytest.approx([np.sqrt(11.0**2 + 2 * BRAKING * 310), before, 11.0], abs=0.15)
