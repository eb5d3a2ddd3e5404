"""The same vehicles over the same samples: as recorded, and as a model drove them on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from phase_sumo.logs.recording import Recording, Window


def recorded(window: Window) -> Recording:
    """The window's agents [N] over its steps + 1 samples, each up to where it is first lost."""
    r = window.recording
    span = slice(window.begin, window.begin + window.steps + 1)
    there = np.arange(window.steps + 1) <= (window.last - window.begin)[:, None]
    x, y, yaw, speed = (np.where(there, a[:, span], np.nan) for a in (r.x, r.y, r.yaw, r.speed))
    return replace(r, present=there, x=x, y=y, yaw=yaw, speed=speed)


def alike(simulated: Recording, log: Recording) -> Recording:
    """The simulated samples of which the log has one, too: cameras see a stretch of road only."""
    there = simulated.present & log.present
    x, y, yaw, speed = (
        np.where(there, a, np.nan) for a in (simulated.x, simulated.y, simulated.yaw, simulated.speed)
    )
    return replace(simulated, present=there, x=x, y=y, yaw=yaw, speed=speed)
