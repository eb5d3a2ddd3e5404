"""The paper's kinematic equations, continuous, by fourth-order Runge-Kutta in float64; numpy only.

    x' = v cos yaw,  y' = v sin yaw,  yaw' = v tan(steer) / wheelbase,
    v' = a,  a' = jerk,  steer' = rate,  hitch' = yaw' - v / l sin hitch      (Eq. hitch_angle_update)

The clamps on speed, acceleration and steering are left out: drive within them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

NAMES = ("x", "y", "yaw", "speed", "accel", "steer", "hitch")


def flow(s: np.ndarray, jerk: float, rate: float, wheelbase: float, base: float) -> np.ndarray:
    """Time derivative of the state [7] in the order of `NAMES`; ``base`` in m, infinite without a trailer."""
    _, _, yaw, v, a, steer, hitch = s
    yaw_rate = v * np.tan(steer) / wheelbase
    return np.array(
        [v * np.cos(yaw), v * np.sin(yaw), yaw_rate, a, jerk, rate, yaw_rate - v / base * np.sin(hitch)]
    )


def integrate(
    start: np.ndarray,
    command: Callable[[float], tuple[float, float]],
    seconds: float,
    step: float,
    wheelbase: float,
    base: float = np.inf,
) -> np.ndarray:
    """State [7] after ``seconds``, in steps of ``step`` s.

    Args:
        command: jerk in m/s^3 and steering rate in rad/s from a time in s on; constant within a step.
    """
    s = np.array(start, np.float64)
    for k in range(round(seconds / step)):
        jerk, rate = command((k + 0.5) * step)
        k1 = flow(s, jerk, rate, wheelbase, base)
        k2 = flow(s + 0.5 * step * k1, jerk, rate, wheelbase, base)
        k3 = flow(s + 0.5 * step * k2, jerk, rate, wheelbase, base)
        k4 = flow(s + step * k3, jerk, rate, wheelbase, base)
        s = s + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return s
