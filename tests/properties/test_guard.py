"""What the guard promises (`sim.guard`), against adversaries: drawn scenes, the ego wanting the worst."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.vehicles import VehicleState
from tests.helpers.guarding import ACTIONS, Course, drive, shapes, states
from tests.helpers.straight_road import straight_network

WIDTH = 3.66  # m, of a lane
MANY = [pytest.param(200), pytest.param(10_000, marks=pytest.mark.slow)]


@pytest.fixture(scope="module")
def road_map() -> RoadMap:
    return build_bundle(straight_network(3, 900.0)).road_map


class Draw:
    """Numbers for W scenes."""

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.generator = count, torch.Generator().manual_seed(seed)

    def __call__(self, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(self.count, generator=self.generator)

    def truck(self, share: float = 0.3) -> Tensor:
        return torch.rand(self.count, 2, generator=self.generator) < share

    def wild(self, most: float) -> Callable[[int, VehicleState], Tensor]:
        """Scores: full throttle and any steering up to ``most`` rad/s, another one in every step."""
        allowed = torch.tensor([k for k, rate in enumerate(ACTIONS.steering_rate) if abs(rate) <= most])
        jerk = torch.arange(len(ACTIONS.jerk), dtype=torch.float32)

        def scores(step: int, state: VehicleState) -> Tensor:
            rate = allowed[torch.randint(len(allowed), (self.count,), generator=self.generator)]
            like = torch.full((self.count, len(ACTIONS.jerk), len(ACTIONS.steering_rate)), -3.0)
            like[torch.arange(self.count), :, rate] = 0.0
            return (like + jerk.view(1, -1, 1)).flatten(1)

        return scores


def behind(draw: Draw, gap: Tensor, truck: Tensor, speed: Tensor, other_speed: Tensor, y: Tensor):
    """Shapes and states: the ego's front is ``gap`` m behind the other's rear, which is at ``y``."""
    shape = shapes(truck)
    front = shape.front_overhang[:, 0]
    trailer = shape.trailer_length - shape.trailer_setback
    rear = torch.where(truck, trailer, shape.rear_overhang)[:, 1]
    ego_x = torch.full_like(gap, 80.0)
    x = torch.stack((ego_x, ego_x + front + gap + rear), 1)
    accel = torch.stack((draw(-2.0, 1.8), torch.zeros_like(gap)), 1)
    place = torch.stack((torch.full_like(y, WIDTH), y), 1)
    return shape, states(x, place, torch.stack((speed, other_speed), 1), accel)


def braking_from(draw: Draw, truck: Tensor, latest: int):
    """A script: constant speed, then the hardest braking of the class, from a drawn step on."""
    begin, hardest = draw(0, latest), torch.where(truck[:, 1], -6.0, -8.0)
    return lambda step, state: (torch.where(step >= begin, hardest, 0.0), torch.zeros_like(hardest))


def held(course: Course, share: float) -> None:
    """Nobody who began safe has touched the other, and enough of the scenes began so."""
    safe = ~course.first("unsafe")
    assert safe.float().mean() > share, safe.float().mean()
    assert not (course.touched & safe).any(), (course.touched & safe).nonzero().flatten()[:10]


@pytest.mark.parametrize("count", MANY)
def test_leaders_brake_as_hard_as_they_can_from_any_speed(road_map, count):
    """Also standing ones and much slower ones, with gaps from too short to long."""
    draw = Draw(count, 0)
    truck, speed = draw.truck(), draw(0.0, 38.0)
    other = draw(-10.0, 36.0).clamp_min(0.0)
    shape, state = behind(draw, draw(0.6, 90.0), truck, speed, other, torch.full_like(speed, WIDTH))
    course = drive(shape, state, braking_from(draw, truck, 40), draw.wild(0.08), road_map, 80)
    held(course, 0.5)
    assert course.touched[course.first("unsafe")].any()  # the scenes can be lost


@pytest.mark.parametrize("count", MANY)
def test_somebody_cuts_in_half_a_second_ahead(road_map, count):
    """From the lane beside, at about the ego's speed, and brakes as hard as it can once it is there."""
    draw = Draw(count, 1)
    truck, speed = torch.zeros(count, 2, dtype=torch.bool), draw(8.0, 36.0)
    side = torch.where(draw(0, 1) < 0.5, -1.0, 1.0)
    other = speed + draw(-0.5, 3.0)
    shape, state = behind(draw, 0.5 * speed + 1.0, truck, speed, other, WIDTH + side * WIDTH)
    aside = -side * draw(0.5, 1.5)

    def script(step: int, state: VehicleState):
        there = (state.y[:, 1] - WIDTH) * side < 0.1
        return torch.where(there, -8.0, 0.0), torch.where(there, 0.0, aside)

    course = drive(shape, state, script, draw.wild(0.005), road_map, 70)
    held(course, 0.95)


