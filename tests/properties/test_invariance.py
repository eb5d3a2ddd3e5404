"""What must not matter to a whole step: where the world lies, empty slots, order, and other worlds."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.config import RewardConfig, SimConfig
from phase_sumo.sim.events import agent_contacts
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.road_map import RoadMap, merge
from phase_sumo.sim.step import look
from phase_sumo.sim.vehicles import Task, VehicleState, boxes
from phase_sumo.sim.worlds import Transition, Worlds
from tests.helpers.factories import car_shape, task_to, truck_shape, vehicle_state
from tests.helpers.rollouts import ACTIONS, drive, pick, place, token
from tests.helpers.straight_road import straight_network

SIM = SimConfig()
COUNT, STEPS = 14, 40
FLAGS = ("active", "terminated", "truncated", "finished")


def crowd(seed: int) -> tuple[Worlds, Tensor]:
    """A world [1, 14] of cars and trucks in disorder on the straight road, and wild actions [T, 1, 14]."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> list[float]:
        return (low + (high - low) * torch.rand(COUNT, generator=generator)).tolist()

    shape = car_shape(COUNT).where(torch.rand(1, COUNT, generator=generator) < 0.7, truck_shape(COUNT))
    x, y = draw(60, 200), draw(-1, 8)
    state = vehicle_state(x, y, draw(-0.1, 0.1), draw(3, 30), draw(-0.02, 0.02), draw(-0.1, 0.1), count=COUNT)
    state.hitch = torch.where(shape.articulated, state.hitch, 0.0)
    goal_x = [a + b for a, b in zip(x, draw(10, 90), strict=True)]
    task = task_to(goal_x, y, draw(-0.1, 0.1), draw(5, 30), draw(0.1, 1.0), COUNT)
    lattice = len(ACTIONS.steering_rate)
    jerk = torch.randint(len(ACTIONS.jerk), (STEPS, 1, COUNT), generator=generator)
    rate = torch.randint(
        1, lattice - 1, (STEPS, 1, COUNT), generator=generator
    )  # the strongest spins them off
    return place(shape, state, task), jerk * lattice + rate


def turned_network(network: LaneNetwork, angle: float, shift: tuple[float, float]) -> LaneNetwork:
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, sin], [-sin, cos]])
    return replace(network, lanes=tuple(replace(n, points=n.points @ turn + shift) for n in network.lanes))


@cache
def moved_road(angle: float, shift: tuple[float, float]) -> RoadMap:
    return build_bundle(turned_network(straight_network(), angle, shift)).road_map


