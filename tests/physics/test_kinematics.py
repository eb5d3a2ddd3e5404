"""The bicycle and trailer model against closed forms and an independent integrator."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from phase_sumo.config import ActionConfig, SimConfig
from phase_sumo.sim.kinematics import advance, command, steer_limit
from tests.factories import car_shape, truck_shape, vehicle_state

SIM = SimConfig()
ZERO = torch.zeros(1, 1)


def test_straight_line_with_constant_jerk_matches_the_closed_form():
    fine = dataclasses.replace(SIM, dt=0.001, accel_bounds=(-50.0, 50.0))
    state = vehicle_state(speed=10.0)
    for _ in range(1000):
        state = advance(car_shape(), state, torch.full((1, 1), 2.0), ZERO, fine)
    assert state.accel.item() == pytest.approx(2.0, abs=1e-3)
    assert state.speed.item() == pytest.approx(11.0, abs=5e-3)
    assert state.x.item() == pytest.approx(10.0 + 2.0 / 6.0, abs=5e-3)
    assert state.y.item() == 0.0


def test_reported_speed_and_acceleration_are_the_differences_of_position_and_speed():
    state = vehicle_state(speed=12.0)
    after = advance(car_shape(), state, torch.full((1, 1), -4.0), ZERO, SIM)
    assert (after.x - state.x).item() / SIM.dt == pytest.approx(after.speed.item(), rel=1e-5)
    assert (after.speed - state.speed).item() / SIM.dt == pytest.approx(after.accel.item(), abs=1e-4)


def test_constant_steering_drives_a_circle_of_radius_wheelbase_over_tangent():
    shape, steer = car_shape(), 0.05
    radius = shape.wheelbase.item() / math.tan(steer)
    state = vehicle_state(speed=8.0, steer=steer)
    points = []
    for _ in range(600):
        state = advance(shape, state, ZERO, ZERO, SIM)
        points.append((state.x.item(), state.y.item()))
    distance = np.hypot(*(np.array(points) - (0.0, radius)).T)
    np.testing.assert_allclose(distance, radius, rtol=2e-4)


def test_steady_hitch_angle():
    """sin(hitch) = (trailer base / wheelbase) tan(steer)."""
    shape, steer = truck_shape(), 0.1
    state = vehicle_state(speed=5.0, steer=steer)
    for _ in range(600):
        state = advance(shape, state, ZERO, ZERO, SIM)
    expected = math.asin(shape.trailer_base.item() / shape.wheelbase.item() * math.tan(steer))
    assert state.hitch.item() == pytest.approx(expected, abs=1e-4)


def test_trailer_on_a_ramp_against_an_independent_fine_integrator():
    """A 10 m/s truck turns into a curve; RK4 with 1 ms steps of the continuous equations is the oracle."""
    shape, speed, rate = truck_shape(), 10.0, 0.04
    wheelbase, base = shape.wheelbase.item(), shape.trailer_base.item()

    def flow(s: np.ndarray, t: float) -> np.ndarray:
        steer = min(rate * t, 0.12)
        yaw_rate = speed * math.tan(steer) / wheelbase
        return np.array(
            [
                speed * math.cos(s[2]),
                speed * math.sin(s[2]),
                yaw_rate,
                yaw_rate - speed / base * math.sin(s[3]),
            ]
        )

    exact, h = np.zeros(4), 1e-3
    for k in range(6000):
        t = k * h
        k1 = flow(exact, t)
        k2 = flow(exact + 0.5 * h * k1, t + 0.5 * h)
        k3 = flow(exact + 0.5 * h * k2, t + 0.5 * h)
        k4 = flow(exact + h * k3, t + h)
        exact = exact + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    state = vehicle_state(speed=speed)
    for k in range(60):
        state = advance(shape, state, ZERO, torch.full((1, 1), rate if k < 30 else 0.0), SIM)
    assert math.hypot(state.x.item() - exact[0], state.y.item() - exact[1]) < 0.6
    assert state.hitch.item() == pytest.approx(exact[3], abs=0.01)


@pytest.mark.parametrize("quantity", ["x", "y", "yaw", "hitch"])
def test_first_order_convergence(quantity: str):
    """Halving the step halves the error (semi-implicit Euler)."""

    def at_end(dt: float) -> float:
        config = dataclasses.replace(SIM, dt=dt)
        state = vehicle_state(speed=10.0)
        for _ in range(round(3.0 / dt)):
            state = advance(
                truck_shape().map(lambda t: t.double() if t.is_floating_point() else t),
                state.map(lambda t: t.double()),
                torch.full((1, 1), 0.5, dtype=torch.float64),
                torch.full((1, 1), 0.03, dtype=torch.float64),
                config,
            )
        return getattr(state, quantity).item()

    reference = at_end(0.1 / 128)
    errors = [abs(at_end(dt) - reference) for dt in (0.1, 0.05, 0.025)]
    orders = [math.log2(errors[i] / errors[i + 1]) for i in range(2)]
    assert all(0.8 < order < 1.4 for order in orders), orders


def test_everything_is_finite_and_bounded_at_the_clamps():
    generator = torch.Generator().manual_seed(0)
    shape = truck_shape(64)
    state = vehicle_state(count=64)
    for _ in range(300):
        jerk = 60.0 * torch.randn(1, 64, generator=generator)
        rate = 3.0 * torch.randn(1, 64, generator=generator)
        state = advance(shape, state, jerk, rate, SIM)
        assert all(t.isfinite().all() for t in vars(state).values())
    assert state.speed.min() >= 0.0 and state.speed.max() <= SIM.max_speed
    assert state.hitch.abs().max() <= math.pi / 2
    assert (state.steer.abs() <= steer_limit(shape, state.speed, SIM) + 1e-6).all()


def test_a_standing_vehicle_stays_and_stores_no_deceleration():
    state = vehicle_state(speed=0.0)
    for _ in range(10):
        state = advance(car_shape(), state, torch.full((1, 1), -8.0), ZERO, SIM)
    assert state.x.item() == 0.0 and state.speed.item() == 0.0 and state.accel.item() == 0.0
    moving = advance(car_shape(), state, torch.full((1, 1), 5.0), ZERO, SIM)
    assert moving.speed.item() > 0.0


def test_command_decodes_the_lattice_and_alpha_scales_only_the_jerk():
    actions = ActionConfig()
    tokens = torch.arange(actions.count).unsqueeze(0)
    full = command(tokens, torch.ones(1, actions.count), actions)
    half = command(tokens, torch.full((1, actions.count), 0.5), actions)
    pairs = {
        (round(j, 4), round(r, 4)) for j, r in zip(full[0][0].tolist(), full[1][0].tolist(), strict=True)
    }
    assert len(pairs) == len(actions.jerk) * len(actions.steering_rate)
    torch.testing.assert_close(half[0], 0.5 * full[0])
    torch.testing.assert_close(half[1], full[1])


def _follow_circle(radius: float, speed: float, shape, laps: float) -> tuple[float, float]:
    """Greedy lattice driver on a circle from rest steering; returns the worst offset and lateral jerk."""
    actions = ActionConfig()
    state = vehicle_state(speed=speed)
    rates = torch.tensor(actions.steering_rate)
    worst = 0.0
    lateral = []
    for _ in range(round(laps * radius / (speed * SIM.dt))):
        centre = torch.tensor([0.0, radius])
        offset = radius - torch.linalg.vector_norm(state.xy[0, 0] - centre)
        along = torch.atan2(state.x - centre[0], centre[1] - state.y).item()
        yaw_error = math.remainder(state.yaw.item() - along, 2 * math.pi)
        wanted_curvature = 1.0 / radius - 0.3 * yaw_error * 4 / speed - 0.3 * offset.item() / speed**2 * 4
        wanted = math.atan(shape.wheelbase.item() * wanted_curvature)
        choice = rates[(state.steer.item() + rates * SIM.dt - wanted).abs().argmin()]
        state = advance(shape, state, ZERO, choice.view(1, 1), SIM)
        worst = max(worst, abs(offset.item()))
        lateral.append(speed**2 * math.tan(state.steer.item()) / shape.wheelbase.item())
    settled = np.diff(lateral[len(lateral) // 2 :]) / SIM.dt
    return worst, float(np.abs(settled).max())


@pytest.mark.parametrize(
    ("radius", "speed", "shape"),
    [
        (500.0, 30.0, car_shape()),
        (40.0, 8.0, car_shape()),
        (500.0, 25.0, truck_shape()),
        (40.0, 6.0, truck_shape()),
    ],
    ids=["car-500m-30mps", "car-40m-8mps", "truck-500m-25mps", "truck-40m-6mps"],
)
def test_the_lattice_drives_fast_bends_and_tight_ramps_smoothly(radius, speed, shape):
    """From straight wheels into the curve: within half a metre, and settled lateral jerk is mild."""
    worst, jerk = _follow_circle(radius, speed, shape, laps=1.0)
    assert worst < 0.5, worst
    assert jerk < 2.0, jerk
