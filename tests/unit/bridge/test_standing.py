"""Vehicles that stand for minutes are told with place and number."""

from __future__ import annotations

from types import SimpleNamespace

from phase_sumo.bridge.fleet.standing import LONG, PLACES, StandingWatch


def watch(waited, lane):
    vehicle = SimpleNamespace(
        getWaitingTime=waited.get, getLaneID=lane.get, getLanePosition=lambda name: 10.0 * int(name[1:])
    )
    scene = SimpleNamespace(
        api=SimpleNamespace(vehicle=vehicle), facts=waited, edge=lambda lane: lane.rpartition("_")[0]
    )
    return StandingWatch(scene)  # type: ignore[arg-type]


def test_places_and_numbers():
    waited = {f"v{k}": LONG + k for k in range(4)} | {"v9": LONG - 1.0}
    lane = dict.fromkeys(waited, "ramp_0") | {"v3": "main_1"}
    standing = watch(waited, lane)
    standing.update(300.0)
    waited["v1"] += 60.0
    standing.update(305.0)  # too early for another look
    ramp, main = standing.warnings()
    assert "3 vehicles" in ramp and "'ramp'" in ramp and "182 s" in ramp and "'ramp_0' at 0 m" in ramp
    assert "1 vehicle stood" in main and "'main_1' at 30 m" in main
    standing.update(310.0)
    assert "241 s" in standing.warnings()[0]


def test_many_places_are_summed_up():
    waited = {f"v{k}": LONG for k in range(PLACES + 2)}
    standing = watch(waited, {name: f"e{name}_0" for name in waited})
    standing.update(0.0)
    assert len(standing.warnings()) == PLACES + 1
    assert "2 vehicles" in standing.warnings()[-1] and "2 other edges" in standing.warnings()[-1]
    assert not watch({"v0": 0.0}, {"v0": "e_0"}).warnings()
