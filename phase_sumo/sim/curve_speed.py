"""How fast the curves ahead can be driven, by the vehicles of training scenarios and those in SUMO alike.

SUMO's limits say nothing of curves, nor do its own cars care.

On the way to a slower place s m ahead, v^2 = v_place^2 + 2 b s with b = `BRAKING`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lane_graph import LaneGraph

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
WINDOW = 6  # m before and behind a node over which its road turns: a kink is driven as an arc of that length
LONGEST = 24  # m to either side over which a slight kink is cut
SIDEWAYS, SIDEWAYS_TRUCK = 3.0, 2.0  # m/s^2 in a curve
BRAKING = 1.2  # m/s^2 on the way to it
FASTEST = 40.0  # m/s, of all vehicles
LATER = 1.0e6  # m^2/s^2, more than the square of any speed and of what any lane's length adds to it


def braked_to(speed: FloatArray, metres: FloatArray) -> FloatArray:
    """The speed from which ``speed`` m/s is reached in ``metres``, up to `FASTEST`."""
    return np.minimum(np.sqrt(speed * speed + 2.0 * BRAKING * metres), FASTEST)


def lane_speeds(graph: LaneGraph, sideways: float, slack: float = 0.0) -> FloatArray:
    """The speed at each node with which no curve ahead in its lane asks for more than ``sideways`` m/s^2.

    v_c = sqrt(sideways / |kappa|) in the curve, kappa the turn of the road over `WINDOW` m to either side.
    A slight kink is no curve: who may be ``slack`` m beside the lane's middle cuts a turn of theta rad on an
    arc over w = 4 slack / theta m to either side, `WINDOW` to `LONGEST`, with kappa = theta / 2w.

    Returns:
        [V] m/s, up to `FASTEST`.
    """
    highest = np.minimum(sideways / np.maximum(np.abs(graph.curvature(WINDOW)), 1e-6), FASTEST**2)
    if slack > 0.0:
        turns = [np.abs(graph.curvature(w)) * 2.0 * w for w in (WINDOW, LONGEST // 2, LONGEST)]
        turn = np.maximum(np.max(turns, 0), 1e-6)
        reach = np.clip(4.0 * slack / turn, WINDOW, LONGEST)
        highest = np.maximum(highest, np.minimum(sideways * 2.0 * reach / turn, FASTEST**2))
    # v^2 + 2 b s of the slowest place ahead in the lane; what comes in later lanes is kept out of reach
    metres = graph.along - graph.along[graph.lane_start]
    ahead = highest + 2.0 * BRAKING * metres + LATER * graph.node_lane
    slowest = np.minimum.accumulate(ahead[::-1])[::-1] - LATER * graph.node_lane
    return np.minimum(np.sqrt(np.maximum(slowest - 2.0 * BRAKING * metres, 0.0)), FASTEST)


def exit_speeds(
    first: FloatArray, metres: FloatArray, onward: IntArray, last: FloatArray | None = None
) -> FloatArray:
    """The speed at each lane's end that the way on allows.

    Args:
        first: [L] m/s at the lanes' first nodes, see `lane_speeds`.
        metres: [L] length.
        onward: [L] lane that follows, -1 for none.
        last: [L] m/s at the lane's end where none follows, `FASTEST` by default.

    Returns:
        [L] m/s.
    """
    last = np.full(len(first), FASTEST) if last is None else np.minimum(last, FASTEST)
    speed = np.full(len(first), FASTEST)
    while True:
        enter = np.minimum(first, braked_to(speed, metres))
        slowed = np.where(onward >= 0, enter[onward], last)
        if np.array_equal(slowed, speed):
            return speed
        speed = slowed
