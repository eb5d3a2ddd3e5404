"""The guard: what it lets pass, what it keeps from whom, and what it does instead."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phase_sumo.config import GuardConfig, ScenarioConfig, TaskConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.fallback import LOOKED_AT, braking
from phase_sumo.sim.guard import Decision, of_worlds
from phase_sumo.sim.hazards import Reason
from phase_sumo.sim.path import Path
from tests.helpers.factories import task_to
from tests.helpers.guarding import ACTIONS, GUARD, SIM, drive, shapes, states, wanting
from tests.helpers.rollouts import place, token

CARS = torch.zeros(1, 2, dtype=torch.bool)
MIDDLE = 3.66  # m, centre of the middle lane


def pair(ahead: float, aside: float, speeds: tuple[float, float], truck=(False, False), alpha: float = 1.0):
    """A world of an ego in the middle lane at x = 100 and another ``ahead`` and ``aside`` to the left."""
    x, y = torch.tensor([[100.0, 100.0 + ahead]]), torch.tensor([[MIDDLE, MIDDLE + aside]])
    state = states(x, y, torch.tensor([speeds]))
    return place(shapes(torch.tensor([truck])), state, task_to(count=2, alpha=alpha))


def decide(worlds, road_map, scores: torch.Tensor) -> Decision:
    every = scores.unsqueeze(1).expand(-1, 2, -1)
    return of_worlds(every, worlds, road_map, torch.zeros(1, dtype=torch.long), ACTIONS, SIM, GUARD)


@pytest.mark.parametrize(("jerk", "rate"), [(5.0, 0.0), (-8.0, 0.005), (0.0, -0.02)])
def test_what_is_safe_is_done_as_wanted(straight_map, jerk, rate):
    got = decide(pair(60.0, 0.0, (25.0, 25.0)), straight_map.road_map, wanting(jerk, rate, 1))
    assert got.token[0, 0] == token(jerk, rate)
    assert got.jerk[0, 0].item() == pytest.approx(jerk) and got.rate[0, 0].item() == pytest.approx(rate)
    assert got.reason[0, 0] == Reason.NONE and not got.unsafe[0, 0]


@pytest.mark.parametrize(
    ("ahead", "aside", "speeds", "reason"),
    [
        (12.0, 0.0, (25.0, 20.0), Reason.LEADER),
        (40.0, 0.0, (24.0, 0.0), Reason.STANDING),
        (12.0, MIDDLE, (25.0, 20.0), Reason.NONE),  # in the lane beside
        (-12.0, 0.0, (20.0, 25.0), Reason.NONE),  # behind
    ],
)
def test_leaders_are_those_ahead_in_the_lane(straight_map, ahead, aside, speeds, reason):
    got = decide(pair(ahead, aside, speeds), straight_map.road_map, wanting(5.0, 0.0, 1))
    assert got.reason[0, 0] == reason
    assert (got.jerk[0, 0] < 0) == (reason != Reason.NONE)


@pytest.mark.parametrize("alpha", [0.1, 1.0])
def test_alpha_does_not_limit_how_hard_is_braked(straight_map, alpha):
    got = decide(pair(36.0, 0.0, (22.0, 0.0), alpha=alpha), straight_map.road_map, wanting(5.0, 0.0, 1))
    assert got.jerk[0, 0] < -8.0


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("truck", [False, True])
def test_nobody_is_steered_into(straight_map, side, truck):
    """Beside a car, and beside a trailer whose tractor is 12 m ahead."""
    worlds = pair(12.0 if truck else 0.5, side * MIDDLE, (20.0, 20.0), (False, truck))
    y = worlds.state.y + torch.tensor([[0.6 * side, 0.0]])
    turning = replace(worlds.state, y=y, yaw=torch.tensor([[0.1 * side, 0.0]]))
    got = decide(replace(worlds, state=turning), straight_map.road_map, wanting(0.0, 0.3 * side, 1))
    assert got.reason[0, 0] == Reason.BESIDE and got.rate[0, 0] * side < 0.1
    away = decide(worlds, straight_map.road_map, wanting(0.0, -0.005 * side, 1))
    assert away.reason[0, 0] == Reason.NONE


def test_it_does_not_cut_in_before_who_could_not_brake(straight_map):
    """A car comes from behind in the left lane, much faster and near, or as fast as the ego."""
    for speed, reason in ((36.0, Reason.BESIDE), (20.0, Reason.NONE)):
        worlds = pair(-18.0, MIDDLE, (20.0, speed))
        turning = replace(
            worlds.state, yaw=torch.tensor([[0.08, 0.0]]), y=worlds.state.y + torch.tensor([[0.9, 0.0]])
        )
        got = decide(replace(worlds, state=turning), straight_map.road_map, wanting(0.0, 0.02, 1))
        assert got.reason[0, 0] == reason


def test_who_is_at_the_road_edge_is_not_steered_off(straight_map):
    worlds = pair(80.0, MIDDLE, (20.0, 20.0))
    near = replace(worlds.state, y=torch.tensor([[-0.4, MIDDLE]]), yaw=torch.tensor([[-0.03, 0.0]]))
    got = decide(replace(worlds, state=near), straight_map.road_map, wanting(0.0, -0.08, 1))
    assert got.reason[0, 0] == Reason.ROAD_EDGE and got.rate[0, 0] > -0.08


@pytest.mark.parametrize("rate", [0.02, 0.08])
def test_who_is_over_the_road_edge_may_steer_back(straight_map, rate):
    """The car's right side is 0.5 m off the road, whose right edge is half a lane from the first lane."""
    worlds = pair(80.0, MIDDLE, (20.0, 20.0))
    over = replace(worlds.state, y=torch.tensor([[-0.5 * MIDDLE + 0.4, MIDDLE]]))
    got = decide(replace(worlds, state=over), straight_map.road_map, wanting(0.0, rate, 1))
    assert got.reason[0, 0] == Reason.NONE and got.rate[0, 0].item() == pytest.approx(rate)
    beyond = replace(worlds.state, y=torch.tensor([[-0.5 * MIDDLE - 0.7, MIDDLE]]))
    got = decide(replace(worlds, state=beyond), straight_map.road_map, wanting(0.0, rate, 1))
    assert got.reason[0, 0] == Reason.NONE and got.rate[0, 0].item() == pytest.approx(rate)


