"""What a lane change would gain: MOBIL on top of the improved IDM.

Acceleration of a vehicle with speed v and desired speed v0, a gap s behind a leader who is slower by dv:

    s* = s0 + max(0, v T + v dv / (2 sqrt(a b))),  z = s* / s
    free = a (1 - (v / v0)^4) for v <= v0, else -b (1 - (v0 / v)^(4 a / b))
    for v <= v0:  free (1 - z^(2 a / free)) if z < 1 else a (1 - z^2)
    for v > v0:   free if z < 1 else free + a (1 - z^2)

Unlike in the plain IDM a leader as fast as oneself is no hindrance beyond the gap s*. A lane change of the
vehicle c gains

    a'_c - a_c + p (a'_n - a_n + a'_o - a_o),

n the follower in the new lane, o the one in the old, accelerations after the change primed; it is worth while
above the threshold, which a bias raises for changes away from the keep-right lane and lowers for those
towards it. It is safe if neither c nor n must brake harder than ``SAFE_BRAKING`` after it.

Kesting, Treiber, Helbing, "General lane-changing model MOBIL for car-following models" (2007): threshold and
bias are near its 0.1 and 0.3 m/s^2, politeness within its 0.2 to 0.5; of its safe braking of 4 m/s^2 we allow
half, since the policy takes several seconds for a change. Treiber, Kesting, "Traffic Flow Dynamics" (2013),
chapter 11: the improved IDM, and T, a, b, s0 for motorways.
"""

from __future__ import annotations

import numpy as np

from phase_sumo.bridge.fleet.road import BoolArray, FloatArray

TIME_GAP = 1.0  # s, T
STANDSTILL = 2.0  # m, s0
ACCELERATION, BRAKING = 1.0, 1.5  # m/s^2, a and b
POLITENESS = 0.3  # p
THRESHOLD = 0.2  # m/s^2
KEEP_RIGHT = 0.3  # m/s^2, bias
SAFE_BRAKING = 2.0  # m/s^2


def acceleration(speed: FloatArray, target: FloatArray, gap: FloatArray, ahead: FloatArray) -> FloatArray:
    """Improved IDM, m/s^2.

    Args:
        speed, target: m/s, at least 0 and above 0.
        gap: m, inf without a leader; what is below 0.1 counts as that.
        ahead: speed of the leader in m/s, any number without one.
    """
    closing = speed * (speed - ahead) / (2.0 * np.sqrt(ACCELERATION * BRAKING))
    z = (STANDSTILL + np.maximum(speed * TIME_GAP + closing, 0.0)) / np.maximum(gap, 0.1)
    slow = speed <= target
    free = np.where(
        slow,
        ACCELERATION * (1.0 - (speed / target) ** 4),
        -BRAKING * (1.0 - (target / np.maximum(speed, target)) ** (4.0 * ACCELERATION / BRAKING)),
    )
    held_up = ACCELERATION * (1.0 - z * z)
    # the exponent grows without bound as free -> 0, where the factor does not matter
    approaching = free * (1.0 - np.minimum(z, 1.0) ** (2.0 * ACCELERATION / np.maximum(free, 1e-2)))
    return np.where(slow, np.where(z < 1.0, approaching, held_up), free + np.minimum(held_up, 0.0))


def felt(braking: FloatArray) -> FloatArray:
    """Accelerations as an incentive: harder than comfortable braking counts as that.

    Drivers who follow closer than T, as the policy and people in queues do, do not brake as the IDM would.
    """
    return np.maximum(braking, -BRAKING)


def gain(own: FloatArray, new_follower: FloatArray, old_follower: FloatArray) -> FloatArray:
    """What a change is worth in m/s^2, from how much more each of the three will `felt`-ly accelerate."""
    return own + POLITENESS * (new_follower + old_follower)


def safe(own: FloatArray, new_follower: FloatArray) -> BoolArray:
    """Whether nobody must brake hard, from the accelerations after the change."""
    return (own >= -SAFE_BRAKING) & (new_follower >= -SAFE_BRAKING)
