"""Trajectories as the encoder sees them: each vehicle with those around it, in its own frame at the begin.

Only places and sizes enter. Directions and speeds are differences of places, so that it does not matter how
a log or a simulator defines them.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from phase_sumo.logs.recording import PERIOD, Recording

STRIDE = 5  # samples of a recording from one token to the next
AGENTS = 7  # the vehicle and the nearest ones around it
RANGE = 100.0  # m within which they are looked for
ALONG, ASIDE, FORWARDS, SIDEWAYS, SPEED, LENGTH, WIDTH, OWN, THERE = range(9)
FEATURES = 9
SCALE = np.array([20.0, 4.0, 10.0, 2.0, 20.0, 10.0, 2.0, 1.0, 1.0])


def trajectories(scene: Recording) -> NDArray[np.int64]:
    """[n] vehicles that are there from the first to the last sample."""
    return np.flatnonzero(scene.present.all(1))


def features(scene: Recording, rows: NDArray[np.int64]) -> Tensor:
    """[n, `AGENTS`, T, `FEATURES`] float32 of the vehicles ``rows``, T samples `STRIDE` apart.

    The frame of a vehicle has its origin at its first place and its x axis along its first direction, and
    moves on with its first speed v_0. The features are, divided by `SCALE`: place along and aside in that
    frame in m, speed along (less v_0) and aside in m/s, v_0 in m/s, length and width in m, 1 for the vehicle
    itself, 1 where the vehicle of the token is there. All are 0 where it is not; the vehicle itself comes
    first, then the others by their distance at the begin.
    """
    at = np.stack((scene.x, scene.y), -1)[:, ::STRIDE]
    there = scene.present[:, ::STRIDE]
    seconds = STRIDE * PERIOD
    way = np.diff(at, axis=1, append=np.nan)
    way[:, 1:] = np.where(np.isnan(way[:, 1:]), way[:, :-1], way[:, 1:])  # the last one has none ahead
    clock = np.arange(at.shape[1]) * seconds
    result = np.zeros((len(rows), AGENTS, at.shape[1], FEATURES))
    for k, row in enumerate(rows.tolist()):
        yaw = scene.yaw[row, 0]
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, -sin], [sin, cos]])
        speed = float((way[row, 0] @ turn)[0] / seconds)
        apart = np.hypot(*(at[:, 0] - at[row, 0]).T)
        near = np.argsort(np.where(there[:, 0] & (apart < RANGE), apart, np.inf), kind="stable")[:AGENTS]
        near = near[there[near, 0] & (apart[near] < RANGE)]
        place = (at[near] - at[row, 0]) @ turn
        velocity = way[near] @ turn / seconds
        token = result[k, : len(near)]
        token[..., ALONG], token[..., ASIDE] = place[..., 0] - speed * clock, place[..., 1]
        token[..., FORWARDS], token[..., SIDEWAYS] = velocity[..., 0] - speed, velocity[..., 1]
        token[..., SPEED] = speed
        token[..., LENGTH], token[..., WIDTH] = scene.length[near, None], scene.width[near, None]
        token[..., OWN] = (near == row)[:, None]
        token[..., THERE] = 1.0
        token[~there[near]] = 0.0
    return torch.from_numpy(np.nan_to_num(result / SCALE).astype(np.float32))
