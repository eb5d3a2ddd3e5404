"""Contacts of whole vehicles, cars and bent tractor-trailers, against shapely."""

from __future__ import annotations

import math

import pytest
import torch
from shapely.affinity import rotate, translate
from shapely.geometry import MultiPolygon, box

from phase_sumo.config import SimConfig
from phase_sumo.sim.events import agent_contacts, detect
from phase_sumo.sim.vehicles import VehicleShape, VehicleState, boxes
from tests.helpers.factories import car_shape, task_to, truck_shape, vehicle_state

COUNT = 24
TOO_CLOSE = 1e-4  # m: float32 cannot tell


def outline(shape: VehicleShape, state: VehicleState, k: int) -> MultiPolygon:
    """Tractor and trailer from their dimensions, independently of `vehicles.boxes`."""

    def value(name: str) -> float:
        return getattr(shape if hasattr(shape, name) else state, name)[0, k].item()

    rear, width = value("rear_overhang"), value("width") / 2
    parts = [(box(-rear, -width, value("length") - rear, width), value("yaw"))]
    if value("trailer_length") > 0:
        front, side = value("trailer_setback"), value("trailer_width") / 2
        parts.append(
            (box(front - value("trailer_length"), -side, front, side), value("yaw") - value("hitch"))
        )
    turned = [rotate(part, yaw, origin=(0, 0), use_radians=True) for part, yaw in parts]
    return MultiPolygon([translate(part, value("x"), value("y")) for part in turned])


@pytest.mark.parametrize("seed", range(6))
def test_collisions_of_whole_vehicles(straight_map, seed: int):
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> list[float]:
        return (low + (high - low) * torch.rand(COUNT, generator=generator)).tolist()

    shape = truck_shape(COUNT).where(torch.arange(COUNT).unsqueeze(0) < 8, car_shape(COUNT))
    state = vehicle_state(
        draw(100, 220), draw(-20, 20), draw(-math.pi, math.pi), hitch=draw(-1.5, 1.5), count=COUNT
    )
    state.hitch = torch.where(shape.articulated, state.hitch, 0.0)
    active = torch.rand(1, COUNT, generator=generator) < 0.8
    found = detect(
        shape,
        state,
        state,
        task_to(count=COUNT),
        active,
        straight_map.road_map,
        torch.zeros(1, dtype=torch.long),
        SimConfig(),
        8,
    )
    outlines = [outline(shape, state, k) for k in range(COUNT)]
    expected, unclear = [False] * COUNT, [False] * COUNT
    for i in range(COUNT):
        for j in range(i):
            if active[0, i] and active[0, j]:
                near = outlines[i].buffer(TOO_CLOSE).intersects(outlines[j])
                deep = outlines[i].buffer(-TOO_CLOSE).intersects(outlines[j])
                for k in (i, j):
                    expected[k] |= deep
                    unclear[k] |= near != deep
    assert any(expected) and not all(expected)
    for k in range(COUNT):
        if not unclear[k] or expected[k]:
            assert found.collision[0, k].item() == expected[k], k
    assert not (found.at_fault & ~found.collision).any()


@pytest.mark.parametrize(
    ("behind", "guilty"),
    [(2.5, [True, False]), (2.41, [True, False]), (2.39, [True, True]), (1.0, [True, True])],
)
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_fault_begins_where_the_other_centre_is_half_its_length_ahead(
    behind: float, guilty: list[bool], turn: float
):
    """F_i = 1[(p_j - p_i) . f_j > l_j / 2], l_j / 2 = 2.4 m; the yaw of i does not matter."""
    shape = car_shape(2)
    centre = torch.tensor([-behind, 0.0])
    yaw = torch.tensor([turn, 0.0])
    to_axle = 0.5 * 4.8 - 0.96  # box centre to reference point
    x, y = centre - to_axle * torch.cos(yaw), -to_axle * torch.sin(yaw)
    state = vehicle_state(x.tolist(), y.tolist(), yaw.tolist(), count=2)
    collision, fault = agent_contacts(boxes(shape, state), torch.ones(1, 2, dtype=torch.bool), 0)
    assert collision.all()
    assert fault[0].tolist() == guilty
