"""Motion of many vehicles as traffic: distance, speed, flow, delay, lane changes, comfort.

Words: gap is bumper to bumper, headway front to front. All rates per vehicle-km are sums over all
vehicles, so a long trip weighs more than a short one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phase_sumo.evaluate.trajectories import Trajectories

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

HARD_BRAKING = -3.0  # m/s^2


@dataclass(frozen=True)
class Steps:
    """Consecutive sample pairs of one vehicle: rows ``before`` and ``after`` and the time between in s."""

    before: IntArray
    after: IntArray
    seconds: FloatArray


def steps(t: Trajectories) -> Steps:
    """Pairs of samples one period apart; a vehicle that left the observed road and came back is cut there."""
    order = t.by_vehicle()
    before, after = order[:-1], order[1:]
    seconds = t.time[after] - t.time[before]
    joined = (t.vehicle[before] == t.vehicle[after]) & (seconds < 1.5 * t.period)
    return Steps(before[joined], after[joined], seconds[joined])


def vehicle_km(t: Trajectories) -> float:
    """Distance driven by all vehicles: sum of mean speed x time between samples, in km."""
    s = steps(t)
    return float((0.5 * (t.speed[s.before] + t.speed[s.after]) * s.seconds).sum()) / 1000.0


def mean_speed(t: Trajectories) -> float:
    """Space-mean speed in m/s: total distance / total time (Edie's definition on the observed road)."""
    total = steps(t).seconds.sum()
    return 1000.0 * vehicle_km(t) / total if total else float("nan")


def flow(t: Trajectories, edge: str, position: float, begin: float, end: float) -> float:
    """Vehicles per hour past a cross-section of all lanes of ``edge``.

    A vehicle passes between two samples when the first lies on the edge before ``position`` (m along the
    lane) and the second beyond it or on another edge; q = 3600 n / (end - begin).
    """
    s = steps(t)
    on_edge = np.array([e == edge for e in t.lane_edges] + [False])  # row -1: off any lane
    first, second = t.lane[s.before], t.lane[s.after]
    passed = on_edge[first] & (t.position[s.before] < position)
    passed &= ((second >= 0) & ~on_edge[second]) | (on_edge[second] & (t.position[s.after] >= position))
    passed &= (t.time[s.after] > begin) & (t.time[s.after] <= end)
    return 3600.0 * int(passed.sum()) / (end - begin)


def lane_changes(t: Trajectories) -> Steps:
    """Steps that change lane within one edge; the lane is the one that holds the centre of the front bumper.

    A change that falls on the step from one edge to the next is not counted, for any model.
    """
    s = steps(t)
    a, b = t.lane[s.before], t.lane[s.after]
    edges = {name: i for i, name in enumerate(dict.fromkeys(t.lane_edges))}
    edge = np.array([edges[name] for name in t.lane_edges] + [-1], np.int64)
    inside = np.array([name.startswith(":") for name in t.lane_edges] + [True])
    changed = (a >= 0) & (b >= 0) & (a != b) & (edge[a] == edge[b]) & ~inside[a]
    return Steps(s.before[changed], s.after[changed], s.seconds[changed])


def episodes(t: Trajectories, active: BoolArray) -> int:
    """Maximal runs of consecutive samples of one vehicle in which ``active`` [S] holds."""
    s = steps(t)
    continued = np.zeros(len(active), bool)
    continued[s.after] = active[s.before]
    return int((active & ~continued).sum())


def acceleration(t: Trajectories) -> FloatArray:
    """[S] speed change since the sample before / time between, in m/s^2; 0 for a first sample."""
    s = steps(t)
    accel = np.zeros(len(t.speed))
    accel[s.after] = (t.speed[s.after] - t.speed[s.before]) / s.seconds
    return accel


def jerk(t: Trajectories) -> FloatArray:
    """Change of `acceleration` between consecutive steps of one vehicle / time between, in m/s^3."""
    s, accel = steps(t), acceleration(t)
    known = np.zeros(len(accel), bool)
    known[s.after] = True  # the first sample of a vehicle has no acceleration yet
    both = known[s.before]
    return (accel[s.after] - accel[s.before])[both] / s.seconds[both]


def delay(t: Trajectories) -> float:
    """Time lost against driving at one's own target speed, in s, summed over all vehicles.

    Time that was taken minus time that the same distance takes at the target speed v* of the place:
    sum of dt (1 - v / v*). v* is the lane's limit x the vehicle's speed factor (or the target it was given),
    at most what its type can drive. Driving faster than v* counts as negative; insertion delay is apart.
    """
    s = steps(t)
    target = t.target_speed[s.before]
    speed = 0.5 * (t.speed[s.before] + t.speed[s.after])
    known = target > 0.0
    return float((s.seconds * (1.0 - speed / np.where(known, target, 1.0)))[known].sum())


def hard_brakings(t: Trajectories, threshold: float = HARD_BRAKING) -> int:
    """Episodes with an `acceleration` below ``threshold`` m/s^2."""
    return episodes(t, acceleration(t) < threshold)


def cross_section(t: Trajectories) -> tuple[str, float]:
    """The middle of the edge with the most samples: where flow is counted when nobody names a place."""
    edge_of = [e if not e.startswith(":") else "" for e in t.lane_edges]
    count: dict[str, int] = {}
    for lane, samples in zip(*np.unique(t.lane[t.lane >= 0], return_counts=True), strict=True):
        if edge_of[lane]:
            count[edge_of[lane]] = count.get(edge_of[lane], 0) + int(samples)
    if not count:
        return "", 0.0
    edge = max(count, key=lambda e: (count[e], e))
    return edge, 0.5 * float(t.lane_length[t.lane_edges.index(edge)])
