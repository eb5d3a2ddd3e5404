"""The zero-shot protocol, against closed forms on straight roads."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from phase_sumo.bridge.maps.road_lines import road_lines
from phase_sumo.evaluate.scene_scores import MEASURES, Scores, score, table
from phase_sumo.evaluate.zero_shot import (
    Frame,
    Scenes,
    constant_velocity,
    driven,
    motion_of,
    replayed,
    scenes,
)
from phase_sumo.logs.recording import Recording
from phase_sumo.logs.windows import windows
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.lane_graph import build_lane_graph
from phase_sumo.sim.road_build import build_road_map
from tests.helpers.recordings import ROAD, recording_of

TIME = 0.1 * np.arange(101)


@pytest.fixture(scope="module")
def road_map():
    return build_road_map(road_lines(ROAD), build_lane_graph(ROAD))


def found_of(recording: Recording, road_map, seed: int = 0) -> Scenes:
    return scenes(windows(recording, lane_changes_only=False), [ROAD], road_map, seed)


def column(scores: Scores, name: str) -> list[float]:
    """Of the agents of the first window, in the order of the slots."""
    values = scores.values[name][0]
    return values[np.isfinite(values)].tolist()


def braking(first: float, speed: float, decel: float) -> np.ndarray:
    return first + speed * TIME - 0.5 * decel * TIME**2


def pushed() -> Recording:
    """The first drives up to the second and pushes it from then on, 2 m into it."""
    ahead = 60.0 + 10.0 * TIME
    return recording_of([np.minimum(20.0 + 30.0 * TIME, ahead - 2.8), ahead], np.full((2, 101), 3.6))


def test_the_log_scores_itself_without_error(road_map):
    recording = recording_of([braking(50.0, 20.0, 1.0), braking(90.0, 15.0, 0.0)], np.full((2, 101), 3.6))
    found = found_of(recording, road_map)
    scores = score(found, replayed(found, found.log))
    assert column(scores, "goal_rate") == column(scores, "success_rate") == [1.0, 1.0]
    assert column(scores, "agent_collision_rate") == column(scores, "road_collision_rate") == [0.0, 0.0]
    assert column(scores, "ade_5s") == pytest.approx([0.0, 0.0], abs=1e-4)
    assert column(scores, "fde_5s") == pytest.approx([0.0, 0.0], abs=1e-4)


def test_constant_velocity_errs_by_half_a_t_squared(road_map):
    decel = 1.5
    recording = recording_of([braking(50.0, 20.0, decel)], np.full((1, 101), 3.6))
    found = found_of(recording, road_map)
    scores = score(found, replayed(found, constant_velocity(found)))
    off = 0.5 * decel * TIME[1:51] ** 2
    # the recorded speed of the first sample is a difference over a step
    assert column(scores, "ade_5s") == pytest.approx([off.mean()], rel=0.04)
    assert column(scores, "fde_5s") == pytest.approx([off[-1]], rel=0.04)
    assert column(scores, "goal_rate") == [1.0]  # on the way, 125 m before it stops


def test_who_drives_into_another_is_at_fault_and_does_not_succeed(road_map):
    found = found_of(pushed(), road_map)
    scores = score(found, replayed(found, found.log))
    assert column(scores, "agent_collision_rate") == [1.0, 1.0]
    assert column(scores, "at_fault_rate") == [1.0, 0.0]
    assert column(scores, "goal_rate") == [1.0, 1.0]
    assert column(scores, "success_rate") == [0.0, 1.0]


def test_small_boxes_pass_where_full_ones_touch(road_map):
    x = np.stack((20.0 + 30.0 * TIME, 60.0 + 10.0 * TIME))
    recording = recording_of(x, np.repeat([[3.0], [4.6]], 101, 1))  # 1.6 m apart, 1.9 m wide
    scores = score(found := found_of(recording, road_map), replayed(found, found.log))
    assert column(scores, "agent_collision_rate") == [1.0, 1.0]
    assert column(scores, "agent_collision_rate_small") == [0.0, 0.0]
    assert column(scores, "success_rate_small") == [1.0, 1.0]


def test_who_leaves_at_the_goal_goes_on_straight_for_ade(road_map):
    """Twice as fast as its record, which ends after 4 s, at 40 m/s after 2 s."""
    x = np.where(TIME <= 4.0, 50.0 + 20.0 * TIME, np.nan)
    found = found_of(recording_of([x], np.full((1, 101), 3.6)), road_map)
    fast = recording_of([50.0 + 40.0 * TIME], np.full((1, 101), 3.6))
    scores = score(found, replayed(found, motion_of(found, [fast])))
    assert column(scores, "goal_rate") == [1.0]
    assert column(scores, "ade_5s") == pytest.approx([np.mean(20.0 * TIME[1:41])], rel=1e-3)
    assert column(scores, "fde_5s") == []  # nothing was recorded at 5 s


def test_targets_are_recorded_and_alpha_follows_seed_and_number(road_map):
    recording = recording_of([braking(50.0, 20.0, 1.0)], np.full((1, 101), 3.6))
    found, other = found_of(recording, road_map), found_of(recording, road_map, seed=1)
    task, log = found.start.task, found.log
    assert task.goal_x[0, 0] == log.x[0, 0, -1] and task.goal_y[0, 0] == log.y[0, 0, -1]
    assert task.goal_speed[0, 0] == log.speed[0, 0].max()
    assert 0.1 <= task.alpha[0, 0] <= 1.0 and task.alpha[0, 0] != other.start.task.alpha[0, 0]
    assert torch.equal(task.alpha, found_of(recording, road_map).start.task.alpha)
    later = scenes(list(found.windows), [ROAD], road_map, 0, first=1)
    assert later.start.task.alpha[0, 0] != task.alpha[0, 0]


def test_vehicles_begin_as_they_were_recorded(road_map):
    """A window that begins later: the motion before it tells acceleration and steering angle."""
    time = 0.1 * np.arange(121)
    x = 50.0 + 15.0 * time + 0.5 * time**2
    recording = recording_of([x], np.full((1, 121), 3.6), yaw=0.05 * time)
    window = windows(recording, 5.0, lane_changes_only=False)[1]
    state = scenes([window], [ROAD], road_map, 0).start.state
    shape = scenes([window], [ROAD], road_map, 0).start.shape
    assert window.begin == 50
    assert float(state.speed[0, 0]) == pytest.approx(20.0, abs=0.1)
    assert float(state.accel[0, 0]) == pytest.approx(1.0, abs=0.05)
    turn = float(state.speed[0, 0] / shape.wheelbase[0, 0] * torch.tan(state.steer[0, 0]))
    assert turn == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize("accel", [-7.0, 3.5])
def test_each_kind_begins_within_its_own_bounds(road_map, accel):
    """Cars -8..4, trucks -6..1.8 m/s^2: what a truck is said to have done beyond is noise."""
    time = 0.1 * np.arange(81)
    change = np.clip(time - 4.0, 0.0, 2.0)  # from 4 to 6 s
    speed = np.tile(20.0 + accel * change, (2, 1))
    x = np.stack((50.0 + np.cumsum(speed[0]) * 0.1, 300.0 + np.cumsum(speed[1]) * 0.1))
    y, kinds = np.repeat([[0.0], [7.2]], 81, 1), ["car", "rigid_truck"]
    recording = recording_of(x, y, length=[4.8, 9.0], kind=kinds, speed=speed)
    window = windows(recording, 2.5, lane_changes_only=False, shortest=2.5)[2]  # from 5 s on
    state = scenes([window], [ROAD], road_map, 0).start.state
    assert state.accel[0].tolist() == pytest.approx([accel, float(np.clip(accel, -6.0, 1.8))], abs=1e-4)


def test_trailers_have_the_first_slots(road_map):
    x = np.stack((50.0 + 20.0 * TIME, 100.0 + 20.0 * TIME))
    kinds, lengths = ["car", "articulated_truck"], [4.8, 18.0]
    recording = recording_of(x, np.full((2, 101), 3.6), length=lengths, kind=kinds)
    found = found_of(recording, road_map)
    assert found.agents[0].tolist() == [1, 0]
    assert found.start.shape.articulated.tolist() == [[True, False]]


def test_the_policy_drives_every_last_step(road_map):
    """Positions go on to the end: nothing jumps where a world is over."""
    x = np.stack((50.0 + 20.0 * TIME, 150.0 + 20.0 * TIME))
    found = found_of(recording_of(x, np.repeat([[0.0], [7.2]], 101, 1)), road_map)
    frames = list(driven(found, load_policy(), 0))
    for frame in frames:
        step = torch.hypot(frame.after.x - frame.before.x, frame.after.y - frame.before.y)
        assert bool((step <= 0.1 * 40.0 + 1e-3).all())
    assert bool(frames[0].active.all())


def test_table_means_over_scenarios_and_draws_by_recording(road_map):
    alone = recording_of([50.0 + 20.0 * TIME], np.full((1, 101), 0.0))
    parts = [found_of(pushed(), road_map), found_of(alone, road_map)]

    def log(found: Scenes) -> Iterator[Frame]:
        return replayed(found, found.log)

    result = table(parts, [score(found, log(found)) for found in parts])
    assert (result["scenarios"], result["agents"]) == (2, 3)
    # scenarios weigh the same: one of two vehicles at fault, then none of one
    assert result["at_fault_rate"]["mean"] == pytest.approx(0.25)
    assert result["at_fault_rate"]["std"] == pytest.approx(np.std([0.5, 0.0], ddof=1))
    assert result["recordings"] == 1
    assert result["at_fault_rate"]["low"] is None and result["at_fault_rate"]["high"] is None
    json.dumps(result, allow_nan=False)
    assert set(MEASURES) <= set(result["by_type"]["car"]) and set(result["by_source"]) == {"tracks"}
