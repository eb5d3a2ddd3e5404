"""A straight road built by hand."""

from __future__ import annotations

import numpy as np

from phase_sumo.sim.lanes import Lane, LaneNetwork


def straight_network(lanes: int = 3, length: float = 500.0, width: float = 3.66) -> LaneNetwork:
    """A straight road to the east; lane 0 is the rightmost, its centre at y = 0."""
    made = tuple(
        Lane(
            id=f"road_{k}",
            edge="road",
            points=np.array([[0.0, k * width], [length, k * width]]),
            width=width,
            speed_limit=30.0,
            length=length,
            left=k + 1 if k + 1 < lanes else -1,
            right=k - 1,
        )
        for k in range(lanes)
    )
    return LaneNetwork("straight", made, ())
