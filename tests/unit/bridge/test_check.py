"""What the check before a run tells of a scenario, and what it refuses."""

from __future__ import annotations

import json

import pytest

from phase_sumo.bridge.check import Check, check_scenario
from phase_sumo.bridge.drive_options import DriveOptions
from phase_sumo.bridge.sumo import demand, demand_survey
from phase_sumo.errors import PhaseError
from tests.helpers.scenario_files import write_scenario
from tests.helpers.small_nets import SmallNet, lanes_from

ROUTES = """
    <vType id="bus" vClass="bus"/><vType id="bike" vClass="bicycle"/>
    <vTypeDistribution id="mix"><vType id="van" vClass="delivery" probability="3"/>
      <vType id="cab" vClass="taxi" probability="1"><param key="phase.alpha" value="0.5"/></vType>
    </vTypeDistribution>
    <route id="r" edges="fast ramp street"><stop lane="fast_0" endPos="50" duration="5"/></route>
    <flow id="f" type="mix" route="r" begin="0" end="100" vehsPerHour="1440"/>
    <vehicle id="slow" type="bike" route="r" depart="0"/>
    <vehicle id="b" type="bus" route="r" depart="0"><stop busStop="halt" duration="5"/></vehicle>
    <person id="p" depart="0"><walk edges="street"/></person>
"""
MISTYPED = '<vType id="t"><param key="phase.alfa" value="1"/></vType>'
ADDITIONAL = """
    <busStop id="halt" lane="street_0" startPos="0" endPos="20"/>
    <rerouter id="x" edges="fast"><interval begin="0" end="9">
      <closingLaneReroute id="ramp_0"/></interval></rerouter>
    <variableSpeedSign id="v" lanes="fast_0 fast_1"><step time="0" speed="20"/></variableSpeedSign>
    <calibrator id="c" edge="ramp"/>
"""


@pytest.fixture
def net(tmp_path):
    net = SmallNet().edge("fast", lanes_from(0, 300, 0.0, 3.6), type="highway.motorway")
    net.edge("ramp", lanes_from(300, 600, 0.0), type="highway.motorway_link")
    net.edge("street", lanes_from(600, 900, 0.0), type="highway.residential", speed=13.9)
    net.connect("ramp", "street", (0, 0))
    text = net.text.replace(
        "</net>",
        '<connection from="fast" to="ramp" fromLane="0" toLane="0" tl="meter" linkIndex="0" state="o"/>'
        '<connection from="fast" to="ramp" fromLane="1" toLane="0" state="m"/></net>',
    )
    path = tmp_path / "small.net.xml"
    path.write_text(text, encoding="utf-8")
    return path


def checked(folder, net, routes=ROUTES, additional=ADDITIONAL, options="", **drive) -> Check:
    cfg = write_scenario(folder, routes, net=net, additional=additional, options=options)
    return check_scenario(cfg, DriveOptions(**drive))


def test_each_file_of_the_demand_is_read_once(net, tmp_path, monkeypatch):
    opened: list[str] = []
    monkeypatch.setattr(
        demand_survey, "open_input", lambda path: opened.append(path.name) or demand.open_input(path)
    )
    assert checked(tmp_path, net).stops["on_driven_roads"] == 1
    assert len(opened) == len(set(opened)) == 2


def test_what_is_driven_and_what_is_left_is_counted(net, tmp_path):
    check = checked(tmp_path, net, end=50.0)
    assert (check.roads["edges"], check.roads["all_edges"]) == (2, 3)
    assert check.roads["lane_km"] == pytest.approx(0.9)
    assert check.other_roads == {"residential": 1}
    assert check.phase == {"delivery": 15, "taxi": 5, "bus": 1}  # 50 s of one every 2.5 s
    assert check.sumo == {"bicycle (neither car nor truck)": 1, "persons and containers": 1}
    assert check.signals == {"traffic_lights": ["meter"], "signs": {"give way": 1}}
    assert check.stops == {"on_driven_roads": 1, "elsewhere": 1}
    assert check.rerouting == {
        "rerouters": 1, "closings": 1, "variable speed signs": 2,
        "calibrators (SUMO drives on their edges)": 1,
    }  # fmt: skip


def test_ten_lines_tell_it_and_json_holds_it(net, tmp_path):
    check = checked(tmp_path, net, types=("van",), share=0.3)
    lines = check.lines()
    assert len(lines) == 10 + len(check.warnings)
    text = "\n".join(lines)
    for words in (
        "delivery 30; 30 % of these",
        "taxi (not of the types asked for) 10",
        "(meter), 1 give way",
    ):
        assert words in text
    assert Check(**json.loads(json.dumps(check.to_json()))) == check


def test_a_model_for_all_is_said(net, tmp_path):
    check = checked(tmp_path, net, model="idm", phase=False)
    assert "the car-following model of every vType -> IDM (the command line says so)" in check.changed
    assert check.share == 0.0 and check.phase == {}


def test_the_scenarios_seed_holds_unless_told_otherwise(net, tmp_path):
    seeded = '<seed value="5"/>'
    assert checked(tmp_path, net, options=seeded).time["seed"] == 5
    check = checked(tmp_path, net, options=seeded, seed=7)
    assert check.time["seed"] == 7
    assert "seed 5 -> 7 (the command line says so)" in check.changed
    assert checked(tmp_path, net, options='<random value="true"/>').time["seed"] is None


@pytest.mark.parametrize(
    ("routes", "drive", "message"),
    [
        (MISTYPED.replace("phase.alfa", "phase.type"), {}, "phase.type='1', expected one of car"),
        (MISTYPED, {}, "vType 't'.*phase.alfa.*did you mean phase.alpha"),
        (ROUTES, {"types": ("vann",)}, "'vann' is in none.*did you mean van"),
        (ROUTES, {"types": ("mix",)}, "'mix' is a vTypeDistribution; name its vTypes: van cab"),
        (ROUTES, {"explicit": ("slov",)}, "'slov' is in none.*did you mean slow"),
        (ROUTES, {"explicit": ("g.3",)}, "'g.3' is in none"),
    ],
)  # fmt: skip
def test_names_that_nobody_has_are_refused(net, tmp_path, routes, drive, message):
    with pytest.raises(PhaseError, match=message):
        checked(tmp_path, net, routes, additional="", **drive)


def test_names_that_may_still_come_are_not_refused(net, tmp_path):
    checked(tmp_path, net, explicit=("f.3", "slow"), additional="")  # of a flow
    checked(tmp_path, net, explicit=("calibrated",), types=("later",))  # there is a calibrator
