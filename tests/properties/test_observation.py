"""What must not matter to an observation, and what must."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from phase_sumo.config import SimConfig
from phase_sumo.sim.neighbours import nearest
from phase_sumo.sim.observation import EGO, PARTNER, ROAD
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.step import look as look_at
from tests.helpers.factories import car_shape, task_to, truck_shape, vehicle_state

SIM = SimConfig()
NAMES = {
    group: [f.name for f in features]
    for group, features in (("ego", EGO), ("partner", PARTNER), ("road", ROAD))
}
MAP = torch.zeros(1, dtype=torch.long)


def scene(count: int = 12, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> list[float]:
        return (low + (high - low) * torch.rand(count, generator=generator)).tolist()

    shape = car_shape(count).where(torch.rand(1, count, generator=generator) < 0.6, truck_shape(count))
    state = vehicle_state(
        draw(100, 300), draw(-1, 8), draw(-0.1, 0.1), draw(0, 30), draw(-0.05, 0.05), count=count
    )
    task = task_to(draw(320, 380), draw(0, 7), draw(-0.1, 0.1), draw(5, 30), draw(0.1, 1.0), count)
    return shape, state, task


def look(straight_map, shape, state, task, active=None, road: RoadMap | None = None, noise=None):
    active = torch.ones_like(state.x, dtype=torch.bool) if active is None else active
    road = road or straight_map.road_map
    return look_at(shape, state, task, active, road, MAP, noise, SIM).rows(active)


def moved(road: RoadMap, dx: float, dy: float) -> RoadMap:
    """The road shifted by whole grid squares."""
    shift = torch.tensor([dx, dy])
    view, border = road.view.clone(), road.border.clone()
    view[:, :2] += shift.unsqueeze(-1)
    border[:, :4] += shift.repeat(2).unsqueeze(-1)
    return replace(road, view=view, border=border, grid_origin=road.grid_origin + shift)


def test_values_by_hand(straight_map):
    shape = car_shape(2).where(torch.tensor([[True, False]]), truck_shape(2))
    state = vehicle_state(x=[100.0, 130.0], y=[0.0, 3.66], speed=[20.0, 15.0], count=2)
    seen = look(straight_map, shape, state, task_to(goal_x=180.0, goal_y=3.66, goal_speed=25.0, count=2))
    ego = dict(zip(NAMES["ego"], seen.ego[0].tolist(), strict=True))
    assert ego["speed"] * 20 == pytest.approx(20.0)
    assert ego["goal_x"] * 100 == pytest.approx(80.0)
    assert ego["goal_y"] * 10 == pytest.approx(3.66)
    assert ego["goal_speed_error"] * 5 == pytest.approx(5.0)
    assert ego["lane_yaw_error"] == pytest.approx(0.0, abs=1e-5)
    assert seen.partner_mask[0].tolist() == [True] + [False] * 15
    partner = dict(zip(NAMES["partner"], seen.partner[0, 0].tolist(), strict=True))
    centre = 130.0 + 3.5 - 0.7  # the tractor's box centre is half its length ahead of its rear
    assert partner["x"] * 50 == pytest.approx(centre - 100.0, rel=1e-5)
    assert partner["closing_speed"] * 10 == pytest.approx(5.0)
    assert partner["trailer_length"] * 10 == pytest.approx(16.0)


def test_shifting_the_world_changes_nothing(straight_map):
    shape, state, task = scene()
    here = look(straight_map, shape, state, task)
    dx, dy = 400.0, -80.0
    state.x, state.y = state.x + dx, state.y + dy
    task.goal_x, task.goal_y = task.goal_x + dx, task.goal_y + dy
    there = look(straight_map, shape, state, task, road=moved(straight_map.road_map, dx, dy))
    for a, b in zip(vars(here).values(), vars(there).values(), strict=True):
        torch.testing.assert_close(a, b, atol=2e-4, rtol=1e-4)


def test_turning_the_world_changes_nothing_about_ego_and_partners(straight_map):
    shape, state, task = scene()
    here = look(straight_map, shape, state, task)
    angle = 0.7
    cos, sin = math.cos(angle), math.sin(angle)
    for batch, x, y, yaw in ((state, "x", "y", "yaw"), (task, "goal_x", "goal_y", "goal_yaw")):
        old_x, old_y = getattr(batch, x), getattr(batch, y)
        setattr(batch, x, cos * old_x - sin * old_y)
        setattr(batch, y, sin * old_x + cos * old_y)
        setattr(batch, yaw, getattr(batch, yaw) + angle)
    there = look(straight_map, shape, state, task)
    free_of_road = [i for i, name in enumerate(NAMES["ego"]) if name != "lane_yaw_error"]
    torch.testing.assert_close(here.ego[:, free_of_road], there.ego[:, free_of_road], atol=2e-4, rtol=1e-4)
    torch.testing.assert_close(here.partner, there.partner, atol=2e-4, rtol=1e-4)


def test_the_order_of_the_slots_does_not_matter(straight_map):
    shape, state, task = scene()
    here = look(straight_map, shape, state, task)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(3))
    shape, state, task = (batch.map(lambda t: t[:, order]) for batch in (shape, state, task))
    there = look(straight_map, shape, state, task)
    for a, b in zip(vars(here).values(), vars(there).values(), strict=True):
        torch.testing.assert_close(a[order], b)


def test_empty_slots_are_not_seen(straight_map):
    shape, state, task = scene()
    active = torch.ones(1, 12, dtype=torch.bool)
    active[:, 8:] = False
    with_padding = look(straight_map, shape, state, task, active)
    shape, state, task = (batch.map(lambda t: t[:, :8]) for batch in (shape, state, task))
    without = look(straight_map, shape, state, task)
    assert len(with_padding) == 8
    for a, b in zip(vars(with_padding).values(), vars(without).values(), strict=True):
        torch.testing.assert_close(a, b)


def test_the_sixteen_nearest_are_seen_nearest_first(straight_map):
    count = 30
    shape, state = car_shape(count), vehicle_state(x=[100.0 + 5 * k for k in range(count)], count=count)
    index, mask = nearest(state.x, state.y, torch.ones(1, count, dtype=torch.bool), SIM)
    assert index[0, 0].tolist() == list(range(1, 17)) and mask[0, 0].all()
    assert shape.length.shape == (1, count)


def test_noise_perturbs_partners_and_road_and_spares_the_ego(straight_map):
    shape, state, task = scene()
    clean = look(straight_map, shape, state, task)
    generator = torch.Generator().manual_seed(1)
    noise = (torch.randn(1, 12, 4, 16, generator=generator), torch.randn(1, 12, 2, 32, generator=generator))
    first = look(straight_map, shape, state, task, noise=noise)
    torch.testing.assert_close(first.ego, clean.ego)
    spread = (first.road[..., 0] - clean.road[..., 0])[clean.road_mask] * 50.0
    assert 0.5 * SIM.position_noise < spread.std().item() < 1.5 * SIM.position_noise


def test_road_points_show_lanes_and_both_edges(straight_map):
    seen = look(straight_map, car_shape(), vehicle_state(x=200.0), task_to())
    road = dict(zip(NAMES["road"], seen.road[0].unbind(-1), strict=True))
    centres = road["lane_centre"] > 0.5
    edges = road["road_edge"] > 0.5
    assert (road["y"][centres].abs() * 10 < 0.01).any()
    ys = (road["y"][edges] * 10).tolist()
    assert any(abs(y + 1.83) < 0.1 for y in ys) and any(abs(y - 9.15) < 0.1 for y in ys)
    assert (road["x"][centres] * 50).max() > 50.0
