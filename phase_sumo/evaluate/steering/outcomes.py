"""What a vehicle does under a context: worlds driven again and again, all else equal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from phase_sumo.config import Actions, SimConfig
from phase_sumo.evaluate.fixed_worlds import Driver, Start, Step, drive
from phase_sumo.evaluate.steering.egos import Ego
from phase_sumo.sim.dimensions import Kind, mean_shape
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.vehicles import VehicleShape

COVERED_TIME = 4.0  # s within which the distance covered is counted
LANE_WIDTH = 3.66  # m, of most of the networks


@dataclass(frozen=True)
class Context:
    """The context C of one vehicle.

    Attributes:
        alpha: action range.
        speed: target speed as a multiple of its initial speed.
        kind: vehicle type.
        lane: of its goal: 0 its own, 1 the left one, -1 the right one.
    """

    alpha: float = 0.6
    speed: float = 1.15
    kind: Kind = "car"
    lane: int = 0


@dataclass(frozen=True)
class Outcome:
    """What became of one ego.

    Attributes:
        mean_speed, final_speed: m/s, until its goal or its end.
        rms_accel, most_accel, least_accel: m/s^2.
        distance: m driven in the first `COVERED_TIME`.
        aside: m to the left of its own lane's centre line at the end; farthest: the largest on the way.
        goal, collision: it reached its goal; it touched somebody.
        passed_ahead, passed_by_behind: it overtook the one ahead; the one behind overtook it.
    """

    mean_speed: float
    final_speed: float
    rms_accel: float
    most_accel: float
    least_accel: float
    distance: float
    aside: float
    farthest: float
    goal: bool
    collision: bool
    passed_ahead: bool
    passed_by_behind: bool


class Stage:
    """Worlds with an ego each, that can be driven under any contexts."""

    def __init__(
        self,
        start: Start,
        egos: Sequence[Ego],
        road_map: RoadMap,
        driver: Driver,
        actions: Actions,
        seed: int = 0,
    ) -> None:
        rows = torch.tensor([ego.world for ego in egos])
        start = start.map(lambda values: values[rows])
        slots = int(start.active.sum(-1).max())
        self.start = start.map(lambda values: values[:, :slots] if values.dim() > 1 else values)
        self.egos, self._slot = egos, torch.tensor([ego.slot for ego in egos])
        self._road_map, self._driver, self._actions, self._seed = road_map, driver, actions, seed

    def outcomes(self, contexts: Sequence[Context]) -> list[Outcome]:
        """Of every ego under its context; who has no lane there keeps its own."""
        start, trace = self._begin(contexts), _Trace(self._slot)
        sim = SimConfig()
        for step in drive(start, self._road_map, self._driver, sim, self._actions, self._seed, sampled=True):
            trace.add(step)
            if not trace.driving:
                break
        return [self._outcome(k, ego, trace, start.shape, sim.dt) for k, ego in enumerate(self.egos)]

    def _begin(self, contexts: Sequence[Context]) -> Start:
        """The worlds with the egos' contexts set."""
        shape, task = self.start.shape.map(Tensor.clone), self.start.task.map(Tensor.clone)
        for k, (ego, context) in enumerate(zip(self.egos, contexts, strict=True)):
            at = k, ego.slot
            for name, value in mean_shape(context.kind).items():
                getattr(shape, name)[at] = value
            x, y, yaw = ego.goals.get(context.lane, ego.goals[0])
            task.goal_x[at], task.goal_y[at], task.goal_yaw[at] = x, y, yaw
            target = context.speed * self.start.state.speed[at]
            task.goal_speed[at] = target.clamp(3.0, SimConfig().max_speed)
            task.alpha[at] = context.alpha
        return replace(self.start, shape=shape, task=task)

    def _outcome(self, k: int, ego: Ego, trace: _Trace, shape: VehicleShape, dt: float) -> Outcome:
        steps = int(trace.steps[k])
        x, y, yaw, speed, accel = (values[k, :steps] for values in trace.own())
        aside = [ego.aside(np.array(point)) for point in zip(x, y, strict=True)]
        covered = round(COVERED_TIME / dt)
        front = shape.front_overhang[k].numpy()

        def gone_by(other: int) -> float:
            """m by which the other's front is ahead of the ego's when either was last seen."""
            ox, oy, there = trace.other(k, other)
            last = int(there[:steps].sum()) - 1
            dx, dy = ox[last] - x[last], oy[last] - y[last]
            ahead = dx * np.cos(yaw[last]) + dy * np.sin(yaw[last])
            return float(ahead + front[other] - front[ego.slot])

        return Outcome(
            mean_speed=float(speed.mean()),
            final_speed=float(speed[-1]),
            rms_accel=float(np.sqrt((accel**2).mean())),
            most_accel=float(accel.max()),
            least_accel=float(accel.min()),
            distance=float(speed[:covered].sum()) * dt,
            aside=aside[-1],
            farthest=max(aside, key=abs),
            goal=bool(trace.goal[k]),
            collision=bool(trace.collision[k]),
            passed_ahead=ego.ahead >= 0 and gone_by(ego.ahead) < 0.0,
            passed_by_behind=ego.behind >= 0 and gone_by(ego.behind) > 0.0,
        )


class _Trace:
    """Motion of all vehicles, step by step, and the egos' fates."""

    def __init__(self, slot: Tensor) -> None:
        self._slot, self._rows = slot, torch.arange(len(slot))
        self._frames: list[np.ndarray] = []
        self._there: list[np.ndarray] = []
        self.steps = torch.zeros_like(slot)
        self.goal = self.collision = torch.zeros(len(slot), dtype=torch.bool)
        self.driving = True

    def add(self, step: Step) -> None:
        motion = [getattr(step.after, name) for name in ("x", "y", "yaw", "speed", "accel")]
        self._frames.append(torch.stack(motion).numpy())
        self._there.append(step.active.numpy())
        at = self._rows, self._slot
        mine = step.active[at]
        self.steps += mine
        self.goal = self.goal | (mine & step.outcome.goal[at])
        self.collision = self.collision | (mine & step.outcome.collision[at])
        self.driving = bool((mine & ~step.finished[at]).any())

    def own(self) -> np.ndarray:
        """[5, W, T] x, y, yaw, speed and acceleration of the egos."""
        frames = np.stack(self._frames, -1)  # [5, W, N, T]
        return frames[:, self._rows.numpy(), self._slot.numpy()].astype(np.float64)

    def other(self, world: int, slot: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y [T] of one vehicle, and whether it was there."""
        x, y = (np.array([frame[axis, world, slot] for frame in self._frames]) for axis in (0, 1))
        return x, y, np.array([there[world, slot] for there in self._there])
