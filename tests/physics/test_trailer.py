"""The trailer: steady turns, decay, tracking on a ramp, and the trailer's own geometry."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from phase_sumo.config import SimConfig
from phase_sumo.sim.kinematics import advance
from phase_sumo.sim.vehicles import VehicleShape, VehicleState, boxes
from tests.helpers.factories import car_shape, truck_shape, vehicle_state
from tests.physics.oracle import NAMES, integrate

SIM = SimConfig()
ZERO = torch.zeros(1, 1)


def truck(base: float) -> VehicleShape:
    return dataclasses.replace(truck_shape(), trailer_base=torch.full((1, 1), base))


def roll(shape: VehicleShape, state: VehicleState, steps: int, config: SimConfig = SIM) -> VehicleState:
    """With the steering held."""
    for _ in range(steps):
        state = advance(shape, state, ZERO, ZERO, config)
    return state


def trailer_axle(shape: VehicleShape, state: VehicleState) -> np.ndarray:
    """[2] m."""
    yaw, base = (state.yaw - state.hitch).item(), shape.trailer_base.item()
    return np.array([state.x.item() - base * math.cos(yaw), state.y.item() - base * math.sin(yaw)])


@pytest.mark.parametrize("base", [6.0, 12.8])
@pytest.mark.parametrize("radius", [-60.0, 25.0, 60.0, 400.0])
def test_the_steady_hitch_angle_on_a_circle(base: float, radius: float):
    """sin(hitch) = base / radius, and the trailer's axle runs on the circle of sqrt(radius^2 - base^2)."""
    shape = truck(base)
    steer = math.atan(shape.wheelbase.item() / radius)
    state = roll(shape, vehicle_state(speed=6.0, steer=steer), 400)
    assert state.hitch.item() == pytest.approx(math.asin(base / radius), rel=1e-4)
    yaw = state.yaw.item()
    centre = np.array([state.x.item() - radius * math.sin(yaw), state.y.item() + radius * math.cos(yaw)])
    distance = np.hypot(*(trailer_axle(shape, state) - centre))
    assert distance == pytest.approx(math.sqrt(radius**2 - base**2), abs=2e-3)


def test_a_bent_trailer_straightens_as_it_must():
    """On a straight line tan(hitch / 2) = tan(hitch_0 / 2) exp(-v t / l); the error halves with the step."""
    shape, speed, begin, seconds = truck_shape(), 10.0, 0.8, 3.0
    decay = math.exp(-speed * seconds / shape.trailer_base.item())
    exact = 2 * math.atan(math.tan(begin / 2) * decay)
    errors = []
    for dt in (0.1, 0.05, 0.025):
        config = dataclasses.replace(SIM, dt=dt)
        state = roll(shape, vehicle_state(speed=speed, hitch=begin), round(seconds / dt), config)
        assert state.y.item() == 0.0  # the trailer does not push the tractor
        errors.append(abs(state.hitch.item() - exact))
    assert errors[0] < 0.01
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.2)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.2)


def ramp(t: float) -> tuple[float, float]:
    """Jerk and steering rate through an exit ramp: brake, steer in, hold, steer out."""
    jerk = -0.6 if t < 2.0 else 0.6 if t < 4.0 else 0.0
    return jerk, 0.06 if 1.0 < t < 3.0 else -0.06 if 5.0 < t < 7.0 else 0.0


