"""The paper's zero-shot protocol: recorded scenes driven anew, and what became of every vehicle.

Vehicles start as recorded and are asked to the place where the record, or the window, ends. Their target
speed is the highest at which each was recorded in the window, the nearest that a record comes to the speed
that a driver would like; alpha is drawn at random. A vehicle leaves the scene at its goal, or once its goal
lies behind.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from phase_sumo.config import ScenarioConfig, SimConfig
from phase_sumo.evaluate.fixed_worlds import Start, drive, policy_driver
from phase_sumo.logs.recording import PERIOD, Recording, Window, poses, shape
from phase_sumo.policy.checkpoint import Policy
from phase_sumo.sim.events import goal_behind, goal_reached
from phase_sumo.sim.kinematics import bounded_accel
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.vehicles import HISTORY, Task, VehicleShape, VehicleState

SHORTEST = 10  # samples: a vehicle that leaves within a second is left out
PAST = 5  # samples before the window that acceleration and steering angle are read from
STEEPEST = 3.0  # m/s^2 sideways: more is no turn but noise of the recorded yaw
EMPTY = {"length": 4.9, "wheelbase": 2.94}  # of empty slots: the model divides by the wheelbase


@dataclass(frozen=True)
class Poses:
    """Recorded or driven motion of the reference points, all [W, N, T + 1]; NaN where there is none."""

    x: Tensor
    y: Tensor
    yaw: Tensor
    hitch: Tensor
    speed: Tensor

    def state(self, t: int) -> VehicleState:
        """As the simulator's state, zero where there is no pose."""
        x, y, yaw, hitch, speed = (
            getattr(self, name)[..., t].nan_to_num() for name in ("x", "y", "yaw", "hitch", "speed")
        )
        none = torch.zeros_like(x)
        history = none.unsqueeze(-1).expand(*x.shape, HISTORY)
        return VehicleState(x, y, yaw, speed, none, none, hitch, history, history)


@dataclass(frozen=True)
class Scenes:
    """W recorded windows as worlds of up to N agents and T steps.

    Attributes:
        windows: where each is from.
        agents: [W] rows of each window's recording that the slots of its world hold, in order.
        start: initial states, tasks and shapes.
        log: what was recorded.
        road_map: of all recordings; ``start.map_index`` tells which.
    """

    windows: tuple[Window, ...]
    agents: tuple[NDArray[np.int64], ...]
    start: Start
    log: Poses
    road_map: RoadMap


@dataclass(frozen=True)
class Frame:
    """One step of all worlds: states before and after it, and who took part, [W, N]."""

    before: VehicleState
    after: VehicleState
    active: Tensor


def scenes(
    windows: Sequence[Window], roads: Sequence[LaneNetwork], road_map: RoadMap, seed: int, first: int = 0
) -> Scenes:
    """Recorded windows as worlds to drive; each must have agents (`agents_of`).

    Args:
        roads: the networks that ``road_map`` holds, in its order.
        seed: of alpha, uniform within the bounds of training, and of the actions.
        first: number of the first window: what is drawn for a world follows from the seed and its number.
    """
    agents = [agents_of(w) for w in windows]
    size = len(windows), max(map(len, agents))
    parts = [(w.recording, rows, w.begin) for w, rows in zip(windows, agents, strict=True)]
    log = _poses(parts, windows)
    active = torch.zeros(size, dtype=torch.bool)
    shapes = {name: torch.zeros(size) for name in VehicleShape.__dataclass_fields__}
    shapes["truck"] = torch.zeros(size, dtype=torch.bool)
    for name, value in EMPTY.items():
        shapes[name] += value
    for k, (window, rows) in enumerate(zip(windows, agents, strict=True)):
        active[k, : len(rows)] = True
        own = shape(window.recording, rows)
        for name, values in shapes.items():
            values[k, : len(rows)] = getattr(own, name)[0]
    body = VehicleShape(**shapes)
    row = {id(road): k for k, road in enumerate(roads)}
    index = torch.tensor([row[id(w.recording.network)] for w in windows])
    start = Start(
        body,
        _initial(log, windows, agents, body),
        _task(log, seed, first),
        active,
        index,
        torch.arange(first, first + len(windows)),
    )
    return Scenes(tuple(windows), tuple(agents), start, log, road_map)


def agents_of(window: Window) -> NDArray[np.int64]:
    """Rows of those that stay long enough, trailers in the first slots (`drive` looks for them there)."""
    rows = np.flatnonzero(window.last - window.begin >= SHORTEST)
    towing = np.array([window.recording.kind[row] == "articulated_truck" for row in rows], np.bool_)
    return rows[np.argsort(~towing, kind="stable")]


def motion_of(found: Scenes, tracks: Sequence[Recording]) -> Poses:
    """The scenes as another simulator drove them.

    Args:
        tracks: for each window its agents, all of them, over its samples.
    """
    parts = [(recording, rows, 0) for recording, rows in zip(tracks, found.agents, strict=True)]
    return _poses(parts, found.windows)


