"""A winding freeway of any length, built in memory: input for measurements that need no map."""

from __future__ import annotations

import numpy as np

from phase_sumo.sim.lanes import Lane, LaneNetwork

SECTION = 500.0  # m
LANES = 3  # per direction
WIDTH = 3.66  # m
HALF_MEDIAN = 6.0  # m from the road's axis to the nearest lane centre
SWING, PERIOD = 150.0, 4000.0  # m: the axis is a sine, curves down to a radius of 2.7 km


def freeway(lane_km: float) -> LaneNetwork:
    """Two carriageways of three lanes, cut into sections as a map is; at least one section long."""
    sections = max(1, round(1000.0 * lane_km / (2 * LANES * SECTION)))
    lanes: list[Lane] = []
    successors: list[tuple[int, int]] = []
    for way in (-1, 1):  # right-hand traffic: eastbound lies south of the axis
        for section in range(sections):
            begin = section if way < 0 else sections - 1 - section
            for k in range(LANES):
                own = len(lanes)
                along = np.linspace(begin * SECTION, (begin + 1) * SECTION, 51)
                points = axis(along, way * (HALF_MEDIAN + (LANES - 1 - k) * WIDTH))
                lanes.append(_lane(f"{'east' if way < 0 else 'west'}{begin}", k, points[::-way], own))
                if section:
                    successors.append((own - LANES, own))
    return LaneNetwork(f"freeway_{lane_km:g}km", tuple(lanes), tuple(successors))


def axis(along: np.ndarray, aside: float) -> np.ndarray:
    """Points [P, 2] at x = ``along`` m on the road's axis, moved ``aside`` m to its left."""
    slope = SWING * 2 * np.pi / PERIOD * np.cos(2 * np.pi * along / PERIOD)
    normal = np.stack((-slope, np.ones_like(along)), -1) / np.hypot(1.0, slope)[:, None]
    return np.stack((along, SWING * np.sin(2 * np.pi * along / PERIOD)), -1) + aside * normal


def _lane(edge: str, k: int, points: np.ndarray, own: int) -> Lane:
    return Lane(
        id=f"{edge}_{k}",
        edge=edge,
        points=np.ascontiguousarray(points),
        width=WIDTH,
        speed_limit=30.0,
        length=float(np.hypot(*np.diff(points, axis=0).T).sum()),
        left=own + 1 if k + 1 < LANES else -1,
        right=own - 1 if k else -1,
    )