def test_a_trailer_on_a_ramp_against_an_independent_integrator():
    """8 s and 75 m of ramp; the oracle integrates the continuous equations at a hundredth of the step.

    The model applies a step's command at its beginning, the continuous one all through it, so that it runs
    half a step ahead: the errors are of first order and halve with the step.
    """
    shape = truck_shape()
    start = np.array([0, 0, 0, 11.0, 0, 0, 0])
    exact = integrate(start, ramp, 8.0, SIM.dt / 100, shape.wheelbase.item(), shape.trailer_base.item())
    assert exact[NAMES.index("yaw")] > 0.8 and exact[NAMES.index("speed")] < 9.0
    errors = []
    for dt in (SIM.dt, SIM.dt / 2, SIM.dt / 4):
        config = dataclasses.replace(SIM, dt=dt)
        state = vehicle_state(speed=11.0)
        for k in range(round(8.0 / dt)):
            jerk, rate = ramp((k + 0.5) * dt)
            state = advance(shape, state, torch.full((1, 1), jerk), torch.full((1, 1), rate), config)
        found = np.array([getattr(state, name).item() for name in NAMES])
        tractor = np.hypot(*(found - exact)[:2])
        yaw, base = exact[2] - exact[6], shape.trailer_base.item()
        axle = exact[:2] - base * np.array([math.cos(yaw), math.sin(yaw)])
        trailer = np.hypot(*(trailer_axle(shape, state) - axle))
        errors.append((tractor, trailer, abs(found[6] - exact[6])))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert errors[0][0] < 0.5 and errors[0][1] < 0.5 and errors[0][2] < 0.01, errors
    assert ((ratios > 1.8) & (ratios < 2.2)).all(), ratios


def test_the_trailers_axle_does_not_slip_sideways():
    """Per step it moves along the trailer, to second order in the step."""
    shape, slips = truck_shape(), []
    for dt in (0.1, 0.05):
        config = dataclasses.replace(SIM, dt=dt)
        state = roll(shape, vehicle_state(speed=12.0, steer=0.05), round(1.0 / dt), config)
        after = roll(shape, state, 1, config)
        move = trailer_axle(shape, after) - trailer_axle(shape, state)
        yaw = 0.5 * (state.yaw - state.hitch + after.yaw - after.hitch).item()
        slips.append(abs(move @ (-math.sin(yaw), math.cos(yaw))))
        assert move @ (math.cos(yaw), math.sin(yaw)) == pytest.approx(12.0 * dt, rel=0.05)
    assert slips[0] < 0.01 and slips[0] / slips[1] == pytest.approx(4.0, abs=0.6)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_turn_too_tight_folds_the_trailer_up_to_the_clip(side: float):
    """Where base / wheelbase tan(steer) > 1 there is no steady angle."""
    state = roll(truck_shape(), vehicle_state(speed=2.0, steer=side * 0.7), 300)
    assert state.hitch.item() == pytest.approx(side * math.pi / 2)


def test_without_motion_or_trailer_nothing_bends():
    bent = roll(truck_shape(), vehicle_state(speed=0.0, steer=0.3, hitch=0.4), 20)
    assert bent.hitch.item() == pytest.approx(0.4) and bent.yaw.item() == 0.0
    assert roll(car_shape(), vehicle_state(speed=8.0, steer=0.2), 50).hitch.item() == 0.0


def test_gradients_of_a_car_are_finite():
    """Its trailer base is 0, and 1 / 0 behind a `where` would leak into them."""
    speed = torch.tensor([[0.0, 20.0]], requires_grad=True)
    state = dataclasses.replace(vehicle_state(count=2), speed=speed)
    after = advance(car_shape(2), state, torch.zeros(1, 2), torch.zeros(1, 2), SIM)
    (after.x + after.hitch + after.yaw).sum().backward()
    assert speed.grad is not None and speed.grad.isfinite().all()


def test_the_boxes_of_a_bent_truck():
    """Front and rear edges of both boxes, from the hitch on the rear axle."""
    shape, state = truck_shape(), vehicle_state(x=5.0, y=-2.0, yaw=0.3, hitch=0.5)
    x, y, cos, sin, half_length, half_width = boxes(shape, state)[:, :, 0, 0].double().numpy()
    ends = [
        np.stack((x + sign * half_length * cos, y + sign * half_length * sin), -1) for sign in (1.0, -1.0)
    ]

    def beyond(metres: float, yaw: float) -> np.ndarray:
        return np.array([5.0, -2.0]) + metres * np.array([math.cos(yaw), math.sin(yaw)])

    expected = [[beyond(6.3, 0.3), beyond(0.9, -0.2)], [beyond(-0.7, 0.3), beyond(-15.1, -0.2)]]
    np.testing.assert_allclose(ends, expected, atol=1e-5)
    np.testing.assert_allclose(2 * half_width, [2.55, 2.6], rtol=1e-6)
