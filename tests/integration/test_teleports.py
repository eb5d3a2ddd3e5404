"""SUMO's teleports and what it does about collisions are as the scenario says, also while PHASE drives."""

from __future__ import annotations

from phase_sumo.bridge.fleet.event_log import read_events
from phase_sumo.bridge.run import run_scenario
from tests.helpers.scenario_files import write_scenario
from tests.helpers.unmoved import ASTRIDE, VEHICLE, Unmoved


def drive(folder, routes, options, driver, **changes):
    out = folder / "out"
    cfg = write_scenario(folder, routes, options=options)
    result = run_scenario(cfg, policy=driver, output_dir=out, time_gap=0.0, record=False, **changes)
    return result, read_events(out / "events.csv")


def test_who_stands_is_teleported_when_the_scenario_says_so(tmp_path):
    routes = "".join(VEHICLE.format(*vehicle) for vehicle in ASTRIDE)
    result, events = drive(tmp_path, routes, '<time-to-teleport value="4"/>', Unmoved(), end=60.0)
    assert result["teleports"] > 0
    assert any(e.kind == "hand-back" and e.reason == "SUMO teleports it" for e in events)
    assert not [e for e in events if e.reason == "crashed"]
    assert not [text for text in result["check"]["changed"] if text.startswith("time-to-teleport")]
    assert result["accounts_balance"]
