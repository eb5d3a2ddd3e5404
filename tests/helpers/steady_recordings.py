"""Recordings made by hand: vehicles at constant speed on a straight or curved road of three lanes."""

from __future__ import annotations

import numpy as np

from phase_sumo.logs.recording import PERIOD, Recording
from phase_sumo.sim.dimensions import Kind
from phase_sumo.sim.lanes import Lane, LaneNetwork

WIDTH = 3.66


def road(length: float = 300.0, radius: float = 0.0, sections: int = 1) -> LaneNetwork:
    """Lane 0 is the right one; a curve to the left about (0, radius) that starts at the origin."""
    lanes, successors = [], []
    for section in range(sections):
        s = np.linspace(section, section + 1, 16) * length / sections
        for k in range(3):
            points = np.stack(place(s, k * WIDTH, radius), -1)
            i = len(lanes)
            lanes.append(
                Lane(
                    id=f"s{section}_{k}",
                    edge=f"s{section}",
                    points=points,
                    width=WIDTH,
                    speed_limit=30.0,
                    length=float(np.hypot(*np.diff(points, axis=0).T).sum()),
                    left=i + 1 if k < 2 else -1,
                    right=i - 1 if k else -1,
                )
            )
            if section:
                successors.append((i - 3, i))
    return LaneNetwork("road", tuple(lanes), tuple(successors))


def place(s: np.ndarray, left: float | np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """x, y of points ``s`` m along the right lane and ``left`` m to its left."""
    if not radius:
        return s, left + 0.0 * s
    angle = s / radius
    return (radius - left) * np.sin(angle), radius - (radius - left) * np.cos(angle)


def recording(
    starts: list[tuple[float, int, float]],
    samples: int = 31,
    radius: float = 0.0,
    lengths: list[float] | None = None,
    name: str = "hand",
    network: LaneNetwork | None = None,
) -> Recording:
    """Vehicles (metres along the road, lane, m/s), boxes by their centres."""
    first, lane, speed = (np.array(column)[:, None] for column in zip(*starts, strict=True))
    s = first + speed * PERIOD * np.arange(samples)
    x, y = place(s, lane * WIDTH, radius)
    size = np.array(lengths or [4.6] * len(starts))
    kinds: tuple[Kind, ...] = tuple("articulated_truck" if v > 12.5 else "car" for v in size)
    return Recording(
        name=name,
        source="tracks",
        network=network or road(radius=radius),
        present=np.ones(s.shape, bool),
        x=x,
        y=y,
        yaw=s / radius if radius else 0.0 * s,
        speed=speed + 0.0 * s,
        length=size,
        width=np.where(size > 7.0, 2.5, 1.9),
        kind=kinds,
        flags=(frozenset(),) * len(size),
    )