def _poses(
    parts: Sequence[tuple[Recording, NDArray[np.int64], int]],
    windows: Sequence[Window],
) -> Poses:
    """Of the recording, rows and first sample given for each window, as long as its log lasts."""
    slots, steps = max(len(rows) for _, rows, _ in parts), max(w.steps for w in windows)
    columns = torch.full((5, len(windows), slots, steps + 1), torch.nan)
    for k, ((recording, rows, begin), window) in enumerate(zip(parts, windows, strict=True)):
        samples = np.arange(begin, begin + window.steps + 1)
        own = np.stack((*poses(recording, rows, samples), recording.speed[rows][:, samples]))
        last = window.last[rows] - window.begin
        own[:, np.arange(window.steps + 1) > last[:, None]] = np.nan  # what comes back is another matter
        columns[:, k, : len(rows), : window.steps + 1] = torch.from_numpy(own).float()
    return Poses(*columns)


def _initial(
    log: Poses, windows: Sequence[Window], agents: Sequence[NDArray[np.int64]], body: VehicleShape
) -> VehicleState:
    """States at the windows' begin; what came before, if it was recorded, tells how they move."""
    accel, turn = torch.zeros_like(body.length), torch.zeros_like(body.length)
    for k, (window, rows) in enumerate(zip(windows, agents, strict=True)):
        now, before = window.begin, max(window.begin - PAST, 0)
        seconds = (now - before) * PERIOD
        if not seconds or not len(rows):
            continue
        recording = window.recording
        known = recording.present[rows, before : now + 1].all(1)
        change = [values[rows, now] - values[rows, before] for values in (recording.speed, recording.yaw)]
        change[1] = np.remainder(change[1] + np.pi, 2 * np.pi) - np.pi
        for target, values in zip((accel, turn), change, strict=True):
            target[k, : len(rows)] = torch.from_numpy(np.where(known, values / seconds, 0.0)).float()
    sim, state = SimConfig(), log.state(0)
    speed = state.speed.clamp(0.0, sim.max_speed)
    turn = torch.where((turn * speed).abs() < STEEPEST, turn, 0.0)
    steer = torch.atan(body.wheelbase * turn / speed.clamp_min(sim.min_speed))
    return replace(
        state,
        speed=speed,
        accel=bounded_accel(accel, body, sim),
        steer=steer,
        accel_history=torch.zeros_like(state.accel_history),
        steer_history=steer.unsqueeze(-1).repeat(1, 1, HISTORY),
    )


def _task(log: Poses, seed: int, first: int) -> Task:
    """To the last recorded pose, at the highest recorded speed."""
    last = (~log.x.isnan()).sum(-1, keepdim=True).clamp_min(1) - 1
    x, y, yaw = (getattr(log, name).gather(-1, last).squeeze(-1).nan_to_num() for name in ("x", "y", "yaw"))
    speed = log.speed.nan_to_num().amax(-1)
    low, high = ScenarioConfig().alpha_bounds
    draws = [np.random.default_rng((seed, first + k)).random(x.shape[1]) for k in range(len(x))]
    alpha = torch.from_numpy(low + (high - low) * np.stack(draws)).float()
    return Task(x, y, yaw, speed.clamp(0.0, SimConfig().max_speed), alpha)


def driven(found: Scenes, policy: Policy, seed: int, sampled: bool = False) -> Iterator[Frame]:
    """The scenes under the policy, all vehicles at once."""
    sim = replace(policy.sim, horizon=found.log.x.shape[-1] - 1, early_termination=True)
    ends = torch.tensor([w.steps for w in found.windows])
    driver = policy_driver(policy)
    for t, step in enumerate(drive(found.start, found.road_map, driver, sim, policy.actions, seed, sampled)):
        running = (ends > t).unsqueeze(-1)
        yield Frame(step.before, step.after, step.active & running)


def replayed(found: Scenes, motion: Poses) -> Iterator[Frame]:
    """The scenes as ``motion`` has them; who reaches or misses the goal leaves as under the policy."""
    active, radius = found.start.active, SimConfig().goal_radius
    for t in range(motion.x.shape[-1] - 1):
        there = ~(motion.x[..., t].isnan() | motion.x[..., t + 1].isnan())
        active = active & there
        before, after = motion.state(t), motion.state(t + 1)
        yield Frame(before, after, active)
        reached = goal_reached(before, after, found.start.task, radius)
        active = active & ~reached & ~goal_behind(after, found.start.task)


def constant_velocity(found: Scenes) -> Poses:
    """Straight on at the initial speed, as long as the window is."""
    first = found.start.state
    steps = found.log.x.shape[-1]
    seconds = PERIOD * torch.arange(steps)
    ends = torch.tensor([w.steps for w in found.windows])
    there = found.start.active.unsqueeze(-1) & (torch.arange(steps) <= ends.view(-1, 1, 1))

    def spread(values: Tensor) -> Tensor:
        return torch.where(there, values, torch.nan)

    def still(values: Tensor) -> Tensor:
        return spread(values.unsqueeze(-1).expand(*values.shape, steps))

    way = first.speed.unsqueeze(-1) * seconds
    return Poses(
        spread(first.x.unsqueeze(-1) + way * torch.cos(first.yaw).unsqueeze(-1)),
        spread(first.y.unsqueeze(-1) + way * torch.sin(first.yaw).unsqueeze(-1)),
        still(first.yaw),
        still(first.hitch),
        still(first.speed),
    )