def test_of_unsafe_actions_the_guard_takes_the_likeliest_that_is_safe(straight_map):
    """At the largest gap at which what is wanted is unsafe; every action is judged alone for comparison."""
    scores, ahead = wanting(5.0, 0.0, 1), 30.0
    while (got := decide(pair(ahead, 0.0, (22.0, 20.0)), straight_map.road_map, scores)).reason[0, 0] == 0:
        ahead -= 0.1
    worlds = pair(ahead, 0.0, (22.0, 20.0))
    assert got.reason[0, 0] == Reason.LEADER and not got.unsafe[0, 0]
    safe = []
    for wanted in scores[0].argsort(descending=True).tolist():
        sure = 50.0 * torch.nn.functional.one_hot(torch.tensor([wanted]), ACTIONS.count)
        if decide(worlds, straight_map.road_map, sure).reason[0, 0] == Reason.NONE:
            safe.append(wanted)
    assert got.token[0, 0] == safe[0]


def test_the_fallback_is_what_the_vehicle_would_do():
    """Ways of `braking` against `kinematics.advance` with the emergency jerk, cars and trucks."""
    truck = torch.tensor([[False, True]])
    shape, state = shapes(truck), states(torch.zeros(1, 2), torch.zeros(1, 2), torch.tensor([[28.0, 17.0]]))
    state = replace(state, accel=torch.tensor([[1.5, -2.0]]))
    jerk = torch.tensor([[3.0, 5.0]])
    _, moved = braking(shape.map(lambda v: v[0]), state.map(lambda v: v[0]), jerk.T, SIM, GuardConfig())
    hardest = -torch.where(truck, GUARD.emergency_jerk[1], GUARD.emergency_jerk[0])
    for step in range(1, max(LOOKED_AT) + 1):
        state = kinematics.advance(shape, state, jerk, torch.zeros(1, 2), SIM)
        jerk = hardest
        if step in LOOKED_AT:
            torch.testing.assert_close(moved[:, 0, LOOKED_AT.index(step)], state.x[0], atol=1e-2, rtol=1e-4)
    assert (state.speed == 0).all()


def test_places_along_a_path_and_back():
    """On an arc of 60 m: s is the arc's length, d the distance from it; `at` is the inverse of `locate`."""
    turn = torch.arange(0.0, 1.3, 0.2)
    x, y = 60.0 * torch.sin(turn), 60.0 * (1.0 - torch.cos(turn))
    bend = torch.full_like(turn, 1.0 / 60.0)
    path = Path(*(v.unsqueeze(0).expand(40, -1) for v in (x, y, turn, 60.0 * turn, bend)))
    s, d = torch.linspace(-8.0, 70.0, 40), torch.linspace(-5.0, 5.0, 40)
    at = torch.stack(((60.0 - d) * torch.sin(s / 60.0), 60.0 - (60.0 - d) * torch.cos(s / 60.0)))
    found = path.locate(*at)
    torch.testing.assert_close(found[0], s, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(found[1], d, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(found[2], s / 60.0, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(torch.stack(path.at(s, d)), at, atol=1e-3, rtol=1e-4)


def test_a_guarded_environment_takes_scores_and_says_what_came_of_them(straight_map):
    """Full throttle for everybody: with the guard nobody is run into, without it many are."""
    dense = ScenarioConfig(agent_scale=0.6)
    rates, reasons = {}, 0
    for guard in (GuardConfig(), None):
        env = Environment(
            [straight_map],
            4,
            48,
            TaskConfig(sim=SIM, actions=ACTIONS, scenarios=dense),
            training=False,
            guard=guard,
        )
        hit, acted = 0, 0
        for _ in range(60):
            if guard is None:
                step = env.step(torch.full(env.worlds.active.shape, token(5.0, 0.0)))
            else:
                step = env.step(wanting(5.0, 0.0, 4).unsqueeze(1).expand(-1, 48, -1))
                reasons += int((env.decision.reason[step.active] > 0).sum())
            hit += int((step.outcome.at_fault & step.finished).sum())
            acted += int(step.finished.sum())
        rates[guard is not None] = hit / max(acted, 1)
    assert rates[True] == 0.0 < rates[False] and reasons > 0


def test_those_behind_are_not_the_guards_business(straight_map):
    """Somebody runs into the ego from behind in its own lane: it goes on as it wants."""
    shape = shapes(CARS)
    state = states(torch.tensor([[100.0, 90.0]]), torch.full((1, 2), MIDDLE), torch.tensor([[15.0, 25.0]]))
    zero = torch.zeros(1)
    course = drive(
        shape,
        state,
        lambda step, s: (zero, zero),
        lambda step, s: wanting(0.0, 0.0, 1),
        straight_map.road_map,
        15,
    )
    assert course.touched.all() and not course.ever("reason")
