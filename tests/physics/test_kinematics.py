"""The bicycle and trailer model against closed forms and an independent integrator."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from phase_sumo.config import ActionConfig, DirectActionConfig, SimConfig
from phase_sumo.sim.kinematics import advance, command, steer_limit
from tests.helpers.factories import car_shape, truck_shape, vehicle_state
from tests.physics.oracle import NAMES, integrate

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


def test_all_points_of_a_turn_lie_on_one_circle():
    """The yaw of mid-step is that of the chord, so the radius is v dt / 2 / sin(yaw rate dt / 2) exactly."""
    shape, steer, speed = car_shape(), 0.2, 8.0
    turn = speed * math.tan(steer) / shape.wheelbase.item() * SIM.dt
    radius = 0.5 * speed * SIM.dt / math.sin(0.5 * turn)
    state = vehicle_state(speed=speed, steer=steer)
    for _ in range(200):
        state = advance(shape, state, ZERO, ZERO, SIM)
        assert math.hypot(state.x.item(), state.y.item() - radius) == pytest.approx(radius, rel=5e-5)


@pytest.mark.parametrize(
    ("speed", "jerk", "bound"), [(39.7, 5.0, 40.0), (40.0, 5.0, 40.0), (0.3, -8.0, 0.0), (0.0, -8.0, 0.0)]
)
def test_speed_stops_at_its_bounds_and_acceleration_is_what_is_left_of_it(
    speed: float, jerk: float, bound: float
):
    state, shape = vehicle_state(speed=speed), car_shape()
    for _ in range(20):
        after = advance(shape, state, torch.full((1, 1), jerk), ZERO, SIM)
        assert (after.speed - state.speed).item() / SIM.dt == pytest.approx(after.accel.item(), abs=1e-4)
        assert (after.x - state.x).item() == pytest.approx(after.speed.item() * SIM.dt, abs=1e-5)
        state = after
    assert state.speed.item() == bound and state.accel.item() == 0.0


@pytest.mark.parametrize(
    ("make", "bounds"), [(car_shape, SIM.accel_bounds), (truck_shape, SIM.truck_accel_bounds)]
)
def test_acceleration_stops_at_the_bounds_of_the_vehicles_class(make, bounds):
    for jerk, bound in zip((-8.0, 5.0), bounds, strict=True):
        state = vehicle_state(speed=20.0)
        for _ in range(12):
            state = advance(make(), state, torch.full((1, 1), jerk), ZERO, SIM)
        assert state.accel.item() == pytest.approx(bound)


@pytest.mark.parametrize("speed", [0.0, 1e-4, 0.05, 40.0])
def test_everything_is_finite_at_the_ends_of_the_speed_range(speed: float):
    """Also with the wheels at their stops and the trailer folded."""
    count = 9
    steer = [-0.7, 0.0, 0.7] * 3
    hitch = [-math.pi / 2] * 3 + [0.0] * 3 + [math.pi / 2] * 3
    for make in (car_shape, truck_shape):
        state = vehicle_state(speed=speed, steer=steer, hitch=hitch, count=count)
        for jerk in (-8.0, 0.0, 5.0):
            for rate in (-0.3, 0.0, 0.3):
                after = advance(
                    make(count), state, torch.full((1, count), jerk), torch.full((1, count), rate), SIM
                )
                assert all(t.isfinite().all() for t in vars(after).values())
                assert ((after.speed >= 0) & (after.speed <= SIM.max_speed)).all()


def test_steering_is_bounded_by_the_stop_and_by_the_grip():
    """v^2 tan(steer) / wheelbase never exceeds the lateral acceleration of the class."""
    for make, grip in ((car_shape, SIM.lateral_accel), (truck_shape, SIM.truck_lateral_accel)):
        for speed in (0.5, 5.0, 15.0, 40.0):
            state, shape = vehicle_state(speed=speed), make()
            for _ in range(40):
                state = advance(shape, state, ZERO, torch.full((1, 1), 0.3), SIM)
            lateral = speed**2 * math.tan(state.steer.item()) / shape.wheelbase.item()
            assert lateral <= grip * (1 + 1e-5) and state.steer.item() <= SIM.max_steer + 1e-6
            assert lateral == pytest.approx(grip, rel=1e-4) or state.steer.item() == pytest.approx(
                SIM.max_steer
            )


CASES = {
    "held": ([0, 0, 0, 10, 0, 0.06, 0.02], (0.0, 0.0)),
    "accelerating": ([0, 0, 0, 10, 0.3, 0.06, 0], (0.4, 0.0)),
    "steering": ([0, 0, 0, 10, 0, 0, 0], (0.0, 0.03)),
}


@pytest.mark.parametrize(
    ("case", "quantity", "order", "worst"),
    [
        ("held", "position", 2, 2e-4),
        ("held", "hitch", 1, 2e-3),
        ("accelerating", "position", 1, 0.3),
        ("accelerating", "speed", 1, 0.07),
        ("accelerating", "yaw", 1, 4e-3),
        ("accelerating", "hitch", 1, 2e-3),
        ("steering", "position", 1, 0.2),
        ("steering", "yaw", 1, 0.015),
        ("steering", "hitch", 1, 0.01),
    ],
)
def test_order_of_convergence(case: str, quantity: str, order: int, worst: float):
    """Halving the step divides the error by 2^order; ``worst`` is the error allowed at 0.1 s, after 3.2 s.

    Under a held command the path is of second order, thanks to the yaw of mid-step. Commands act at the
    beginning of a step (semi-implicit Euler), which is of first order.
    """
    start, (jerk, rate) = CASES[case]
    shape = truck_shape().map(lambda t: t.double() if t.is_floating_point() else t)
    exact = integrate(
        np.array(start), lambda t: (jerk, rate), 3.2, 1e-3, shape.wheelbase.item(), shape.trailer_base.item()
    )
    errors = []
    for dt in (0.1, 0.05, 0.025):
        state = vehicle_state().map(lambda t: t.double())
        state = dataclasses.replace(
            state, **{n: torch.full((1, 1), float(v)).double() for n, v in zip(NAMES, start, strict=True)}
        )
        for _ in range(round(3.2 / dt)):
            j, r = (torch.full((1, 1), value, dtype=torch.float64) for value in (jerk, rate))
            state = advance(shape, state, j, r, dataclasses.replace(SIM, dt=dt))
        off = {n: abs(getattr(state, n).item() - v) for n, v in zip(NAMES, exact, strict=True)}
        errors.append(math.hypot(off["x"], off["y"]) if quantity == "position" else off[quantity])
    assert errors[0] < worst, errors
    for coarse, fine in pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(order, abs=0.1), errors


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
    state = vehicle_state(speed=10.0, count=actions.count)
    full = command(tokens, state, torch.ones(1, actions.count), actions, SIM.dt)
    half = command(tokens, state, torch.full((1, actions.count), 0.5), actions, SIM.dt)
    pairs = {
        (round(j, 4), round(r, 4)) for j, r in zip(full[0][0].tolist(), full[1][0].tolist(), strict=True)
    }
    assert len(pairs) == len(actions.jerk) * len(actions.steering_rate)
    torch.testing.assert_close(half[0], 0.5 * full[0])
    torch.testing.assert_close(half[1], full[1])


def test_the_baselines_lattice_sets_acceleration_and_steering_angle_at_once():
    actions = DirectActionConfig()
    tokens = torch.arange(actions.count).unsqueeze(0)
    state = vehicle_state(speed=2.0, steer=0.2, count=actions.count)
    jerk, rate = command(tokens, state, torch.full(tokens.shape, 0.1), actions, SIM.dt)
    after = advance(car_shape(actions.count), state, jerk, rate, SIM)
    accel, steer = torch.meshgrid(*map(torch.tensor, actions.axes), indexing="ij")
    torch.testing.assert_close(after.accel, accel.reshape(1, -1))
    wanted = steer.reshape(1, -1).clamp(-SIM.max_steer, SIM.max_steer)  # the wheel's stop
    torch.testing.assert_close(after.steer, wanted)
    coarsest = min(angle for angle in actions.steer if angle > 0)
    assert (actions.count, len(actions.accel)) == (91, 7) and coarsest == pytest.approx(0.524, abs=1e-3)


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
