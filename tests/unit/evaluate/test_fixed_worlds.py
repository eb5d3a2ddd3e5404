"""Worlds with given beginnings: what every agent draws depends on nothing but its own world."""

from __future__ import annotations

import torch

from phase_sumo.config import ActionConfig, SimConfig
from phase_sumo.evaluate.fixed_worlds import Start, drive, idle_driver, prior_driver
from phase_sumo.sim.bundle import MapBundle
from tests.helpers.factories import car_shape, task_to, vehicle_state


def start(worlds: int = 3) -> Start:
    """Three cars abreast at different speeds, alike in every world but for its number."""

    def everywhere(values: torch.Tensor) -> torch.Tensor:
        return values.repeat(worlds, *(1,) * (values.dim() - 1))

    shape = car_shape(3).map(everywhere)
    state = vehicle_state(50.0, [0.0, 3.66, 7.32], speed=[15.0, 20.0, 25.0], count=3).map(everywhere)
    task = task_to(160.0, [0.0, 3.66, 7.32], count=3).map(everywhere)
    active = torch.ones(worlds, 3, dtype=torch.bool)
    return Start(shape, state, task, active, torch.zeros(worlds, dtype=torch.long), torch.arange(worlds))


def ways(begin: Start, bundle: MapBundle, driver, seed: int = 0) -> torch.Tensor:
    """[T, W, N] actions of the first 20 steps."""
    steps = drive(begin, bundle.road_map, driver, SimConfig(), ActionConfig(), seed, sampled=True)
    return torch.stack([step.action for step, _ in zip(steps, range(20), strict=False)])


def test_without_command_a_vehicle_keeps_its_speed_and_reaches_what_lies_straight_ahead(straight_map):
    step = None
    for step in drive(
        start(1), straight_map.road_map, idle_driver(ActionConfig()), SimConfig(), ActionConfig()
    ):
        assert torch.equal(step.before.speed, start(1).state.speed)
    assert step is not None
    # 110 m take 7.3 s at 15 m/s, and the horizon is 9.1 s
    assert step.outcome.goal.tolist() == [[True, True, True]]


def test_worlds_draw_alike_in_any_company(straight_map):
    begin, driver = start(3), prior_driver(ActionConfig())
    together = ways(begin, straight_map, driver)
    alone = [ways(begin.map(lambda v, k=k: v[k : k + 1]), straight_map, driver) for k in range(3)]
    assert torch.equal(together, torch.cat(alone, 1))
    assert not torch.equal(together[:, 0], together[:, 1])
    assert not torch.equal(together, ways(begin, straight_map, driver, seed=1))
