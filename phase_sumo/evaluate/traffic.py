"""Motion of many vehicles as traffic: distance, speed, flow, delay, lane changes, comfort.

Words: gap is bumper to bumper, headway front to front. All rates per vehicle-km are sums over all
vehicles, so a long trip weighs more than a short one.

Flow, density and speed by Edie's definitions: points of the fundamental diagram.

In a region of space and time with area |A| = length x duration, q = sum of distances / |A|, k = sum of
times / |A| and v = q / k (Edie 1963). A region here is one lane's cell over one slice of time.

The busiest way through a network, as one axis that speeds and trajectories can be drawn along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.evaluate.trajectories import Trajectories

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


CELL = 200.0  # m, about
SHORTEST_LANE = 100.0  # m: shorter lanes hold too few vehicles at a time
SLICE = 60.0  # s


@dataclass(frozen=True)
class Cells:
    """Space-time cells of single lanes that a vehicle was in.

    Attributes:
        flow: [C] veh/h.
        density: [C] veh/km.
        speed: [C] m/s.
    """

    flow: FloatArray
    density: FloatArray
    speed: FloatArray


def edie_cells(t: Trajectories, cell: float = CELL, duration: float = SLICE) -> Cells:
    """Cells of equal parts of about ``cell`` m of each lane outside junctions, over full slices of time.

    A step counts where its middle lies, so a cell's sums are off by at most one sampling period per
    vehicle that enters or leaves.
    """
    s = steps(t)
    outside = np.array([not name.startswith(":") for name in t.lane_edges], bool)
    usable = outside & (t.lane_length >= SHORTEST_LANE)
    parts = np.maximum(np.rint(t.lane_length / cell), 1.0).astype(np.int64)
    first = np.concatenate(([0], np.cumsum(parts)))
    size = t.lane_length / parts
    begin = float(t.time[0]) if len(t.time) else 0.0
    slices = int((float(t.time[-1]) - begin) / duration + 1e-6) if len(t.time) else 0
    lane = t.lane[s.after]
    when = ((0.5 * (t.time[s.before] + t.time[s.after]) - begin) / duration).astype(np.int64)
    kept = (lane >= 0) & (when < slices)
    kept &= np.append(usable, False)[lane]
    lane, when, seconds = lane[kept], when[kept], s.seconds[kept]
    metres = 0.5 * (t.speed[s.before] + t.speed[s.after])[kept] * seconds
    middle = np.clip(t.position[s.after[kept]] - 0.5 * metres, 0.0, None)
    place = first[lane] + np.minimum((middle / size[lane]).astype(np.int64), parts[lane] - 1)
    number = when * int(first[-1]) + place
    used, inverse = np.unique(number, return_inverse=True)
    distance, time = np.bincount(inverse, metres), np.bincount(inverse, seconds)
    area = np.repeat(size, parts)[used % max(int(first[-1]), 1)] * duration
    density, flow = 1000.0 * time / area, 3600.0 * distance / area
    return Cells(flow, density, distance / np.maximum(time, 1e-9))


@dataclass(frozen=True)
class Corridor:
    """Edges in driving order and the distance in m at which each begins."""

    start: dict[str, float]
    length: float


def find_corridor(t: Trajectories) -> Corridor:
    """From the edge with most samples along the most used transitions, both ways, junctions included."""
    edges = list(dict.fromkeys(t.lane_edges))
    number = {edge: i for i, edge in enumerate(edges)}
    of_lane = np.array([number[e] for e in t.lane_edges] + [-1], np.int64)
    samples = of_lane[t.lane]
    samples = samples[samples >= 0]
    if not len(samples):
        return Corridor({}, 0.0)
    s = steps(t)
    a, b = of_lane[t.lane[s.before]], of_lane[t.lane[s.after]]
    moved = (a != b) & (a >= 0) & (b >= 0)
    pairs, count = np.unique(np.stack((a[moved], b[moved])), axis=1, return_counts=True)
    busiest = int(np.bincount(samples).argmax())
    upstream = _follow(busiest, pairs[1], pairs[0], count)[:0:-1]
    downstream = [e for e in _follow(busiest, pairs[0], pairs[1], count) if e not in upstream]
    order = [*upstream, *downstream]
    length = np.zeros(len(edges))
    for lane, edge in enumerate(of_lane[:-1]):
        length[edge] = max(length[edge], t.lane_length[lane])
    start, at = {}, 0.0
    for edge in order:
        start[edges[edge]] = at
        at += float(length[edge])
    return Corridor(start, at)


def along(t: Trajectories, corridor: Corridor) -> FloatArray:
    """[S] distance of each sample's front bumper along the corridor in m, NaN off it."""
    offset = np.array([corridor.start.get(e, np.nan) for e in t.lane_edges] + [np.nan])
    return offset[t.lane] + t.position


def speed_profile(t: Trajectories, corridor: Corridor, width: float = 50.0) -> tuple[FloatArray, FloatArray]:
    """Mean speed in m/s of the samples in slices of ``width`` m; NaN where fewer than five are.

    Returns:
        centres of the slices in m, and the means.
    """
    s = along(t, corridor)
    good = np.isfinite(s)
    edges = np.arange(0.0, max(corridor.length, width) + width, width)
    count = np.histogram(s[good], edges)[0]
    total = np.histogram(s[good], edges, weights=t.speed[good])[0]
    mean = np.where(count >= 5, total / np.maximum(count, 1), np.nan)
    return 0.5 * (edges[:-1] + edges[1:]), mean


def _follow(first: int, source, target, count) -> list[int]:
    chain, seen = [first], {first}
    while True:
        options = np.flatnonzero(source == chain[-1])
        options = [o for o in options if int(target[o]) not in seen]
        if not options:
            return chain
        best = int(target[max(options, key=lambda o: count[o])])
        chain.append(best)
        seen.add(best)
