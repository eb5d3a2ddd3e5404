"""The zero-shot protocol on sources of recorded traffic: a policy, and what it is compared with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import Any

import numpy as np

from phase_sumo.bridge.maps.lanelet2 import read_road
from phase_sumo.bridge.maps.road_model import road_model
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.scene_scores import Scores, score, table
from phase_sumo.evaluate.zero_shot import (
    Frame,
    Scenes,
    agents_of,
    constant_velocity,
    driven,
    motion_of,
    replayed,
    scenes,
)
from phase_sumo.logs.recording import Recording, Window
from phase_sumo.logs.sources import open_sources
from phase_sumo.logs.windows import windows
from phase_sumo.policy.checkpoint import Policy
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.road_map import RoadMap, merge
from phase_sumo.studies.log_rollout import roll_out_all

TOGETHER = 64  # worlds side by side
IDM = "idm"


def evaluate_logs(
    sources: Sequence[str],
    policy: Policy,
    *,
    most: int = 512,
    all_windows: bool = False,
    references: bool = False,
    seed: int = 0,
    sampled: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> dict[str, Any]:
    """Goal, collision and success rates and distances to the log in recorded scenes.

    Args:
        sources: ``tracks:FILE``, ``commonroad:DIR``, ``exid:DIR`` ...
        most: windows of 10 s, drawn at random where there are more; windows do not overlap.
        all_windows: take windows without a lane change, too.
        references: score the log itself, constant velocity and SUMO's IDM on the same windows.
        seed: of the windows drawn, alpha and actions.
        sampled: actions drawn from the policy's distribution instead of the most probable ones.

    Returns:
        `table` of the policy, and of the references by name under ``references``.

    Raises:
        PhaseError: a source cannot be read, or there is no window.
    """
    report = progress or (lambda share, text: None)
    opened = open_sources(sources, read_road)
    chosen = _windows(chain.from_iterable(opened), all_windows, most, seed, report)
    networks = list({id(w.recording.network): w.recording.network for w in chosen}.values())
    parts = _scenes(chosen, networks, merge([_road_map(network) for network in networks]), seed)

    def scored(name: str, frames: Callable[[Scenes], Iterator[Frame]]) -> dict[str, Any]:
        done: list[Scores] = []
        for found in parts:
            share = len(done) / len(parts)
            done.append(score(found, frames(found), lambda s, at=share: report(at + s / len(parts), name)))
        return table(parts, done)

    result = scored("policy", lambda found: driven(found, policy, seed, sampled))
    result["references"] = {}
    if references:
        tracks = _idm(chosen, seed, report)
        result["references"] = {
            "log": scored("log", lambda found: replayed(found, found.log)),
            "constant-velocity": scored(
                "constant velocity", lambda found: replayed(found, constant_velocity(found))
            ),
            IDM: scored(
                IDM,
                lambda found: replayed(found, motion_of(found, [tracks[id(w)] for w in found.windows])),
            ),
        }
    return result


def _windows(
    recordings: Iterable[Recording],
    all_windows: bool,
    most: int,
    seed: int,
    report: Callable[[float, str], None],
) -> list[Window]:
    """``most`` windows at most, in their order, each as likely to be kept as any other.

    Every window draws a number, and those with the least are kept, so that none needs to wait for the last
    recording.
    """

    def cut(recording: Recording) -> list[Window]:
        report(0.0, f"reading, {recording.name}")
        return [w for w in windows(recording, lane_changes_only=not all_windows) if len(agents_of(w))]

    rng, kept = np.random.default_rng(seed), list[tuple[float, Window]]()
    for found in map(cut, recordings):  # a loop over the recordings would hold one while it reads the next
        kept += zip(rng.random(len(found)).tolist(), found, strict=True)
        if len(kept) > most:
            limit = sorted(number for number, _ in kept)[most - 1]
            kept = [(number, window) for number, window in kept if number <= limit]
    if not kept:
        raise PhaseError(
            "the recordings hold no window with a lane change; pass --all-windows, or other recordings"
        )
    return [window for _, window in kept]


def _scenes(
    chosen: Sequence[Window], networks: Sequence[LaneNetwork], road_map: RoadMap, seed: int
) -> list[Scenes]:
    return [
        scenes(chosen[first : first + TOGETHER], networks, road_map, seed, first)
        for first in range(0, len(chosen), TOGETHER)
    ]


def _road_map(network: LaneNetwork) -> RoadMap:
    return road_model(network).map


def _idm(chosen: Sequence[Window], seed: int, report: Callable[[float, str], None]) -> dict[int, Recording]:
    """Tracks by the window's identity."""
    return {id(w): tracks[IDM] for w, _, tracks in roll_out_all(chosen, [IDM], None, seed, report)}
