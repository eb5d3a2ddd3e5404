"""Where on the lanes vehicles are, and when they change lanes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.logs.recording import Recording
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.near import nearest
from phase_sumo.sim.polylines import Polylines

SPACING = 1.0  # m between points of centre lines
PIECE = 100_000  # positions looked up at a time
BORDER = 0.3  # m beyond a lane that still belong to the road, like the seams that maps close
MARGIN = 0.5  # m that a vehicle's centre must be past a marking to be in the next lane for good
HOPS = 4  # connections from one lane to the next within which a vehicle is still in "its" lane


@dataclass(frozen=True)
class LanePlaces:
    """Places of a recording's vehicles, all [V, T].

    Attributes:
        lane: the nearest lane, -1 where the centre is on none (or the vehicle absent).
        position: m along its centre line; NaN there, like the next two.
        lateral: m from it, positive to the left.
        yaw: direction of that lane in rad.
        firm: the centre is in the lane by `MARGIN` at least, so that a lane other than before means a change.
    """

    lane: IntArray
    position: FloatArray
    lateral: FloatArray
    yaw: FloatArray
    firm: NDArray[np.bool_]


@dataclass(frozen=True)
class LaneChanges:
    """Lane changes, all [C]: ``vehicle``; ``begin``, the last sample in the old lane; ``end``, the first in
    the new one, both of them firmly."""

    vehicle: IntArray
    begin: IntArray
    end: IntArray


def lane_places(recording: Recording, network: LaneNetwork | None = None) -> LanePlaces:
    """Nearest lane of every sample, of the recording's own network or another one."""
    network = network or recording.network
    lines = Polylines.of([lane.points for lane in network.lanes])
    samples = lines.samples(SPACING)
    at, along = lines.at(samples), lines.direction(samples)
    owner = np.repeat(np.arange(len(samples.counts)), samples.counts)
    width = np.array([lane.width for lane in network.lanes])
    here = recording.present
    query = np.stack((recording.x[here], recording.y[here]), -1)
    radius = 0.5 * float(width.max()) + BORDER + SPACING
    found = [nearest(query[i : i + PIECE], at, radius)[0] for i in range(0, len(query), PIECE)]
    point = np.concatenate([np.zeros(0, np.int64), *found])
    delta, direction = query - at[point], along[point]
    lateral = direction[:, 0] * delta[:, 1] - direction[:, 1] * delta[:, 0]
    ahead = (direction * delta).sum(1)
    half = 0.5 * width[owner[point]]
    inside = (point >= 0) & (np.abs(lateral) <= half + BORDER) & (np.abs(ahead) <= SPACING)
    lane, firm = np.full(here.shape, -1, np.int64), np.zeros(here.shape, np.bool_)
    lane[here] = np.where(inside, owner[point], -1)
    firm[here] = inside & (np.abs(lateral) <= half - MARGIN)

    def known(values: FloatArray) -> FloatArray:
        result = np.full(here.shape, np.nan)
        result[here] = np.where(inside, values, np.nan)
        return result

    position = samples.s[point] - lines.s[lines.first[owner[point]]] + ahead
    yaw = np.arctan2(direction[:, 1], direction[:, 0])
    return LanePlaces(lane, known(position), known(lateral), known(yaw), firm)


def lane_changes(recording: Recording, places: LanePlaces) -> LaneChanges:
    """Where vehicles come to be in another lane.

    A lane that follows the old one, or a fork of it that lies where the old one does, is no other lane; nor
    is a marking touched or ridden on: see `LanePlaces.firm`.
    """
    vehicle, sample = np.nonzero(places.firm)
    lane = places.lane[vehicle, sample]
    same = _same(recording.network)
    changed = (vehicle[1:] == vehicle[:-1]) & ~same[lane[:-1], lane[1:]]
    # within one presence: nobody is followed over a gap
    missing = np.cumsum(~recording.present, axis=1, dtype=np.int32)
    changed &= missing[vehicle[1:], sample[1:]] == missing[vehicle[:-1], sample[:-1]]
    at = np.flatnonzero(changed)
    left = np.array(
        [_has_left(recording, int(vehicle[i]), int(sample[i + 1]), int(lane[i])) for i in at], bool
    )
    at = at[left]
    return LaneChanges(vehicle[at], sample[at], sample[at + 1])


def _has_left(recording: Recording, vehicle: int, sample: int, lane: int) -> bool:
    """The vehicle's centre is firmly beside a lane, or beside its straight continuation."""
    points, width = recording.network.lanes[lane].points, recording.network.lanes[lane].width
    at = np.array([recording.x[vehicle, sample], recording.y[vehicle, sample]])
    a, along = points[:-1], np.diff(points, axis=0)
    share = ((at - a) * along).sum(1) / (along**2).sum(1)
    low, high = np.zeros(len(a)), np.ones(len(a))
    low[0], high[-1] = -np.inf, np.inf
    foot = a + np.clip(share, low, high)[:, None] * along
    return bool(np.hypot(*(at - foot).T).min() > 0.5 * width + 0.5 * MARGIN)


def _same(network: LaneNetwork) -> NDArray[np.bool_]:
    """[L, L] one lane is the other, or follows it within `HOPS` connections."""
    count = len(network.lanes)
    step = np.eye(count, dtype=np.float32)
    for a, b in network.successors:
        step[a, b] = 1.0
    reach = step
    for _ in range(HOPS - 1):
        reach = np.minimum(reach @ step, 1.0)
    return (reach + reach.T) > 0
