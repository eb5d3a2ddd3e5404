"""What vehicles do at each sample of a scene: the quantities whose distributions are compared.

Distances that people can read: Wasserstein between distributions, and likelihoods after WOSAC.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray
from phase_sumo.evaluate import surrogate_safety
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.logs.lane_matching import LanePlaces, lane_changes, lane_places
from phase_sumo.logs.recording import PERIOD, Recording
from phase_sumo.sim.lanes import LaneNetwork

SPAN = 5  # samples, 0.5 s, over which speed and yaw change: recorded ones are noisy over one
BESIDE = 1.0  # m beyond the border that a vehicle on no lane is counted to be
SIGHT = 60.0  # m within which another vehicle is looked for


@dataclass(frozen=True)
class Quantities:
    """All [N, T], NaN where there is none, but for the last three.

    Attributes:
        speed: m/s.
        acceleration: m/s^2, over `SPAN` samples, like the next one.
        yaw_rate: rad/s.
        gap: m to the leader in the lane, bumper to bumper, from 0 up to 150.
        time_headway: s, front to front, above 3 m/s.
        ttc: s to collision with the leader; inf when not closing in or without a leader.
        nearest: m to the nearest other box; negative when they overlap.
        road_edge: m from the box to the nearer border of the road; negative on the road.
        lateral: m left of the lane's centre.
        change_seconds: [C] of each lane change, from the last sample firmly in the old lane to the first
            firmly in the new one: 0.5 m from the marking on either side.
        changes: [N] lane changes of each vehicle.
        km: [N] driven by each vehicle.
    """

    speed: FloatArray
    acceleration: FloatArray
    yaw_rate: FloatArray
    gap: FloatArray
    time_headway: FloatArray
    ttc: FloatArray
    nearest: FloatArray
    road_edge: FloatArray
    lateral: FloatArray
    change_seconds: FloatArray
    changes: NDArray[np.int64]
    km: FloatArray


def quantities(scene: Recording, network: LaneNetwork) -> Quantities:
    """`Quantities` of the vehicles of a scene on ``network``, the scene's own with longer ends."""
    where = lane_places(scene, network)
    found = lane_changes(replace(scene, network=network), where)
    step = np.hypot(np.diff(scene.x, axis=1), np.diff(scene.y, axis=1))
    gap, headway, ttc = _following(scene, network, where)
    return Quantities(
        speed=np.where(scene.present, scene.speed, np.nan),
        acceleration=_rate(np.diff(scene.speed, axis=1)),
        yaw_rate=_rate(np.remainder(np.diff(scene.yaw, axis=1) + np.pi, 2.0 * np.pi) - np.pi),
        gap=gap,
        time_headway=headway,
        ttc=ttc,
        nearest=_nearest(scene),
        road_edge=_road_edge(scene, network, where),
        lateral=where.lateral,
        change_seconds=PERIOD * (found.end - found.begin).astype(np.float64),
        changes=np.bincount(found.vehicle, minlength=len(scene.length)),
        km=np.nansum(step, 1) / 1000.0,
    )


def trajectories(recording: Recording, network: LaneNetwork, where: LanePlaces) -> Trajectories:
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


def _rate(steps: FloatArray) -> FloatArray:
    """[N, T] change per second over the `SPAN` steps [N, T - 1] that end at a sample."""
    total = np.cumsum(np.pad(steps, ((0, 0), (1, 0))), 1)  # NaN from where a vehicle is lost
    result = np.full(total.shape, np.nan)
    result[:, SPAN:] = (total[:, SPAN:] - total[:, :-SPAN]) / (SPAN * PERIOD)
    return result


def _following(
    scene: Recording, network: LaneNetwork, where: LanePlaces
) -> tuple[FloatArray, FloatArray, FloatArray]:
    t = trajectories(scene, network, where)
    pairs = surrogate_safety.following(t)
    row, sample = t.vehicle[pairs.follower], np.rint(t.time[pairs.follower] / PERIOD).astype(np.int64)
    gap, headway = (np.full(scene.present.shape, np.nan) for _ in range(2))
    ttc = np.where(scene.present, np.inf, np.nan)
    gap[row, sample] = np.maximum(pairs.gap, 0.0)
    speed = t.speed[pairs.follower]
    moving = speed > surrogate_safety.HEADWAY_SPEED
    front = pairs.gap + t.length[t.vehicle[pairs.leader]]
    headway[row[moving], sample[moving]] = np.maximum(front[moving], 0.0) / speed[moving]
    ttc[row, sample] = surrogate_safety.time_to_collision(t, pairs)
    return gap, headway, ttc


def _nearest(scene: Recording) -> FloatArray:
    """In the frame of each vehicle, others taken as parallel to it: roads have one direction."""
    cos, sin = np.cos(scene.yaw), np.sin(scene.yaw)
    dx, dy = scene.x[None] - scene.x[:, None], scene.y[None] - scene.y[:, None]
    half_length = 0.5 * (scene.length[None] + scene.length[:, None])[..., None]
    half_width = 0.5 * (scene.width[None] + scene.width[:, None])[..., None]
    along = np.abs(dx * cos[:, None] + dy * sin[:, None]) - half_length
    aside = np.abs(dy * cos[:, None] - dx * sin[:, None]) - half_width
    outside = np.hypot(np.maximum(along, 0.0), np.maximum(aside, 0.0))
    distance = np.where((along < 0) & (aside < 0), np.maximum(along, aside), outside)
    distance[np.arange(len(distance)), np.arange(len(distance))] = np.inf
    distance = np.where(np.isnan(distance), np.inf, distance).min(1, initial=SIGHT)
    return np.where(scene.present, distance, np.nan)


