"""Who follows whom, and how close: gaps, time headways, time to collision, DRAC.

Gap is bumper to bumper, headway front to front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.evaluate.traffic import FloatArray, IntArray, episodes
from phase_sumo.evaluate.trajectories import Trajectories

CONFLICT = 3.0  # s of time to collision (SUMO's SSM default)
SERIOUS_CONFLICT = 1.5  # s
HARD_DRAC = 3.0  # m/s^2 (SUMO's SSM default)
LOOK_AHEAD = 150.0  # m within which a leader counts
HEADWAY_SPEED = 3.0  # m/s below which a time headway says nothing


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
    return _episodes_of(t, f.follower[time_to_collision(t, f) < threshold])


def deceleration_to_avoid_crash(t: Trajectories, f: Following) -> FloatArray:
    """DRAC: (v - v_leader)^2 / (2 gap) of each pair in m/s^2; 0 when not closing, inf without a gap.

    The constant braking that would just match the leader's speed at bumper contact (Cooper & Ferguson 1976;
    SUMO's SSM device for following uses the same).
    """
    closing = np.maximum(t.speed[f.follower] - t.speed[f.leader], 0.0)
    gap = np.maximum(f.gap, 1e-9)
    return np.where(f.gap > 0.0, closing**2 / (2.0 * gap), np.where(closing > 0.0, np.inf, 0.0))


def needed_brakings(t: Trajectories, f: Following, threshold: float = HARD_DRAC) -> int:
    """Episodes of a follower with a `deceleration_to_avoid_crash` above ``threshold`` m/s^2."""
    return _episodes_of(t, f.follower[deceleration_to_avoid_crash(t, f) > threshold])


def _episodes_of(t: Trajectories, rows: IntArray) -> int:
    active = np.zeros(len(t.time), bool)
    active[rows] = True
    return episodes(t, active)


def moving_gaps(t: Trajectories, f: Following) -> FloatArray:
    """Gaps in m of followers above `HEADWAY_SPEED`, negative ones (boxes overlap) left out."""
    return f.gap[(t.speed[f.follower] > HEADWAY_SPEED) & (f.gap >= 0.0)]


def time_headways(t: Trajectories, f: Following, longest: float = 10.0) -> FloatArray:
    """Front-to-front distance / follower's speed in s, above `HEADWAY_SPEED` and up to ``longest`` s."""
    headway = f.gap + t.length[t.vehicle[f.leader]]
    speed = t.speed[f.follower]
    moving = speed > HEADWAY_SPEED
    result = headway[moving] / speed[moving]
    return result[(result > 0.0) & (result <= longest)]
