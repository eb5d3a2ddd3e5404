"""Response curves, egos and the search, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import kendalltau

from phase_sumo.config import ActionConfig
from phase_sumo.evaluate.fixed_worlds import Start, idle_driver
from phase_sumo.evaluate.steering.egos import choose_egos
from phase_sumo.evaluate.steering.outcomes import Context, Stage
from phase_sumo.evaluate.steering.response import ResponseCurve, kendall_tau
from phase_sumo.studies.cross_entropy import Candidate, minimise
from tests.helpers.factories import car_shape, task_to, vehicle_state


def test_tau_is_scipys_without_ties_and_0_without_response():
    values = np.random.default_rng(0).normal(size=9)
    assert kendall_tau(values) == pytest.approx(kendalltau(np.arange(9), values)[0])
    assert kendall_tau([1.0, 1.0, 1.0]) == 0.0
    assert kendall_tau([1.0, 2.0, 2.0]) == pytest.approx(2 / 3)


def test_a_curve_knows_its_direction_and_leaves_out_choices_that_a_world_lacks():
    values = np.array([[3.0, 2.0, 1.0], [3.0, np.nan, 1.0], [1.0, 2.0, 3.0]])
    curve = ResponseCurve("kind", "most_accel", -1, ("a", "b", "c"), values)
    assert curve.tau().mean == pytest.approx(1 / 3)
    assert curve.monotone().mean == pytest.approx(2 / 3)
    assert [e.n for e in curve.at_levels()] == [3, 2, 3]


@pytest.fixture
def street() -> Start:
    """A car in the middle lane at 20 m/s, one 30 m ahead at 10 m/s, one behind on the left at 30 m/s."""
    state = vehicle_state([100.0, 130.0, 70.0], [3.66, 3.66, 7.32], speed=[20.0, 10.0, 30.0], count=3)
    task = task_to([250.0, 250.0, 300.0], [3.66, 3.66, 7.32], count=3)
    return Start(
        car_shape(3),
        state,
        task,
        torch.ones(1, 3, dtype=torch.bool),
        torch.zeros(1).long(),
        torch.zeros(1).long(),
    )


def test_an_ego_knows_its_lanes_and_partners(street, straight_map):
    (ego,) = choose_egos(street, [straight_map])
    assert (ego.slot, ego.ahead, ego.behind) == (0, 1, 2)
    for lane, y in ((-1, 0.0), (0, 3.66), (1, 7.32)):
        gx, gy, yaw = ego.goals[lane]
        assert gx == pytest.approx(100.0 + 6 * 20.0, abs=3.0)
        assert (gy, yaw) == (pytest.approx(y, abs=0.01), pytest.approx(0.0, abs=1e-3))
    assert ego.aside(np.array([150.0, 5.0])) == pytest.approx(1.34, abs=1e-3)


def test_outcomes_of_vehicles_that_keep_their_speed(street, straight_map):
    """Without command: 4 s x 20 m/s; the one ahead is reached after 30 m / 10 m/s, unless it is not asked."""
    egos = choose_egos(street, [straight_map])
    actions = ActionConfig()
    stage = Stage(street, egos, straight_map.road_map, idle_driver(actions), actions)
    (out,) = stage.outcomes([Context(lane=1)])
    assert out.mean_speed == out.final_speed == pytest.approx(20.0)
    assert out.distance == pytest.approx(80.0) and out.rms_accel == 0.0
    assert out.aside == pytest.approx(0.0, abs=1e-3)
    assert out.collision  # drives through the slow one ahead
    assert out.passed_ahead and out.passed_by_behind
    (truck,) = stage.outcomes([Context(kind="articulated_truck")])
    assert truck.passed_by_behind


def test_the_search_finds_a_minimum_and_its_choice_and_repeats_itself():
    def score(c: Candidate) -> float:
        return (c.numbers[0] - 0.8) ** 2 + (c.numbers[1] - 0.2) ** 2 + (0.0 if c.choices == (2,) else 1.0)

    tried = minimise(score, 2, [3], 160, seed=3)
    best, value = min(tried, key=lambda t: t[1])
    assert best.choices == (2,) and value < 1e-3
    assert value < min(v for _, v in tried[:16])  # better than drawing evenly
    assert tried == minimise(score, 2, [3], 160, seed=3)
    assert tried != minimise(score, 2, [3], 160, seed=4)


def test_the_search_goes_on_where_nothing_is_of_use():
    tried = minimise(lambda c: np.inf if len(c.numbers) else 0.0, 1, [], 40, seed=0)
    assert len(tried) == 40 and all(0.0 <= c.numbers[0] <= 1.0 for c, _ in tried)
