"""Where recorded vehicles are on their lanes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.evaluate.logs.recording import Recording
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.near import pairs_within
from phase_sumo.sim.polylines import Polylines

FloatArray = NDArray[np.float64]
REACH = 4.0  # m from a lane's centre line beyond which a vehicle is on no lane
AGAINST = 0.0  # cosine of the angle to the lane's direction at which a vehicle drives against it


@dataclass(frozen=True)
class Places:
    """Places of front bumpers, [V, T] each.

    Attributes:
        lane: index of the lane whose centre line is nearest, -1 off the road or where absent.
        position: m along it.
        lateral: m left of it, NaN without a lane, like the next one.
        yaw: of the lane there in rad.
    """

    lane: NDArray[np.int64]
    position: FloatArray
    lateral: FloatArray
    yaw: FloatArray


def places(recording: Recording, network: LaneNetwork) -> Places:
    """`Places` on ``network``; lanes in the other direction are left out."""
    r = recording
    known = r.present & np.isfinite(r.x)
    half = 0.5 * r.length[:, None]
    front = np.stack((r.x + half * np.cos(r.yaw), r.y + half * np.sin(r.yaw)), -1)[known]
    lines = Polylines.of([lane.points for lane in network.lanes])
    samples = lines.samples(1.0)
    points, ahead, s = lines.at(samples), lines.direction(samples), samples.s
    lane_of = np.repeat(np.arange(len(samples.counts)), samples.counts)
    query, near = pairs_within(front, points, REACH)
    towards = np.stack((np.cos(r.yaw[known]), np.sin(r.yaw[known])), -1)
    same = (towards[query] * ahead[near]).sum(1) > AGAINST
    query, near = query[same], near[same]
    away = front[query] - points[near]
    along = (away * ahead[near]).sum(1)
    aside = ahead[near, 0] * away[:, 1] - ahead[near, 1] * away[:, 0]
    # beside a sample 1 m apart from the next; past a lane's end the distance to that end counts
    cost = np.hypot(np.maximum(np.abs(along) - 1.0, 0.0), aside)
    order = np.lexsort((np.abs(along), np.round(cost, 2), query))
    first = order[np.r_[True, np.diff(query[order]) > 0]] if len(order) else order
    lane, position = np.full(len(front), -1), np.full(len(front), np.nan)
    lateral, yaw = np.full(len(front), np.nan), np.full(len(front), np.nan)
    who, at = query[first], near[first]
    lane[who] = lane_of[at]
    position[who] = s[at] - lines.s[lines.first][lane_of[at]] + along[first]
    lateral[who] = aside[first]
    yaw[who] = np.arctan2(ahead[at, 1], ahead[at, 0])
    return Places(*(_spread(known, values) for values in (lane, position, lateral, yaw)))


def _spread(known: NDArray[np.bool_], values: np.ndarray) -> np.ndarray:
    whole = np.full(known.shape, -1 if values.dtype.kind == "i" else np.nan, values.dtype)
    whole[known] = values
    return whole
