"""Vehicles that stay in each other: what is said of them, and when one is taken out."""

from __future__ import annotations

from phase_sumo.bridge.fleet.contacts import WRECK_SECONDS
from phase_sumo.bridge.fleet.event_log import read_events
from phase_sumo.bridge.run import run_scenario
from tests.helpers.scenario_files import write_scenario
from tests.helpers.unmoved import ASTRIDE, VEHICLE, Unmoved


def drive(folder, *vehicles, end):
    routes = "".join(VEHICLE.format(*vehicle) for vehicle in vehicles)
    out = folder / "out"
    result = run_scenario(
        write_scenario(folder, routes), policy=Unmoved(), end=end, output_dir=out, time_gap=0.0, guard=False
    )
    return result, read_events(out / "events.csv")


def test_one_vehicle_of_a_wreck_is_taken_out(tmp_path):
    result, events = drive(tmp_path, *ASTRIDE, ("c", 2, 90, 0, 0), end=30.0)
    assert result["accounts"] == {"inserted": 3, "arrived": 0, "running": 2, "removed: crashed": 1}
    (collision,) = [e for e in events if e.kind == "collision"]
    (removal,) = [e for e in events if e.kind == "removal"]
    assert (removal.vehicle, removal.reason) == ("a", "crashed")  # the one behind
    assert {collision.vehicle, collision.other} == {"a", "b"}
    assert abs(removal.time - collision.time - WRECK_SECONDS) < 0.15


def test_vehicles_that_move_on_are_no_wreck(tmp_path):
    result, events = drive(tmp_path, ("a", 0, 30, 2, 0), ("b", 0, 32, 2, 0), end=15.0)
    assert [e.kind for e in events if e.kind in ("collision", "removal")] == ["collision"]
    assert result["accounts"]["running"] == 2


def test_a_wreck_is_not_cleared_while_it_can_still_come_apart(tmp_path):
    result, _ = drive(tmp_path, *ASTRIDE, end=0.95 * WRECK_SECONDS)
    assert result["accounts"]["running"] == 2
