"""Post-encroachment time: how soon a vehicle arrives where another one has just been.

PET = time at which the second vehicle's front reaches a line across a lane - time at which the first one's
rear leaves it (Allen, Shin & Cooper 1978). Unlike the time to collision it asks for no closing speed. Zero
means that the second came before the first was gone.
"""

from __future__ import annotations

import numpy as np

from phase_sumo.evaluate.traffic import FloatArray, IntArray, Steps, lane_changes, steps
from phase_sumo.evaluate.trajectories import Trajectories

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
