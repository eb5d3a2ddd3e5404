"""Nine vehicles on a straight road that meet every clamp of the model and every term of the reward.

Write the expected values anew, after a change that is meant to change them:

    python -m tests.golden.scene
"""

from __future__ import annotations

import json
from pathlib import Path

import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.config import RewardConfig, SimConfig
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.step import look
from phase_sumo.sim.worlds import Worlds
from tests.helpers.factories import car_shape, task_to, truck_shape, vehicle_state
from tests.helpers.rollouts import drive, place, token
from tests.helpers.straight_road import straight_network

EXPECTED = Path(__file__).with_name("rollout.json")
LANE = 3.66  # m
STEPS, EVERY = 50, 10

# x, lane, speed, goal's x and lane, goal speed, alpha; then the commands: (from step, jerk, steering rate)
VEHICLES = {
    "truck accelerates, changes lane": ((60, 0, 15, 200, 1, 25, 1.0), (0, 5, 0.02), (10, 5, -0.02)),
    "truck swerves, brakes": ((300, 2, 24, 420, 2, 20, 1.0), (0, 0, 0.08), (6, -8, -0.08), (16, -8, 0.08)),
    "car runs into the trailer": ((25, 0, 24, 200, 0, 30, 0.7), (0, 3, 0), (20, -8, 0)),
    "car reaches its goal well": ((100, 1, 20, 140, 1, 20, 0.5), (0, 0, 0)),
    "car reaches its goal too slow": ((100, 2, 20, 138, 2, 28, 0.5), (0, -1.5, 0)),
    "car passes its goal": ((200, 0, 30, 240, 2, 30, 0.3), (0, 1.5, 0)),
    "car crawls in a circle": ((430, 0, 0.6, 455, 1, 5, 1.0), (0, 0, 0.3)),
    "car at the top speed": ((250, 1, 39, 490, 1, 35, 1.0), (0, 5, 0)),
    "car leaves the road": ((150, 2, 22, 260, 0, 22, 0.9), (0, 0, 0.3), (12, -8, -0.3)),
}


def scene() -> tuple[Worlds, torch.Tensor]:
    """The worlds [1, 9] and the actions [T, 1, 9]."""
    count, trucks = len(VEHICLES), 2
    x, lane, speed, goal_x, goal_lane, goal_speed, alpha = (
        list(map(float, column)) for column in zip(*(v[0] for v in VEHICLES.values()), strict=True)
    )
    first = torch.arange(count).unsqueeze(0) < trucks
    shape = truck_shape(count).where(first, car_shape(count))
    state = vehicle_state(x, [k * LANE for k in lane], speed=speed, count=count)
    task = task_to(goal_x, [k * LANE for k in goal_lane], 0.0, goal_speed, alpha, count)
    actions = torch.zeros(STEPS, 1, count, dtype=torch.long)
    for k, (_, *commands) in enumerate(VEHICLES.values()):
        for begin, jerk, rate in commands:
            actions[begin:, 0, k] = token(jerk, rate)
    return place(shape, state, task), actions


def play(road_map: RoadMap, sim: SimConfig | None = None, reward: RewardConfig | None = None) -> dict:
    """What a rollout of the scene comes to, as plain numbers.

    state: by vehicle and feature, every `EVERY` steps (the last one again after it has finished); reward:
    every vehicle's return; terms: sum of each term's mean over the steps; events: the steps in which things
    first happened; seen: a few features of everybody halfway.
    """
    worlds, actions = scene()
    course = drive(worlds, road_map, actions, sim=sim, reward=reward)
    names = ("x", "y", "yaw", "speed", "accel", "steer", "hitch")
    states = [after.state for after, _ in course[EVERY - 1 :: EVERY]]
    half, first = course[STEPS // 2][0], torch.zeros(1, dtype=torch.long)
    seen = look(half.shape, half.state, half.task, half.active, road_map, first, None, sim or SimConfig())
    return {
        "state": {
            vehicle: {name: [getattr(s, name)[0, k].item() for s in states] for name in names}
            for k, vehicle in enumerate(VEHICLES)
        },
        "reward": torch.stack([t.reward[0] for _, t in course]).double().sum(0).tolist(),
        "terms": {name: sum(t.terms[name].item() for _, t in course) for name in course[0][1].terms},
        "events": {
            name: [_first([getattr(t.outcome, name)[0, k] for _, t in course]) for k in range(len(VEHICLES))]
            for name in ("goal", "collision", "at_fault", "road_edge")
        },
        "finished": [_first([t.finished[0, k] for _, t in course]) for k in range(len(VEHICLES))],
        "seen": {"ego": seen.ego[0].sum(-1).tolist(), "partner": seen.partner[0].sum((-1, -2)).tolist()},
    }


def _first(happened: list) -> int:
    """Step in which it first holds, -1 if never."""
    return next((t for t, value in enumerate(happened) if value), -1)


def write() -> None:
    result = play(build_bundle(straight_network()).road_map)

    def rounded(value):
        if isinstance(value, dict):
            return {key: rounded(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [rounded(inner) for inner in value]
        return float(f"{value:.8g}") if isinstance(value, float) else value

    EXPECTED.write_text(json.dumps(rounded(result), indent=None, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    write()
