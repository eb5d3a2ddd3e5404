"""Recordings from plain arrays, on three straight lanes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from phase_sumo.logs.recorded_roads import Carriageway, straight_road
from phase_sumo.logs.recording import Recording
from phase_sumo.logs.sampling import path_speed

CENTRES = np.array([0.0, 3.6, 7.2])  # y of the lanes, from right to left
ROAD = straight_road("straight", [Carriageway("road", -10.0, 1000.0, CENTRES, np.full(3, 3.6))])


def recording_of(x, y, length=None, width=None, kind=None, yaw: ArrayLike = 0.0, speed=None, network=ROAD):
    """Vehicles [V, T], absent where x is NaN; cars of 4.8 m by default."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    present, count = ~np.isnan(x), len(x)
    return Recording(
        name="by_hand",
        source="tracks",
        network=network,
        present=present,
        x=x,
        y=np.where(present, y, np.nan),
        yaw=np.where(present, np.broadcast_to(yaw, x.shape), np.nan),
        speed=path_speed(x, y, present) if speed is None else np.where(present, speed, np.nan),
        length=np.array(length or [4.8] * count, float),
        width=np.array(width or [1.9] * count, float),
        kind=tuple(kind or ("car",) * count),
        flags=(frozenset(),) * count,
    )
