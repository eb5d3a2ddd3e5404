"""Surrogate safety: gaps, time headways, time to collision, DRAC, post-encroachment time.

Gap is bumper to bumper, headway front to front.

PET = time at which the second vehicle's front reaches a line across a lane - time at which the first one's
rear leaves it (Allen, Shin & Cooper 1978). Unlike the time to collision it asks for no closing speed. Zero
means that the second came before the first was gone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.evaluate.traffic import Steps, episodes, lane_changes, steps
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


LINE_SPACING = 50.0  # m between the lines across a lane at which followers are timed
SHORT = 1.0  # s, a PET below which an encroachment is close
LONGEST = 10.0  # s, beyond which the two have nothing to do with each other


class _Passages:
    """When fronts cross, and rears leave, places on a lane."""

    def __init__(self, t: Trajectories) -> None:
        self.t = t
        self.steps = s = steps(t)
        order = t.by_vehicle()
        moved = np.zeros(len(order))
        moved[s.after] = 0.5 * (t.speed[s.before] + t.speed[s.after]) * s.seconds
        first = np.ones(len(order), bool)
        first[s.after] = False
        self._leg = np.zeros(len(order), np.int64)  # stretch of uninterrupted samples of one vehicle
        self._leg[order] = np.cumsum(first[order])
        self._odometer = np.zeros(len(order))
        self._odometer[order] = np.cumsum(moved[order])
        self._far = float(moved.sum()) + 1e3  # further than any leg is long
        self._order = order
        self._key = (self._odometer + self._leg * self._far)[order]

    def share(self, s: Steps, line: FloatArray) -> FloatArray:
        """How far into each step within one lane the front crosses ``line``."""
        before, after = self.t.position[s.before], self.t.position[s.after]
        return (line - before) / np.maximum(after - before, 1e-9)

    def rear_leaves(self, rows: IntArray, metres: FloatArray) -> FloatArray:
        """Time at which each vehicle is its length past where it was ``metres`` ago; NaN if never."""
        t = self.t
        wanted = self._odometer[rows] - metres + t.length[t.vehicle[rows]] + self._leg[rows] * self._far
        at = np.minimum(np.searchsorted(self._key, wanted), len(self._key) - 1)
        b, a = self._order[at], self._order[np.maximum(at - 1, 0)]
        lead = self._key[at] - wanted
        span = np.maximum(self._odometer[b] - self._odometer[a], 1e-9)
        time = t.time[b] - np.clip(lead / span, 0.0, 1.0) * (t.time[b] - t.time[a])
        return np.where((self._leg[b] == self._leg[rows]) & (lead >= 0.0), time, np.nan)


def following_pets(t: Trajectories, spacing: float = LINE_SPACING) -> FloatArray:
    """[P] PET in s to the vehicle before in the lane, at lines every ``spacing`` m; inf where none was near.

    One value for every passage of a line, so that a free road counts too.
    """
    p = _Passages(t)
    s = p.steps
    number = np.floor(t.position[s.after] / spacing)
    lane = t.lane[s.after]
    crossed = (lane >= 0) & (lane == t.lane[s.before]) & (t.position[s.before] < number * spacing)
    s, number, lane = (
        Steps(s.before[crossed], s.after[crossed], s.seconds[crossed]),
        number[crossed],
        lane[crossed],
    )
    share = p.share(s, number * spacing)
    front = t.time[s.before] + share * s.seconds
    rear = p.rear_leaves(s.after, t.position[s.after] - number * spacing)
    order = np.lexsort((front, number, lane))
    first, second = order[:-1], order[1:]
    same = (lane[first] == lane[second]) & (number[first] == number[second])
    same &= t.vehicle[s.after[first]] != t.vehicle[s.after[second]]
    pet = np.full(len(order), np.inf)
    pet[second[same]] = _bounded(front[second[same]] - rear[first[same]])
    return pet


def lane_change_pets(t: Trajectories) -> tuple[FloatArray, FloatArray]:
    """PET in s of each lane change to the vehicle ahead and to the one behind in the new lane.

    The line lies where the front bumper is when it enters the new lane. Ahead: the changer's entry minus the
    departure of the rear of the last vehicle that crossed the line in that lane. Behind: the arrival of the
    next vehicle there minus the departure of the changer's own rear. inf where nobody was near.

    Returns:
        [C] ahead, [C] behind.
    """
    p = _Passages(t)
    s, changes = p.steps, lane_changes(t)
    stays = (t.lane[s.before] == t.lane[s.after]) & (t.lane[s.after] >= 0)
    s = Steps(s.before[stays], s.after[stays], s.seconds[stays])
    order = np.argsort(t.lane[s.after], kind="stable")
    s = Steps(s.before[order], s.after[order], s.seconds[order])
    lanes = t.lane[s.after]
    own_rear = p.rear_leaves(changes.after, np.zeros(len(changes.after)))
    ahead, behind = np.full(len(own_rear), np.inf), np.full(len(own_rear), np.inf)
    for k, row in enumerate(changes.after.tolist()):
        line, entry = t.position[row], t.time[row]
        low, high = np.searchsorted(lanes, [t.lane[row], t.lane[row] + 1])
        a, b = s.before[low:high], s.after[low:high]
        hit = low + np.flatnonzero(
            (t.position[a] < line) & (t.position[b] >= line) & (t.vehicle[b] != t.vehicle[row])
        )
        passed = Steps(s.before[hit], s.after[hit], s.seconds[hit])
        front = t.time[passed.before] + p.share(passed, np.full(len(hit), line)) * passed.seconds
        earlier, later = front <= entry, front > entry
        if earlier.any():
            last = np.flatnonzero(earlier)[front[earlier].argmax()]
            at = passed.after[last : last + 1]
            ahead[k] = _bounded(entry - p.rear_leaves(at, t.position[at] - line))[0]
        if later.any():
            behind[k] = _bounded(np.array([front[later].min() - own_rear[k]]))[0]
    return ahead, behind


def _bounded(pet: FloatArray) -> FloatArray:
    """0 for an overlap in time, inf beyond `LONGEST` or where the first never left."""
    return np.where(np.isnan(pet) | (pet > LONGEST), np.inf, np.maximum(pet, 0.0))
