"""Pictures of worlds: the right things, in the right place, in the right colour."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from PIL import Image, ImageSequence

from phase_sumo.config import TaskConfig
from phase_sumo.report.map_picture import ASPHALT, KERB, border_lines, lane_surfaces
from phase_sumo.report.render import CRASH, OFF_ROAD, TYPES, Frame, Window, draw_world, film
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.road_map import RoadKind
from tests.helpers.factories import car_shape, task_to, truck_shape, vehicle_state
from tests.helpers.rollouts import place, token

CAR, RIGID, ARTICULATED = TYPES.values()


def environment(straight_map) -> Environment:
    """One world of five slots, the last one empty: two cars, a tractor-trailer, a crashed car."""
    env = Environment([straight_map], 1, 5, TaskConfig(), training=False)
    shape = truck_shape(5).where(torch.arange(5).unsqueeze(0) == 0, car_shape(5))
    state = vehicle_state(
        [180.0, 200.0, 220.0, 240.0, 210.0], [0.0, 3.66, 7.32, 0.0, 0.0], speed=20.0, hitch=0.0, count=5
    )
    task = task_to([260.0, 280.0, 290.0, 300.0, 250.0], [0.0, 3.66, 3.66, 0.0, 0.0], 0.0, 20.0, 1.0, 5)
    worlds = place(shape, state, task)
    worlds.active[0, 4] = False
    worlds.outcome.collision[0, 2:4] = True
    worlds.outcome.at_fault[0, 3] = True
    worlds.outcome.road_edge[0, 1] = True
    env.worlds = worlds
    env.slots = 5
    return env


def has(picture: np.ndarray, colour: str) -> int:
    """Pixels of a colour."""
    return int((np.abs(picture[..., :3] - to_rgb(colour)).max(-1) < 0.02).sum())


def test_a_picture_shows_road_vehicles_by_type_and_what_happened(straight_map, tmp_path):
    env, path = environment(straight_map), tmp_path / "world.png"
    draw_world(env, 0, straight_map, path)
    picture = imread(path)
    height, width = picture.shape[:2]
    assert width == 1430 and 100 < height < 1000
    road = picture[int(0.25 * height) :]  # below the legend
    scale = width / Window.on(Frame.of(env, 0)).length
    for colour, area in ((CAR, 2 * 4.8 * 1.9), (ARTICULATED, 7.0 * 2.55), (CRASH, 4.8 * 1.9)):
        assert 0.5 * area < has(road, colour) / scale**2 < 1.7 * area, colour
    assert has(road, RIGID) == 0 and has(road, OFF_ROAD) > 20
    assert has(road, ASPHALT) > 0.1 * road[..., 0].size and has(road, KERB) > width / 2


def test_a_frame_holds_the_agents_on_the_road(straight_map):
    frame = Frame.of(environment(straight_map), 0)
    assert frame.kind.tolist() == [2, 0, 0, 0]
    assert frame.collision.tolist() == [False, False, True, True]
    np.testing.assert_allclose(frame.xy[1], (200.0 - 0.96 + 2.4, 3.66), rtol=1e-6)
    np.testing.assert_allclose(frame.goal[0], (260.0, 0.0))


@pytest.mark.parametrize("angle", [0.0, 0.8, 2.5, -2.0])
def test_the_window_turns_with_the_road_and_holds_everything(angle: float):
    cos, sin = math.cos(angle), math.sin(angle)
    along = np.linspace(0.0, 100.0, 6)
    box = np.zeros((6, 2, 6))
    box[:, 0] = [along * cos, along * sin, *np.repeat([[cos], [sin], [2.4], [1.0]], 6, 1)]
    box[2:4, 0, ::2] *= -1.0  # both directions
    goal = np.stack((along * cos, along * sin), -1)
    flags = np.zeros(6, bool)
    window = Window.on(Frame(box, goal, flags.astype(int), flags, flags, flags, 0.0))
    assert math.remainder(window.yaw - angle, math.pi) == pytest.approx(0.0, abs=1e-6)
    assert window.everything and 100.0 < window.length < 160.0


def test_the_road_has_its_lines_in_one_piece(straight_map):
    lines = border_lines(straight_map.road_map)
    assert sorted(round(float(line[0, 1]), 2) for line in lines[RoadKind.ROAD_EDGE]) == [-1.83, 9.15]
    assert sorted(round(float(line[0, 1]), 2) for line in lines[RoadKind.LANE_BOUNDARY]) == [1.83, 5.49]
    borders = [line for kind in lines.values() for line in kind]
    widths = [np.ptp(surface[:, 1]) for surface in lane_surfaces(straight_map.graph, borders)]
    np.testing.assert_allclose(widths, 3.66, atol=0.01)


@pytest.mark.parametrize("name", ["world.gif", "world.png"])
def test_a_film_moves_until_the_scenario_is_over(straight_map, tmp_path, name: str):
    env = environment(straight_map)
    film(env, 0, straight_map, lambda seen: torch.full((1, 5), token(0.0, 0.0)), tmp_path / name, steps=8)
    with Image.open(tmp_path / name) as moving:
        pictures = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(moving)]
    assert len(pictures) == 9
    for before, after in pairwise(pictures):
        assert before.shape == after.shape and (before != after).any()


def test_an_empty_world_can_be_drawn(straight_map, tmp_path):
    env = environment(straight_map)
    env.worlds.active[:] = False
    draw_world(env, 0, straight_map, tmp_path / "empty.png")
    assert imread(tmp_path / "empty.png").shape[1] == 1430