@pytest.mark.parametrize("count", MANY)
def test_nobody_is_steered_into_who_is_beside(road_map, count):
    """Cars and tractor-trailers beside and a little behind; those behind brake for who is before them."""
    draw = Draw(count, 2)
    truck, speed = draw.truck(0.5), draw(5.0, 34.0)
    side = torch.where(draw(0, 1) < 0.5, -1.0, 1.0)
    shape, state = behind(draw, draw(-24.0, 2.0), truck, speed, speed + draw(-1.0, 1.0), WIDTH + side * WIDTH)
    hardest = torch.where(truck[:, 1], -6.0, -8.0)
    steady = -(torch.tensor(ACTIONS.jerk).abs()).view(1, -1, 1)

    def towards(step: int, state: VehicleState) -> Tensor:
        rate = torch.tensor(ACTIONS.steering_rate) * side.unsqueeze(1)
        noise = torch.rand(count, len(ACTIONS.steering_rate), generator=draw.generator)
        return (steady + (30.0 * rate + noise).unsqueeze(1)).flatten(1)

    def script(step: int, state: VehicleState):
        followed = (state.y[:, 0] - state.y[:, 1]).abs() < 3.4
        return torch.where(followed & (state.x[:, 0] > state.x[:, 1]), hardest, 0.0), 0.0 * speed

    course = drive(shape, state, script, towards, road_map, 60)
    held(course, 0.9)


@pytest.mark.parametrize("count", MANY)
def test_who_drifts_over_from_ahead_is_given_way(road_map, count):
    """The other's front is ahead and it comes over slowly.

    Nothing is promised, since nobody who is beside already has to make room. Most are let in; what is not
    avoided was called unsafe before.
    """
    draw = Draw(count, 3)
    truck, speed = torch.zeros(count, 2, dtype=torch.bool), draw(10.0, 34.0)
    side = torch.where(draw(0, 1) < 0.5, -1.0, 1.0)
    shape, state = behind(draw, draw(-2.5, 4.0), truck, speed, speed + draw(0.0, 2.0), WIDTH + side * WIDTH)
    aside = -side * draw(0.2, 0.6)

    def script(step: int, state: VehicleState):
        return 0.0 * aside, torch.where((state.y[:, 1] - WIDTH) * side < 0.1, 0.0, aside)

    course = drive(shape, state, script, draw.wild(0.005), road_map, 70)
    assert not (course.touched & ~course.ever("unsafe")).any()
    assert course.touched.float().mean() < 0.06, course.touched.float().mean()


RADIUS, BEFORE = 120.0, 200.0  # m: a quarter turn to the left behind a straight road


@pytest.mark.parametrize("count", MANY)
def test_somebody_stands_behind_a_curve(count):
    """On roads of one lane; the ego speeds up and follows the lane, cars and tractor-trailers alike."""
    turn = np.linspace(0.0, 0.5 * math.pi, 60)
    arc = np.stack((BEFORE + RADIUS * np.sin(turn), RADIUS * (1.0 - np.cos(turn))), 1)
    end = np.array([[BEFORE + RADIUS, RADIUS + 200.0]])
    points = np.concatenate((np.array([[0.0, 0.0]]), arc, end))
    lane = Lane("a_0", "a", points, WIDTH, 30.0, BEFORE + 0.5 * math.pi * RADIUS + 200.0, -1, -1)
    road_map = build_bundle(LaneNetwork("bend", (lane,), ())).road_map
    draw = Draw(count, 4)
    truck, at = draw.truck(), draw(0.35, 0.5 * math.pi)
    speed = torch.where(truck[:, 0], draw(6.0, 14.0), draw(6.0, 19.0))
    x = torch.stack((draw(120.0, 180.0), BEFORE + RADIUS * torch.sin(at)), 1)
    y = torch.stack((torch.zeros(count), RADIUS * (1.0 - torch.cos(at))), 1)
    still = torch.stack((speed, torch.zeros(count)), 1)
    state = states(x, y, still, yaw=torch.stack((torch.zeros(count), at), 1))
    shape = shapes(truck)
    rates, jerk = torch.tensor(ACTIONS.steering_rate), torch.tensor(ACTIONS.jerk)

    def along(step: int, state: VehicleState) -> Tensor:
        """Scores of steering towards the lane's centre and direction."""
        x, y = state.x[:, 0] - BEFORE, state.y[:, 0] - RADIUS
        bends = x > 0
        aside = torch.where(bends, RADIUS - torch.hypot(x, y), state.y[:, 0])
        askew = state.yaw[:, 0] - torch.where(bends, torch.atan2(x, -y), 0.0)
        bend = torch.where(x > -3.0, 1.0 / RADIUS, 0.0) - 0.15 * askew - 0.01 * aside
        steer = torch.atan(shape.wheelbase[:, 0] * bend)
        off = (rates - ((steer - state.steer[:, 0]) / 0.1).unsqueeze(1)).abs()
        return (jerk.view(1, -1, 1) - 50.0 * off.unsqueeze(1)).flatten(1)

    def stand(step: int, state: VehicleState):
        return torch.zeros(count), torch.zeros(count)

    course = drive(shape, state, stand, along, road_map, 150)
    held(course, 0.9)
    speed = course.states[-1].speed[:, 0]
    assert (speed < 0.5).float().mean() > 0.9  # they have come up to it, and stand
