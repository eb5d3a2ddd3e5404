"""The same world in SUMO and in the torch simulator: same observations, same next states, same events."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

from phase_sumo.bridge.fleet import adoption, fleet
from phase_sumo.bridge.fleet.parameters import Choice
from phase_sumo.bridge.fleet.route_views import RouteViews
from phase_sumo.bridge.fleet.table import STATE
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.bridge.sumo.conventions import yaw_from_angle
from phase_sumo.sim.observation import Observation
from tests.helpers.parity_scenes import RECKLESS_SCENE, SCENE, write_scenario
from tests.helpers.places import NETWORKS
from tests.helpers.standin import Standin
from tests.parity.recording import Recording, SumoStep, record
from tests.parity.replay import Replay


@pytest.mark.parametrize(
    ("road", "step"),
    [("f12_scurve2", 0.1), ("f12_scurve2", 0.5), ("f04_onramp3", 0.1), ("f20_lefthand2", 1.0)],
)
def test_observations_and_next_states(tmp_path, monkeypatch, road, step):
    """Sub-steps of a long SUMO step included; vehicles that SUMO drives are copied from there.

    All see what their places show: along routes, where a place shows another road, only the bridge looks.
    """
    nothing = staticmethod(
        lambda table, node, routes: (np.full(len(node), -1), np.zeros(len(node), np.int64))
    )
    monkeypatch.setattr(RouteViews, "seen", nothing)
    network, driver = read_network(NETWORKS / f"{road}.net.xml"), Standin()
    kept = record(
        write_scenario(tmp_path, road, SCENE, step), network, driver, until=8.0 if step == 1.0 else 12.0
    )
    start = check_start(kept)
    replay = Replay(network, kept, start, driver.sim)
    sumo_after = {s.decisions: s for s in kept.steps}
    for number, decision in enumerate(kept.decisions, 1):
        assert len(decision.ids) == 6 and len(decision.others) == 2
        same_observation(replay.see(decision), decision.seen)
        replay.act(decision)
        if number in sumo_after:
            same_states(replay, sumo_after[number], kept, decision.ids)
    assert len(kept.decisions) >= 70
    moved = kept.steps[-1].table
    assert max(abs(moved[v]["y"] - start.table[v]["y"]) for v in moved) > 2.0  # a curve, or a lane change
    if road == "f12_scurve2":
        assert max(abs(step.table["semi0"]["hitch"]) for step in kept.steps if step.table) > 0.005


def check_start(kept: Recording) -> SumoStep:
    """The first step with vehicles: the model's state there is SUMO's pose, by the bumper's definition."""
    start = next(step for step in kept.steps if step.table)
    for vehicle, (x, y, angle) in start.pose.items():
        state, shape = start.table[vehicle], kept.shapes[vehicle]
        yaw, ahead = np.radians(90.0 - angle), shape.length - shape.rear_overhang
        found = np.array([state["x"] + ahead * np.cos(yaw), state["y"] + ahead * np.sin(yaw)])
        np.testing.assert_allclose(found, (x, y), rtol=0, atol=1e-4)
        assert np.sin(yaw - state["yaw"]) == pytest.approx(0.0, abs=1e-6)
    return start


def same_observation(here: Observation, there: Observation) -> None:
    """All scaled features, neighbours in the same order."""
    for part in fields(Observation):
        mine, theirs = getattr(here, part.name), getattr(there, part.name)
        torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-5)


def same_states(replay: Replay, sumo: SumoStep, kept: Recording, vehicles: list[str]) -> None:
    """The bridge's table and SUMO's own pose against the simulator."""
    for vehicle in vehicles:
        slot, shape = replay.slot[vehicle], kept.shapes[vehicle]
        here = {name: getattr(replay.state, name)[0, slot].numpy() for name in STATE}
        for name in STATE:
            np.testing.assert_allclose(sumo.table[vehicle][name], here[name], rtol=0, atol=1e-5, err_msg=name)
        x, y, angle = sumo.pose[vehicle]
        ahead = shape.length - shape.rear_overhang
        bumper = here["x"] + ahead * np.cos(here["yaw"]), here["y"] + ahead * np.sin(here["yaw"])
        np.testing.assert_allclose((x, y), bumper, rtol=0, atol=1e-4)
        assert np.sin(yaw_from_angle(angle) - here["yaw"]) == pytest.approx(0.0, abs=1e-6)


def test_a_difference_would_be_seen(tmp_path):
    """A tenth of a millimetre, a goal or a neighbour's place: none of them passes the comparison."""
    network, driver = read_network(NETWORKS / "f12_scurve2.net.xml"), Standin()
    kept = record(write_scenario(tmp_path, "f12_scurve2", SCENE), network, driver, until=1.0)
    start, decision = check_start(kept), kept.decisions[0]
    replay = Replay(network, kept, start, driver.sim)
    replay.state.y[0, replay.slot["car1"]] += 2e-3
    with pytest.raises(AssertionError):
        same_observation(replay.see(decision), decision.seen)
    replay = Replay(network, kept, start, driver.sim)
    decision.tokens[0] += 9
    replay.see(decision)
    replay.act(decision)
    with pytest.raises(AssertionError):
        same_states(replay, next(s for s in kept.steps if s.decisions == 1), kept, decision.ids)


def test_collisions_and_road_edges(tmp_path, monkeypatch):
    """Who touches whom, when, and at whose fault; and who touches the road edge."""
    monkeypatch.setattr(adoption, "TOO_FAST", np.inf)  # reckless ones are meant to be PHASE's from the start
    monkeypatch.setattr(fleet, "EDGE_SECONDS", 0.0)  # and to the end
    network, driver = read_network(NETWORKS / "f12_scurve2.net.xml"), Standin(reckless=True)
    cfg = write_scenario(tmp_path, "f12_scurve2", RECKLESS_SCENE)
    kept = record(cfg, network, driver, until=7.0, choice=Choice(alpha=0.8, time_gap=0.0, guard=False))
    replay = Replay(network, kept, check_start(kept), driver.sim)
    sumo_after = {s.decisions: s for s in kept.steps}
    collided: set[str] = set()
    rear_enders: set[str] = set()
    here_edge: set[str] = set()
    for number, decision in enumerate(kept.decisions, 1):
        sumo = sumo_after[number]
        replay.see(decision)
        here_collided, here_at_fault, here_edge = replay.act(decision)
        new = set().union(*(pair for pair, _ in sumo.contacts)) - collided
        at_fault = set().union(*(guilty for _, guilty in sumo.contacts)) & new
        assert here_collided - collided == new, sumo.time
        assert here_at_fault & new == at_fault, sumo.time  # one contact, one verdict: at its beginning
        assert len(here_edge) == sumo.off_road, sumo.time
        collided |= new
        rear_enders |= at_fault
    assert rear_enders == {"rear0", "rear1", "rear2"}
    assert {"semi0", "rigid0", "car0"} <= collided
    assert "astray0" in here_edge
