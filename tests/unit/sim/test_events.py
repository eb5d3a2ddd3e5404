"""Goal, unrecoverable, collision, fault and road contact by hand-placed vehicles."""

from __future__ import annotations

import pytest
import shapely
import torch

from phase_sumo.config import SimConfig
from phase_sumo.sim.events import agent_contacts, detect, goal_reached
from phase_sumo.sim.vehicles import boxes
from tests.helpers.factories import car_shape, task_to, truck_shape, vehicle_state

SIM = SimConfig()


def events_of(straight_map, shape, before, after, task):
    active = torch.ones_like(after.x, dtype=torch.bool)
    world = torch.zeros(1, dtype=torch.long)
    return detect(shape, before, after, task, active, straight_map.road_map, world, SIM, after.x.shape[1])


def test_a_goal_is_not_jumped_over_at_30_metres_per_second(straight_map):
    before, after = vehicle_state(x=98.4), vehicle_state(x=101.4)
    task = task_to(goal_x=99.9, goal_y=1.9)
    far_from_both = torch.hypot(after.x - task.goal_x, after.y - task.goal_y).item()
    assert far_from_both > SIM.goal_radius  # the end point alone would miss it
    events = events_of(straight_map, car_shape(), before, after, task)
    assert events.goal.item() and not events.unrecoverable.item()


def test_a_goal_in_the_next_lane_is_missed_and_unrecoverable(straight_map):
    task = task_to(goal_x=100.0, goal_y=3.66)
    events = events_of(straight_map, car_shape(), vehicle_state(x=99.0), vehicle_state(x=101.0), task)
    assert not events.goal.item() and events.unrecoverable.item()


def test_goal_ahead_is_neither():
    assert not goal_reached(vehicle_state(x=0.0), vehicle_state(x=3.0), task_to(), SIM.goal_radius).item()


def test_the_one_behind_is_at_fault_in_a_rear_end_collision(straight_map):
    shape, state = car_shape(2), vehicle_state(x=[50.0, 53.0], count=2)
    events = events_of(straight_map, shape, state, state, task_to(goal_x=300.0, count=2))
    assert events.collision.tolist() == [[True, True]]
    assert events.at_fault.tolist() == [[True, False]]


def test_both_are_at_fault_when_neither_is_behind(straight_map):
    shape, state = car_shape(2), vehicle_state(x=[50.0, 51.0], y=[0.0, 1.5], count=2)
    events = events_of(straight_map, shape, state, state, task_to(goal_x=300.0, count=2))
    assert events.at_fault.tolist() == [[True, True]]


def test_hitting_a_trailer_is_a_collision_and_the_car_behind_is_at_fault(straight_map):
    shape = car_shape(2).where(torch.tensor([[True, False]]), truck_shape(2))
    state = vehicle_state(x=[50.0, 68.0], count=2)  # the trailer's rear is 15.1 m behind the hitch
    events = events_of(straight_map, shape, state, state, task_to(goal_x=300.0, count=2))
    assert events.collision.tolist() == [[True, True]]
    assert events.at_fault.tolist() == [[True, False]]
    apart = vehicle_state(x=[48.0, 68.0], count=2)
    assert not events_of(straight_map, shape, apart, apart, task_to(goal_x=300.0, count=2)).collision.any()


@pytest.mark.parametrize("seed", range(5))
def test_every_collision_has_a_culprit(seed: int):
    generator = torch.Generator().manual_seed(seed)
    shape = truck_shape(30)
    state = vehicle_state(
        x=(60 * torch.rand(30, generator=generator)).tolist(),
        y=(20 * torch.rand(30, generator=generator)).tolist(),
        yaw=(6.3 * torch.rand(30, generator=generator)).tolist(),
        count=30,
    )
    box = boxes(shape, state)
    active = torch.ones(1, 30, dtype=torch.bool)
    hulls = [
        shapely.union_all([box_polygon(box[:, part, 0, i].tolist()) for part in (0, 1)]) for i in range(30)
    ]
    touched = [any(a.intersects(b) for j, b in enumerate(hulls) if i != j) for i, a in enumerate(hulls)]
    collision, fault = agent_contacts(box, active, trailers=30)
    assert collision[0].tolist() == touched
    assert fault.any() and not (fault & ~collision).any()
    for i in range(30):
        pair = [i, (i + 1) % 30]
        both, guilty = agent_contacts(box[..., pair], active[:, pair], trailers=2)
        assert torch.equal(both.any(), guilty.any()), "somebody is at fault in every collision"


def box_polygon(box: list[float]) -> shapely.Polygon:
    x, y, cos, sin, length, width = box
    corners = ((length, width), (-length, width), (-length, -width), (length, -width))
    return shapely.Polygon([(x + u * cos - v * sin, y + u * sin + v * cos) for u, v in corners])


def test_slots_without_trailers_need_not_be_searched_for_any():
    generator = torch.Generator().manual_seed(1)
    places = {
        "x": (80 * torch.rand(20, generator=generator)).tolist(),
        "y": (12 * torch.rand(20, generator=generator)).tolist(),
    }
    first = (torch.arange(20) < 6).unsqueeze(0)
    shape = truck_shape(20).where(first, car_shape(20))
    box = boxes(shape, vehicle_state(**places, hitch=[0.2] * 20, count=20))
    active = torch.rand(1, 20, generator=generator) < 0.8
    for some, every in zip(agent_contacts(box, active, 6), agent_contacts(box, active, 20), strict=True):
        assert torch.equal(some, every)


@pytest.mark.parametrize(
    ("y", "edge", "boundary"),
    [(0.0, False, False), (1.2, False, True), (-1.0, True, False), (-8.0, True, False)],
    ids=["in lane", "over the marking", "over the road edge", "beside the road"],
)
def test_road_contacts(straight_map, y: float, edge: bool, boundary: bool):
    state = vehicle_state(x=200.0, y=y)
    events = events_of(straight_map, car_shape(), state, state, task_to(goal_x=400.0))
    assert events.road_edge.item() is edge
    assert events.lane_boundary.item() is boundary


def test_a_trailer_that_swings_over_the_edge_counts(straight_map):
    shape = truck_shape()
    straight = vehicle_state(x=200.0)
    swung = vehicle_state(x=200.0, hitch=-0.1)  # trailer yaw +0.1: its tail is to the right
    task = task_to(goal_x=400.0)
    assert not events_of(straight_map, shape, straight, straight, task).road_edge.item()
    assert events_of(straight_map, shape, swung, swung, task).road_edge.item()


def test_off_the_map_counts_as_off_the_road(straight_map):
    state = vehicle_state(x=200.0, y=500.0)
    assert events_of(straight_map, car_shape(), state, state, task_to()).road_edge.item()
