"""Where SUMO takes over since the way ahead may ask for a stop."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from phase_sumo.bridge.fleet.right_of_way import MARGIN, REACTION, STOP_BRAKING, RightOfWay
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import lane

LINE = 400.0  # m, where ``a`` ends
SPEED = 20.0
ROOM = SPEED**2 / (2 * STOP_BRAKING) + REACTION * SPEED + MARGIN


def foe(way: float = 30.0, goes_first: bool = True) -> tuple:
    """Somebody on the way across, as SUMO tells it."""
    return ("other", 30.0, way, 34.0, way + 4.0, ":j_0_0", ":j_1_0", goes_first, not goes_first)


class Junction:
    """A road of one lane across a junction, and what SUMO says of it."""

    def __init__(self, state: str = "M", signal: str | None = None, crosses: bool = False) -> None:
        lanes = (
            lane("a", 0, 0, LINE),
            lane(":j_0", 0, LINE, LINE + 10, connector=True, parts=((":j_0_0", 0.0),)),
            lane("b", 0, LINE + 10, 800),
        )
        self.road = Road(LaneNetwork("toy", lanes, ((0, 1), (1, 2))))
        self.route = route_lanes(self.road, ("a", "b"), truck=False)
        self.shown, self.foes, self.speed = signal, [], 20.0
        links = {
            "a_0": [("b_0", True, True, False, ":j_0_0", state, "s", 10.0)],
            ":j_1_0": [("c_0", True, True, False, "", "M", "s", 10.0)],
        }
        api = SimpleNamespace(
            lane=SimpleNamespace(
                getLinks=lambda name: links.get(name, []),
                getInternalFoes=lambda _: [":j_1_0"] if crosses else [],
            ),
            trafficlight=SimpleNamespace(
                getIDList=lambda: ["s"] if signal else [],
                getControlledLinks=lambda _: [[("a_0", "b_0", ":j_0_0")]],
                getRedYellowGreenState=lambda _: self.shown,
            ),
            vehicle=SimpleNamespace(
                getLength=lambda _: 5.0,
                getSpeed=lambda _: self.speed,
                getJunctionFoes=lambda *_: self.foes,
            ),
        )
        self.ways = RightOfWay(api, self.road)

    def reason(self, way: float, speed: float = SPEED, **more) -> str:
        """Why SUMO takes over ``way`` m before the line, "" if it does not."""
        self.ways.update()
        bar = self.ways.bar("ego", self.route, False, int(LINE - way), speed, 1.0, **more)
        return bar.reason if bar else ""


@pytest.mark.parametrize("letter", "ryu")
def test_before_a_signal_that_is_not_green(letter):
    junction = Junction(signal=letter)
    assert junction.reason(ROOM + 5.0) == ""
    assert junction.reason(ROOM - 5.0) == "a red signal"
    junction.shown = "G"
    assert junction.reason(ROOM - 5.0) == ""


def test_the_vehicle_stays_sumos_up_to_the_line():
    junction = Junction(signal="r")
    bar = junction.ways.bar("ego", junction.route, False, 350, SPEED, 1.0)
    assert bar is not None
    assert bar.edges == {"a"}
    assert bar.metres == pytest.approx(50.0, abs=1.5)


@pytest.mark.parametrize("letter", "sw")
def test_signs_that_ask_for_a_stop(letter):
    assert Junction(letter).reason(ROOM - 5.0) == "a stop sign"


@pytest.mark.parametrize("letter", "m=")
def test_who_must_give_way_does_so_when_somebody_comes(letter):
    junction = Junction(letter, crosses=True)
    assert junction.reason(30.0) == ""
    junction.foes = [foe()]
    assert junction.reason(30.0) == "others have the right of way"
    junction.foes = [foe(200.0)]
    assert junction.reason(30.0) == "", "there is time enough before"
    junction.foes = [foe(goes_first=False)]
    assert junction.reason(30.0) == "", "it is the other who must give way"


def test_whoever_is_on_the_crossing_goes_first():
    junction = Junction("M", crosses=True)
    junction.foes = [foe(goes_first=False)]
    assert junction.reason(30.0) == ""
    junction.speed, junction.foes = 1.0, [foe(-2.0, goes_first=False)]
    assert junction.reason(30.0) == "the crossing is not free"


def test_a_queue_before_a_signal_is_joined_under_sumo_whatever_it_shows():
    junction = Junction(signal="G")
    assert junction.reason(200.0, queue=100.0) == ""
    assert junction.reason(200.0, queue=60.0) == "a queue"
    assert Junction().reason(200.0, queue=60.0) == "", "no place to wait for: others see to it"


def test_nobody_is_taken_over_in_a_queue_or_shortly_before_a_red_signal():
    junction = Junction(signal="G")
    assert junction.reason(30.0, speed=3.0, ease=1.3) == "a queue"
    assert junction.reason(100.0, speed=3.0, ease=1.3) == ""
    junction.shown = "r"
    assert junction.reason(ROOM + 5.0, ease=1.3) == "a red signal"


def test_closed_lanes_and_limits_below_what_the_policy_drives():
    junction = Junction()
    rules = junction.route.rules
    rules.barred[:2] = True
    rules.allowed[2] = False
    assert junction.reason(20.0) == "the lane is closed"
    rules.allowed[2], rules.limit[2] = True, 2.0
    assert junction.reason(20.0) == "the speed limit is too low"
    rules.limit[0] = 2.0
    assert junction.reason(300.0) == "the speed limit is too low"


def test_who_gives_way_where_roads_merge_is_known():
    assert Junction("m").ways.yields.tolist() == [False, True, False]
    signal = Junction(signal="G")
    assert not signal.ways.yields.any()
    signal.shown = "g"
    signal.ways.update()
    assert signal.ways.yields.tolist() == [False, True, False]


def test_nothing_is_asked_where_nobody_ever_waits():
    junction = Junction()
    junction.foes = None  # type: ignore[assignment]
    assert [junction.reason(float(way)) for way in np.arange(5, 395, 20)] == [""] * 20