def turned_worlds(worlds: Worlds, angle: float, shift: tuple[float, float]) -> Worlds:
    cos, sin = math.cos(angle), math.sin(angle)

    def point(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        x, y = x.double(), y.double()
        return (cos * x - sin * y + shift[0]).float(), (sin * x + cos * y + shift[1]).float()

    state, task = worlds.state, worlds.task
    x, y = point(state.x, state.y)
    goal_x, goal_y = point(task.goal_x, task.goal_y)
    return replace(
        worlds,
        state=VehicleState(**{**vars(state), "x": x, "y": y, "yaw": state.yaw + angle}),
        task=Task(**{**vars(task), "goal_x": goal_x, "goal_y": goal_y, "goal_yaw": task.goal_yaw + angle}),
    )


def agree(one: Transition, other: Transition, select=lambda t: t, tolerance: float = 0.0) -> None:
    """The same rewards, ends and outcomes; ``select`` picks from the first what the second has."""
    torch.testing.assert_close(select(one.reward), other.reward, rtol=tolerance, atol=tolerance)
    for name in FLAGS:
        assert torch.equal(select(getattr(one, name)), getattr(other, name)), name
    for name, happened in vars(one.outcome).items():
        assert torch.equal(select(happened), getattr(other.outcome, name)), name


def seen(worlds: Worlds, road_map: RoadMap, map_index: Tensor | None = None):
    index = torch.zeros(len(worlds.active), dtype=torch.long) if map_index is None else map_index
    agents = worlds.shape, worlds.state, worlds.task, worlds.active
    return look(*agents, road_map, index, None, SIM)


@pytest.mark.parametrize(
    ("angle", "shift"),
    [(0.0, (400.0, -80.0)), (0.5 * math.pi, (0.0, 0.0)), (math.pi, (48.0, 12.0)), (0.7, (-333.3, 77.7))],
    ids=["shifted", "quarter turn", "half turn", "any"],
)
@pytest.mark.parametrize("seed", range(2))
def test_turning_and_shifting_the_world_changes_nothing(straight_map, angle, shift, seed):
    """Road, vehicles and goals are moved, and the road is converted anew at its new place.

    Observations of ego and partners are compared along the way; which road points are shown depends on how
    the grid of 4 m cells lies, so those are compared for the shift only, which is by whole cells. So does
    E_i of a vehicle beside the road (see the last test here), which is why its weight is 0.
    """
    worlds, actions = crowd(seed)
    moved_map = moved_road(angle, shift)
    reward = RewardConfig(road_edge=0.0)
    here = drive(worlds, straight_map.road_map, actions, reward=reward)
    there = drive(turned_worlds(worlds, angle, shift), moved_map, actions, reward=reward)
    happened = torch.zeros(3)
    for step, ((one, mine), (other, theirs)) in enumerate(zip(here, there, strict=True)):
        agree(mine, theirs, tolerance=2e-3)
        assert torch.equal(one.active, other.active)
        outcome = mine.outcome
        happened += torch.stack([outcome.goal.sum(), outcome.at_fault.sum(), outcome.road_edge.sum()])
        if step % 10 == 0:
            a, b = seen(one, straight_map.road_map), seen(other, moved_map)
            rows = one.active
            torch.testing.assert_close(a.ego[rows], b.ego[rows], atol=3e-3, rtol=1e-3)
            torch.testing.assert_close(a.context[rows], b.context[rows])
            torch.testing.assert_close(a.partner[rows], b.partner[rows], atol=3e-3, rtol=1e-3)
            if angle == 0.0:
                torch.testing.assert_close(a.road[rows], b.road[rows], atol=3e-3, rtol=1e-3)
    assert (happened > 0).all(), happened


@pytest.mark.parametrize("seed", range(2))
def test_the_order_of_the_slots_does_not_matter(straight_map, seed):
    worlds, actions = crowd(seed)
    order = torch.randperm(COUNT, generator=torch.Generator().manual_seed(seed))
    mixed = pick(worlds, lambda t: t[:, order] if t.dim() > 1 else t)
    course = drive(worlds, straight_map.road_map, actions)
    other = drive(mixed, straight_map.road_map, actions[:, :, order])
    for (_, mine), (_, theirs) in zip(course, other, strict=True):
        agree(mine, theirs, lambda t: t[:, order])
    for (one, _), (two, _) in zip(course[::8], other[::8], strict=True):
        for values, mixed_values in zip(
            *(vars(seen(w, straight_map.road_map)).values() for w in (one, two)), strict=True
        ):
            torch.testing.assert_close(values[:, order], mixed_values)


@pytest.mark.parametrize("seed", range(2))
def test_empty_slots_do_not_matter_whatever_is_in_them(straight_map, seed):
    """Ghosts stand where the vehicles stand: they neither collide nor are seen."""
    worlds, actions = crowd(seed)
    padded = pick(worlds, lambda t: torch.cat((t, t.flip(1)), 1) if t.dim() > 1 else t)
    padded.active[:, COUNT:] = False
    noise = torch.randint(ACTIONS.count, actions.shape, generator=torch.Generator().manual_seed(seed))
    course = drive(worlds, straight_map.road_map, actions)
    other = drive(padded, straight_map.road_map, torch.cat((actions, noise), -1))
    for (_, mine), (_, theirs) in zip(course, other, strict=True):
        assert not theirs.finished[:, COUNT:].any() and (theirs.reward[:, COUNT:] == 0).all()
        theirs = replace(
            theirs,
            outcome=theirs.outcome.map(lambda t: t[:, :COUNT]),
            **{name: getattr(theirs, name)[:, :COUNT] for name in ("reward", *FLAGS)},
        )
        agree(mine, theirs)
    for (one, _), (two, _) in zip(course[::8], other[::8], strict=True):
        for values, padded_values in zip(
            *(vars(seen(w, straight_map.road_map)).values() for w in (one, two)), strict=True
        ):
            torch.testing.assert_close(values, padded_values[:, :COUNT])


def test_only_the_first_slots_need_be_looked_at_for_trailers(straight_map):
    """Telling how many slots may have a trailer changes nothing where that is true."""
    worlds, actions = crowd(1)
    order = worlds.shape.articulated[0].int().argsort(descending=True, stable=True)
    worlds = pick(worlds, lambda t: t[:, order] if t.dim() > 1 else t)
    trailers = int(worlds.shape.articulated.sum())
    assert 0 < trailers < COUNT
    everybody = drive(worlds, straight_map.road_map, actions)
    for (_, mine), (_, theirs) in zip(
        everybody, drive(worlds, straight_map.road_map, actions, trailers=trailers), strict=True
    ):
        agree(mine, theirs)


def test_worlds_together_are_the_worlds_one_by_one(straight_map):
    """On three maps; some begin again on the way. States bit for bit, rewards to the last bit but one."""
    maps = [straight_map.road_map] + [
        build_bundle(turned_network(straight_network(lanes), 0.4 * lanes, (50.0, 30.0))).road_map
        for lanes in (2, 4)
    ]
    map_index = torch.tensor([0, 1, 2, 0])
    places = [(0.0, (0.0, 0.0)), (0.8, (50.0, 30.0)), (1.6, (50.0, 30.0))]
    crowds = [crowd(seed) for seed in range(4)]
    single = [turned_worlds(worlds, *places[m]) for (worlds, _), m in zip(crowds, map_index, strict=True)]
    single[3].active[:, 1:] = False
    together = _stacked(single)
    actions = torch.cat([actions for _, actions in crowds], 1).repeat(2, 1, 1)
    whole = drive(together, merge(maps), actions, map_index)
    begun = 0
    for w, world in enumerate(single):
        alone = drive(world, maps[int(map_index[w])], actions[:, w : w + 1])
        for (one, mine), (other, theirs) in zip(whole, alone, strict=True):
            agree(mine, theirs, lambda t, w=w: t[w : w + 1], tolerance=1e-6)
            begun += int(theirs.over)
            for name, values in vars(one.state).items():
                assert torch.equal(values[w : w + 1], getattr(other.state, name)), name
    assert begun > 1


def _stacked(parts: list) -> Any:
    if isinstance(parts[0], Tensor):
        return torch.cat(parts)
    return type(parts[0])(**{name: _stacked([getattr(p, name) for p in parts]) for name in vars(parts[0])})


@pytest.mark.parametrize("seed", range(2))
def test_every_pair_that_collides_has_a_culprit_and_nobody_is_guilty_alone(straight_map, seed):
    """Along whole drives, every pair of vehicles by itself."""
    worlds, actions = crowd(seed)
    mine, other = torch.triu_indices(COUNT, COUNT, 1)
    collisions = 0
    for after, step in drive(worlds, straight_map.road_map, actions)[::4]:
        pairs = boxes(after.shape, after.state)[:, :, 0][:, :, torch.stack((mine, other), -1)]
        collision, guilty = agent_contacts(pairs, torch.ones(len(mine), 2, dtype=torch.bool), 2)
        assert torch.equal(collision[:, 0], collision[:, 1])
        assert torch.equal(guilty.any(-1), collision.any(-1))
        assert not (step.outcome.at_fault & ~step.outcome.collision).any()
        collisions += int(collision.any(-1).sum())
    assert collisions > 0


@pytest.mark.parametrize("speed", [0.0, 1e-3, 40.0])
@pytest.mark.parametrize("rho", [0.0, 1.0])
def test_everything_is_finite_where_divisions_could_fail(straight_map, speed: float, rho: float):
    """Standing, crawling and at the top speed, on the goal, on top of each other, off the map."""
    xs = [100.0, 100.0, 300.0, 499.0, 250.0, -4000.0]
    count = len(xs)
    shape = truck_shape(count).where(torch.arange(count).unsqueeze(0) % 2 == 0, car_shape(count))
    state = vehicle_state(xs, speed=speed, steer=[0.7, -0.7] * 3, hitch=[1.57, 0.0] * 3, count=count)
    task = task_to([100.0, 101.0, 300.0, 520.0, 400.0, -3900.0], 0.0, 0.0, [0.0, 40.0] * 3, 0.1, count)
    for jerk in (0, 3, 6):
        for rate in (0, 4, 8):
            actions = torch.full((5, 1, count), jerk * len(ACTIONS.steering_rate) + rate)
            for worlds, step in drive(place(shape, state, task), straight_map.road_map, actions, rho=rho):
                assert step.reward.isfinite().all()
                assert all(term.isfinite() for term in step.terms.values())
                assert all(values.isfinite().all() for values in vars(worlds.state).values())
                for name, values in vars(seen(worlds, straight_map.road_map)).items():
                    assert values.isfinite().all(), name


@pytest.mark.parametrize("shift", [0.0, 1.3, 2.6])
def test_a_vehicle_beside_the_road_counts_wherever_the_grid_lies(shift: float):
    """The car's side is 0.1 m to 6 m away from the border, which it has crossed before."""
    road_map = build_bundle(turned_network(straight_network(), 0.0, (0.0, shift))).road_map
    offsets = torch.arange(0.1, 6.0, 0.1)
    count = len(offsets)
    state = vehicle_state(200.0, (shift - 1.83 - 0.95 - offsets).tolist(), count=count)
    worlds = place(car_shape(count), state, task_to(400.0, count=count))
    nobody_moves = torch.full((1, 1, count), token(0.0, 0.0))
    (_, step), *_ = drive(worlds, road_map, nobody_moves)
    assert step.outcome.road_edge.all(), offsets[~step.outcome.road_edge[0]]
