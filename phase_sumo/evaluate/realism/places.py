"""Tracks on a longer road: lane, distance along it, and the same as `Trajectories`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.logs.lane_matching import lane_places
from phase_sumo.logs.recording import PERIOD, Recording
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.near import nearest
from phase_sumo.sim.polylines import Polylines

SPACING = 1.0  # m between points of centre lines
REACH = 20.0  # m from a lane within which its points are looked up


@dataclass(frozen=True)
class Places:
    """Where the centres of the boxes are, all [V, T].

    Attributes:
        lane: index of the nearest lane, -1 on none or absent.
        position: m along its centre line; NaN there, like the next two.
        lateral: m left of it.
        yaw: of the lane in rad.
    """

    lane: NDArray[np.int64]
    position: FloatArray
    lateral: FloatArray
    yaw: FloatArray


def places(recording: Recording, network: LaneNetwork) -> Places:
    """`Places` of a recording's vehicles on ``network`` instead of its own."""
    found = lane_places(replace(recording, network=network))
    position = np.full(found.lane.shape, np.nan)
    for number in np.unique(found.lane[found.lane >= 0]).tolist():
        line = Polylines.of([network.lanes[number].points])
        samples = line.samples(SPACING)
        on = found.lane == number
        at = np.stack((recording.x[on], recording.y[on]), -1)
        points, ahead = line.at(samples), line.direction(samples)
        point, _ = nearest(at, points, REACH)
        along = ((at - points[point]) * ahead[point]).sum(1)
        position[on] = samples.s[point] - line.s[0] + along
    return Places(found.lane, position, found.offset, found.yaw)


def trajectories(recording: Recording, network: LaneNetwork, where: Places) -> Trajectories:
    """The tracks as the traffic measures take them; positions are those of the front bumper.

    ``x``, ``y`` are the centre of the box here, not the rear axle.
    """
    vehicle, sample = np.nonzero(recording.present & (where.lane >= 0))
    order = np.lexsort((vehicle, sample))
    vehicle, sample = vehicle[order], sample[order]
    count, lanes = len(vehicle), network.lanes

    def of(values: np.ndarray) -> np.ndarray:
        return values[vehicle, sample]

    following: list[list[int]] = [[] for _ in lanes]
    for a, b in network.successors:
        following[a].append(b)
    size = len(recording.length)
    shape = np.zeros((size, 8))
    shape[:, 0], shape[:, 1] = recording.length, recording.width
    return Trajectories(
        time=PERIOD * sample.astype(np.float64),
        vehicle=vehicle,
        x=of(recording.x),
        y=of(recording.y),
        yaw=of(recording.yaw),
        hitch=np.zeros(count),
        speed=of(recording.speed),
        accel=np.zeros(count),
        lane=of(where.lane),
        position=of(where.position) + 0.5 * recording.length[vehicle],
        lateral=of(where.lateral),
        controlled=np.zeros(count, bool),
        target_speed=np.zeros(count),
        alpha=np.full(count, np.nan),
        vehicle_ids=tuple(f"v{k}" for k in range(size)),
        vehicle_types=tuple(recording.kind),
        emission_classes=("",) * size,
        shape=shape,
        length=recording.length,
        lane_ids=tuple(lane.id for lane in lanes),
        lane_edges=tuple(f":{lane.edge}" if lane.connector else lane.edge for lane in lanes),
        lane_length=np.array([float(np.hypot(*np.diff(lane.points, axis=0).T).sum()) for lane in lanes]),
        lane_speed=np.array([lane.speed_limit for lane in lanes]),
        lane_next=tuple(map(tuple, following)),
        period=PERIOD,
    )
