"""Traffic measures, computed alike from the sampled trajectories of any model.

Words: gap is bumper to bumper, headway front to front. All rates per vehicle-km are sums over all
vehicles, so a long trip weighs more than a short one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phase_sumo.evaluate.trajectories import Trajectories

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

HARD_BRAKING = -3.0  # m/s^2
CONFLICT = 3.0  # s of time to collision (SUMO's SSM default)
SERIOUS_CONFLICT = 1.5  # s
LOOK_AHEAD = 150.0  # m within which a leader counts
HEADWAY_SPEED = 3.0  # m/s below which a time headway says nothing


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


def lane_changes(t: Trajectories) -> int:
    """Changes of lane within one edge; the lane is the one that holds the centre of the front bumper.

    A change that falls on the step from one edge to the next is not counted, for any model.
    """
    s = steps(t)
    a, b = t.lane[s.before], t.lane[s.after]
    edges = {name: i for i, name in enumerate(dict.fromkeys(t.lane_edges))}
    edge = np.array([edges[name] for name in t.lane_edges] + [-1], np.int64)
    inside = np.array([name.startswith(":") for name in t.lane_edges] + [True])
    return int(((a >= 0) & (b >= 0) & (a != b) & (edge[a] == edge[b]) & ~inside[a]).sum())


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


def hard_brakings(t: Trajectories, threshold: float = HARD_BRAKING) -> int:
    """Episodes with an `acceleration` below ``threshold`` m/s^2."""
    return episodes(t, acceleration(t) < threshold)


@dataclass(frozen=True)
class Following:
    """Follower and leader pairs: sample rows, and the gap between them in m.

    gap = distance along the lanes from the follower's to the leader's front bumper - leader's length.
    """

    follower: IntArray
    leader: IntArray
    gap: FloatArray


def following(t: Trajectories, look_ahead: float = LOOK_AHEAD) -> Following:
    """The next vehicle ahead of each sample in its lane, over lane ends, within ``look_ahead`` m of gap.

    At a fork the search follows the lane that leads to an edge which the vehicle itself visits. Vehicles
    abreast in other lanes are no leaders: sideways conflicts are not covered.
    """
    rows = np.flatnonzero(t.lane >= 0)
    frame = np.unique(t.time[rows], return_inverse=True)[1]
    group = frame * len(t.lane_ids) + t.lane[rows]
    order = np.lexsort((t.position[rows], group))
    rows, group = rows[order], group[order]
    same = group[:-1] == group[1:]
    a, b = rows[:-1][same], rows[1:][same]
    first = np.r_[True, ~same] if len(rows) else np.zeros(0, bool)
    last = np.r_[~same, True] if len(rows) else np.zeros(0, bool)
    tails = dict(zip(group[first].tolist(), rows[first].tolist(), strict=True))
    head, next_one, distance = _over_lane_ends(t, rows[last], group[last], tails)
    follower, leader = np.concatenate((a, head)), np.concatenate((b, next_one))
    distance = np.concatenate((t.position[b] - t.position[a], distance))
    gap = distance - t.length[t.vehicle[leader]]
    close = gap <= look_ahead
    return Following(follower[close], leader[close], gap[close])


def _over_lane_ends(
    t: Trajectories, heads: IntArray, group: IntArray, tails: dict[int, int]
) -> tuple[IntArray, IntArray, FloatArray]:
    """Leaders on the lanes after the one on which each head row is the foremost.

    Returns:
        follower rows, leader rows, and the distance between their front bumpers in m.
    """
    visited: dict[int, set[str]] = {}
    for vehicle, lane in np.unique(np.stack((t.vehicle, t.lane)), axis=1).T:
        visited.setdefault(int(vehicle), set()).add(t.lane_edges[lane])
    reach = LOOK_AHEAD + (float(t.length.max()) if len(t.length) else 0.0)
    found: list[tuple[int, int, float]] = []
    for head, key in zip(heads.tolist(), group.tolist(), strict=True):
        lane = int(t.lane[head])
        base = key - lane
        distance = float(t.lane_length[lane] - t.position[head])
        edges = visited[int(t.vehicle[head])]
        while distance < reach and t.lane_next[lane]:
            options = t.lane_next[lane]
            lane = next((o for o in options if _leads_to(t, o, edges)), options[0])
            leader = tails.get(base + lane)
            if leader is not None:
                if leader != head:
                    found.append((head, leader, distance + float(t.position[leader])))
                break
            distance += max(float(t.lane_length[lane]), 0.1)
    table = np.array(found, np.float64).reshape(-1, 3)
    return table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2]


def _leads_to(t: Trajectories, lane: int, edges: set[str]) -> bool:
    for _ in range(4):  # through a junction's internal lanes
        if not t.lane_edges[lane].startswith(":"):
            break
        if not t.lane_next[lane]:
            return False
        lane = t.lane_next[lane][0]
    return t.lane_edges[lane] in edges


def time_to_collision(t: Trajectories, f: Following) -> FloatArray:
    """gap / closing speed of each pair in s; inf when not closing, 0 when the gap is gone."""
    closing = t.speed[f.follower] - t.speed[f.leader]
    gap = np.maximum(f.gap, 0.0)
    return np.where(closing > 1e-6, gap / np.maximum(closing, 1e-6), np.inf)


def conflicts(t: Trajectories, f: Following, threshold: float) -> int:
    """Episodes of a follower with a `time_to_collision` below ``threshold`` s."""
    active = np.zeros(len(t.time), bool)
    active[f.follower[time_to_collision(t, f) < threshold]] = True
    return episodes(t, active)


def time_headways(t: Trajectories, f: Following, longest: float = 10.0) -> FloatArray:
    """Front-to-front distance / follower's speed in s, above `HEADWAY_SPEED` and up to ``longest`` s."""
    headway = f.gap + t.length[t.vehicle[f.leader]]
    speed = t.speed[f.follower]
    moving = speed > HEADWAY_SPEED
    result = headway[moving] / speed[moving]
    return result[(result > 0.0) & (result <= longest)]


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


def measures(t: Trajectories, section: tuple[str, float] | None, begin: float, end: float) -> dict[str, Any]:
    """All measures of this module by name, SI units (flow per hour, rates per vehicle-km)."""
    f = following(t)
    km = vehicle_km(t)
    edge, position = section or cross_section(t)
    headways = time_headways(t, f)

    def rate(count: int) -> float:
        return count / km if km else float("nan")

    return {
        "vehicle_km": km,
        "mean_speed": mean_speed(t),
        "flow": flow(t, edge, position, begin, end),
        "lane_changes_per_km": rate(lane_changes(t)),
        "hard_brakings_per_km": rate(hard_brakings(t)),
        "conflicts_per_km": rate(conflicts(t, f, CONFLICT)),
        "serious_conflicts_per_km": rate(conflicts(t, f, SERIOUS_CONFLICT)),
        "median_time_headway": float(np.median(headways)) if len(headways) else float("nan"),
    }