def _road_edge(scene: Recording, network: LaneNetwork, where: LanePlaces) -> FloatArray:
    left, right = (_room(network, side) for side in ("left", "right"))
    centre = np.minimum(left[where.lane] - where.lateral, right[where.lane] + where.lateral)
    distance = 0.5 * scene.width[:, None] - centre
    return np.where(scene.present, np.where(where.lane >= 0, distance, BESIDE), np.nan)


def _room(network: LaneNetwork, side: str) -> FloatArray:
    """[L] m from each lane's centre to the border of the lanes abreast on that side."""
    room = np.array([0.5 * lane.width for lane in network.lanes])
    for i, lane in enumerate(network.lanes):
        beside, seen = getattr(lane, side), {i}
        while beside >= 0 and beside not in seen:
            seen.add(beside)
            room[i] += network.lanes[beside].width
            beside = getattr(network.lanes[beside], side)
    return room


LONGEST_TTC = 10.0  # s: longer ones, and none at all, count as this
LONGEST_HEADWAY = 10.0  # s
EVERY = 5  # samples, 0.5 s, from one that counts to the next
UNITS = {
    "speed": "m/s",
    "acceleration": "m/s²",
    "gap": "m",
    "time_headway": "s",
    "ttc": "s",
    "lateral": "m",
    "lane_change_duration": "s",
}
PSEUDOCOUNT = 0.1  # WOSAC's, added to every bin


@dataclass(frozen=True)
class Histogram:
    """Evenly spaced bins; values beyond the ends count in the outermost ones."""

    low: float
    high: float
    bins: int


# WOSAC's ranges and bins, speeds up to 45 instead of 25 m/s in bins as wide
HISTOGRAMS = {
    "speed": Histogram(0.0, 45.0, 18),
    "acceleration": Histogram(-12.0, 12.0, 11),
    "yaw_rate": Histogram(-0.628, 0.628, 11),
    "nearest": Histogram(-5.0, 40.0, 10),
    "ttc": Histogram(0.0, 5.0, 10),
    "road_edge": Histogram(-20.0, 40.0, 10),
}


def wasserstein(x: FloatArray, y: FloatArray, x_weight: FloatArray, y_weight: FloatArray) -> float:
    """1-Wasserstein distance of weighted samples: the area between their distribution functions.

    NaN where one of them has no weight.
    """
    if not (x_weight.sum() > 0 and y_weight.sum() > 0):
        return float("nan")
    values = np.concatenate((x, y))
    mass = np.concatenate((x_weight / x_weight.sum(), -y_weight / y_weight.sum()))
    order = np.argsort(values, kind="stable")
    return float((np.abs(np.cumsum(mass[order])[:-1]) * np.diff(values[order])).sum())


def samples(scene: Quantities) -> dict[str, FloatArray]:
    """Values of `UNITS` in a scene."""
    taken = {
        name: getattr(scene, name)[:, ::EVERY].ravel()
        for name in ("speed", "acceleration", "gap", "time_headway", "lateral")
    }
    taken = {name: values[np.isfinite(values)] for name, values in taken.items()}
    taken["time_headway"] = taken["time_headway"][taken["time_headway"] <= LONGEST_HEADWAY]
    ttc = scene.ttc[:, ::EVERY].ravel()
    taken["ttc"] = np.minimum(ttc[~np.isnan(ttc)], LONGEST_TTC)
    taken["lane_change_duration"] = scene.change_seconds
    return taken


def likelihoods(log: Quantities, simulated: Quantities) -> dict[str, FloatArray]:
    """[N] likelihood of each vehicle's recorded samples under the histogram of its simulated ones.

    exp(mean over samples of log p), p = (count + `PSEUDOCOUNT`) / (total + `PSEUDOCOUNT` x bins): WOSAC's
    (Montali et al. 2023) with all samples of a vehicle in one histogram, and as many rollouts as are in
    ``simulated``: one. NaN for a vehicle without samples in either. 1 is the highest.
    """
    return {
        name: np.array(
            [
                _likelihood(a, b, shape)
                for a, b in zip(getattr(log, name), getattr(simulated, name), strict=True)
            ]
        )
        for name, shape in HISTOGRAMS.items()
    }


def _likelihood(log: FloatArray, simulated: FloatArray, shape: Histogram) -> float:
    log, simulated = log[~np.isnan(log)], simulated[~np.isnan(simulated)]
    if not (len(log) and len(simulated)):
        return float("nan")
    count = np.bincount(_bin(simulated, shape), minlength=shape.bins) + PSEUDOCOUNT
    return float(np.exp(np.log(count / count.sum())[_bin(log, shape)].mean()))


def _bin(values: FloatArray, shape: Histogram) -> NDArray[np.int64]:
    share = (np.clip(values, shape.low, shape.high) - shape.low) / (shape.high - shape.low)
    return np.minimum((share * shape.bins).astype(np.int64), shape.bins - 1)


def lane_change_rate(scenes: Sequence[Quantities], weight: FloatArray) -> float:
    """Lane changes per vehicle-km over scenes that count ``weight`` [S] times each."""
    changes = np.array([scene.changes.sum() for scene in scenes], np.float64)
    km = np.array([scene.km.sum() for scene in scenes])
    return float(weight @ changes / (weight @ km)) if weight @ km > 0 else float("nan")
