"""Scores of driven scenes: goals, contacts and distances to the record, per vehicle and as tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from phase_sumo.config import SimConfig
from phase_sumo.evaluate.fixed_worlds import trailer_slots
from phase_sumo.evaluate.statistics import bootstrap_by
from phase_sumo.evaluate.zero_shot import Frame, Scenes
from phase_sumo.logs.recording import PERIOD
from phase_sumo.sim.dimensions import KINDS
from phase_sumo.sim.events import agent_contacts, goal_reached, road_contacts
from phase_sumo.sim.vehicles import boxes

COMPARED = round(5.0 / PERIOD)  # steps of ADE and FDE
SHRUNK = 0.7  # GPUDrive's boxes, for the second column
MEASURES = (
    "goal_rate",
    "agent_collision_rate",
    "at_fault_rate",
    "road_collision_rate",
    "success_rate",
    "agent_collision_rate_small",
    "road_collision_rate_small",
    "success_rate_small",
    "ade_5s",
    "fde_5s",
)


@dataclass(frozen=True)
class Scores:
    """What became of every vehicle: `MEASURES` by name, [W, N] float64; NaN in empty slots."""

    values: dict[str, NDArray[np.float64]]


def score(found: Scenes, frames: Iterable[Frame], progress: Callable[[float], None] | None = None) -> Scores:
    """Watch the scenes until they end.

    goal: the reference point passed within 2 m of its goal. agent_collision: a box overlapped another's in
    any step; at_fault: by the paper's rule. road_collision: a box touched the road's edge or the vehicle
    was beside the road. success: goal without a collision at fault. Names ending in ``_small`` take all
    boxes times `SHRUNK`. ADE and FDE are the mean and the last distance to the record within 5 s; a vehicle
    that has left at its goal goes on straight at the speed it had, and only samples that were recorded
    count (FDE: those at 5 s).
    """
    start, log = found.start, found.log
    happened = {name: torch.zeros_like(start.active) for name in ("goal", "at_fault", "at_fault_small")}
    for name in ("agent_collision", "road_collision"):
        happened |= {name + end: torch.zeros_like(start.active) for end in ("", "_small")}
    x, y = start.state.x, start.state.y
    velocity = torch.zeros(2, *x.shape)
    total, count = torch.zeros_like(x), torch.zeros_like(x)
    final = torch.full_like(x, torch.nan)
    steps, t = log.x.shape[-1] - 1, 0
    for t, frame in enumerate(frames, 1):
        for name, now in _events(found, frame).items():
            happened[name] |= now
        if t <= COMPARED:
            moved = torch.stack((frame.after.x - x, frame.after.y - y))
            velocity = torch.where(frame.active, moved, velocity)
            x, y = x + velocity[0], y + velocity[1]
            total, count, final = _compare(log.x[..., t], log.y[..., t], x, y, total, count, final, t)
        if progress is not None:
            progress(t / steps)
    for later in range(t + 1, min(COMPARED, steps) + 1):  # all have left
        x, y = x + velocity[0], y + velocity[1]
        total, count, final = _compare(log.x[..., later], log.y[..., later], x, y, total, count, final, later)
    happened["success"] = happened["goal"] & ~happened["at_fault"]
    happened["success_small"] = happened["goal"] & ~happened["at_fault_small"]
    values = {name: _column(happened[_event(name)], start.active) for name in MEASURES[:-2]}
    values["ade_5s"] = _column(total / count.clamp_min(1.0), start.active & (count > 0))
    values["fde_5s"] = _column(final, start.active)
    return Scores(values)


def _event(measure: str) -> str:
    """goal_rate -> goal, agent_collision_rate_small -> agent_collision_small."""
    return measure.replace("_rate", "")


def _column(values: Tensor, counted: Tensor) -> NDArray[np.float64]:
    return torch.where(counted, values.double(), torch.nan).numpy()


def _events(found: Scenes, frame: Frame) -> dict[str, Tensor]:
    start, active = found.start, frame.active
    sim, slots = SimConfig(), trailer_slots(start.shape)
    box = boxes(start.shape, frame.after)
    result = {"goal": goal_reached(frame.before, frame.after, start.task, sim.goal_radius) & active}
    for end, size in (("", 1.0), ("_small", SHRUNK)):
        scaled = torch.cat((box[:4], size * box[4:]))
        collision, at_fault = agent_contacts(scaled, active, slots)
        edge, _ = road_contacts(scaled, found.road_map, start.map_index, slots)
        result |= {
            "agent_collision" + end: collision,
            "at_fault" + end: at_fault,
            "road_collision" + end: edge & active,
        }
    return result


def _compare(
    log_x: Tensor, log_y: Tensor, x: Tensor, y: Tensor, total: Tensor, count: Tensor, final: Tensor, t: int
) -> tuple[Tensor, Tensor, Tensor]:
    off = torch.hypot(x - log_x, y - log_y)
    known = ~off.isnan()
    total, count = total + off.nan_to_num(), count + known
    return total, count, off if t == COMPARED else final


def table(parts: Sequence[Scenes], scores: Sequence[Scores]) -> dict[str, Any]:
    """Scores over all scenes, given in parts, per source (`Recording.source`) and per vehicle type.

    Returns:
        JSON types: ``scenarios``, ``recordings``, ``agents``, and for each of `MEASURES` the mean and
        standard deviation over the scenarios (of the mean over each one's vehicles) and the bootstrap
        interval of the mean, drawn by recording; the same under ``by_source`` and ``by_type``.
    """
    windows = [w for part in parts for w in part.windows]
    slots = max(part.start.active.shape[1] for part in parts)
    size = len(windows), slots
    kinds, first = np.full(size, -1), 0
    values = {name: np.full(size, np.nan) for name in MEASURES}
    for part, own in zip(parts, scores, strict=True):
        for k, (window, rows) in enumerate(zip(part.windows, part.agents, strict=True)):
            kinds[first + k, : len(rows)] = [KINDS.index(window.recording.kind[row]) for row in rows]
        rows = slice(first, first + len(part.windows))
        for name, column in own.values.items():
            values[name][rows, : column.shape[1]] = column
        first += len(part.windows)
    recordings = np.array([w.recording.source + ":" + w.recording.name for w in windows])
    sources = np.array([w.recording.source for w in windows])

    def group(counted: NDArray[np.bool_]) -> dict[str, Any]:
        return _group(values, recordings, counted)

    return {
        **group(kinds >= 0),
        "by_source": {
            name: group((kinds >= 0) & (sources == name)[:, None]) for name in sorted(set(sources))
        },
        "by_type": {
            name: group(kinds == index) for index, name in enumerate(KINDS) if (kinds == index).any()
        },
    }


def _group(
    values: dict[str, NDArray[np.float64]], recordings: NDArray[np.str_], counted: NDArray[np.bool_]
) -> dict[str, Any]:
    some = counted.any(1)
    result: dict[str, Any] = {
        "scenarios": int(some.sum()),
        "recordings": len(set(recordings[some])),
        "agents": int(counted.sum()),
    }
    for name, column in values.items():
        own = np.where(counted, column, np.nan)[some]
        known = np.isfinite(own)
        mean = np.where(known, own, 0.0).sum(1) / np.where(known.any(1), known.sum(1), np.nan)
        interval = bootstrap_by(mean, recordings[some])
        result[name] = {
            "mean": _known(interval.mean),
            "std": float(np.nanstd(mean, ddof=1)) if np.isfinite(mean).sum() > 1 else None,
            "low": _known(interval.low),
            "high": _known(interval.high),
        }
    return result


def _known(value: float) -> float | None:
    """JSON has no NaN: null where one recording, or no sample, leaves nothing to say."""
    return value if np.isfinite(value) else None
