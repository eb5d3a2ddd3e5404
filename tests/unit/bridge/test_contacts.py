"""Table and contacts: the parts of the fleet that need no simulation."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from phase_sumo.bridge.fleet.contacts import ContactMonitor
from phase_sumo.bridge.fleet.event_log import EventLog
from phase_sumo.bridge.fleet.pose import nearest_on_line
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.sumo.conventions import shape_from_type
from phase_sumo.config import SimConfig
from phase_sumo.sim import kinematics

CAR, SEMI = shape_from_type("passenger", 5.0, 1.8), shape_from_type("trailer", 22.0, 2.6)


def place(table, name, x, y, yaw=0.0, shape=CAR, controlled=False):
    row = table.add(name, shape)
    table["x"][row], table["y"][row], table["yaw"][row] = x, y, yaw
    table.controlled[row] = controlled
    return row


def log_of(table, time=1.0, lane="road_1"):
    """A log without a simulation: every vehicle is 50 m down the same lane."""
    vehicle = SimpleNamespace(getLaneID=lambda _: lane, getLanePosition=lambda _: 50.0)
    api = SimpleNamespace(vehicle=vehicle)
    session: Any = SimpleNamespace(time=time + 0.1, step_length=0.1, api=api, refused=KeyError)
    return EventLog(session, table, {})


def test_rows_are_reused_and_the_table_doubles():
    table = VehicleTable(2)
    for i in range(3):
        table.add(f"v{i}", CAR)
    assert len(table) == 4
    row = table.row_of["v1"]
    table.remove("v1")
    assert not table.active[row]
    assert table.add("v9", SEMI) == row
    assert table["trailer_length"][row] > 0
    assert table["hitch"][row] == 0


def test_torch_sees_the_memory_of_the_table():
    table = VehicleTable(4)
    row = place(table, "a", 1.0, 2.0)
    state = table.state()
    table["x"][row] = 7.0
    assert float(state.x[0, row]) == 7.0
    assert state.accel_history.shape == (1, 4, 3)


def test_trailer_of_a_sumo_vehicle_follows_as_in_the_kinematics():
    table, config = VehicleTable(2), SimConfig()
    row = place(table, "semi", 0.0, 0.0, shape=SEMI)
    table["speed"][row] = 15.0
    model, state = table.shape(), table.state().map(torch.clone)
    state.steer[0, row] = 0.02
    zero = torch.zeros(1, 2)
    for _ in range(50):
        state = kinematics.advance(model, state, zero, zero, config)
        x, y, yaw, speed = (np.array([float(getattr(state, n)[0, row])]) for n in ("x", "y", "yaw", "speed"))
        table.follow(np.array([row]), x, y, yaw, speed, np.zeros(1), config.dt)
    assert table["hitch"][row] == pytest.approx(float(state.hitch[0, row]), rel=0.03)
    assert table["hitch"][row] > 0.02


def test_one_event_per_contact_with_the_follower_at_fault():
    table = VehicleTable(4)
    log = log_of(table)
    monitor = ContactMonitor(log)
    follower = place(table, "b", 0.0, 0.0, controlled=True)
    place(table, "a", 4.5, 0.0)
    assert len(monitor.update(table, 1.0, {"b": "car"})) == 1
    assert monitor.update(table, 1.1, {}) == []
    (contact,) = log.of("collision")
    assert (contact.vehicle, contact.other, contact.type) == ("b", "a", "car")
    assert contact.fault and not contact.other_fault
    assert contact.phase_at_fault
    assert contact.seconds == pytest.approx(0.1)
    assert (contact.time, contact.lane, contact.position) == (1.0, "road_1", 50.0)
    table["x"][follower] = -20.0
    monitor.update(table, 1.2, {})
    monitor.update(table, 9.0, {})
    table["x"][follower] = 0.0
    assert len(monitor.update(table, 9.1, {})) == 1


def test_trailers_collide_too_and_gaps_do_not():
    table = VehicleTable(4)
    monitor = ContactMonitor(log_of(table))
    semi = place(table, "semi", 0.0, 0.0, shape=SEMI)
    car = place(table, "car", -12.0, 2.25)  # beside the trailer, 5 cm clear
    assert monitor.update(table, 0.0, {}) == []
    table["hitch"][semi] = 0.1  # the trailer's tail swings to the left, towards the car
    (contact,) = monitor.update(table, 0.1, {})
    assert {contact.vehicle: contact.box, contact.other: contact.other_box} == {
        "semi": "trailer",
        "car": "body",
    }
    table["x"][car] = -40.0
    assert monitor.update(table, 5.0, {}) == []


def test_roads_that_cross_on_another_level_are_no_contact():
    table = VehicleTable(4)
    apart: list[tuple[str, str]] = []
    monitor = ContactMonitor(log_of(table), lambda *pair: pair not in apart)
    place(table, "a", 0.0, 0.0)
    place(table, "b", 1.0, -1.0, yaw=np.pi / 2)
    apart.append(("a", "b"))
    assert monitor.update(table, 0.0, {}) == []
    apart.clear()  # at a crossing on one level any angle counts
    assert len(monitor.update(table, 0.1, {})) == 1


def test_the_vehicle_at_fault_comes_first_whatever_its_row():
    table = VehicleTable(4)
    monitor = ContactMonitor(log_of(table))
    place(table, "ahead", 4.5, 0.0)
    place(table, "behind", 0.0, 0.0, controlled=True)
    (contact,) = monitor.update(table, 1.0, {})
    assert (contact.vehicle, contact.other) == ("behind", "ahead")
    assert (contact.phase, contact.other_phase) == (True, False)
    assert (contact.fault, contact.other_fault) == (True, False)
    table["x"][table.row_of["behind"]], table["y"][table.row_of["behind"]] = 4.0, 1.5
    (abreast,) = ContactMonitor(log_of(table)).update(table, 9.0, {})
    assert abreast.fault and abreast.other_fault


def test_nearest_point_of_a_line():
    line = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    assert nearest_on_line(line, (4.0, 3.0)) == (4.0, 0.0)
    assert nearest_on_line(line, (12.0, 5.0)) == (10.0, 5.0)
    assert nearest_on_line(line, (-3.0, -4.0)) == (0.0, 0.0)
