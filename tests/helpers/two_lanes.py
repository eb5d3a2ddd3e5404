"""A car and a semitrailer on a straight road of two lanes."""

from __future__ import annotations

import numpy as np

from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.sim.lanes import Lane, LaneNetwork


def two_lanes() -> LaneNetwork:
    """A straight road of 400 m."""
    lanes = tuple(
        Lane(
            f"e_{i}",
            "e",
            np.array([[0.0, 3.6 * i], [400.0, 3.6 * i]]),
            3.6,
            30.0,
            400.0,
            left=1 - i * 2,
            right=i - 1,
        )
        for i in range(2)
    )
    return LaneNetwork("toy", lanes, ())


def drive(controlled: bool, speed: float = 20.0) -> Trajectories:
    """A car and a semitrailer, 15 s."""
    time = np.repeat(np.arange(0, 15, 0.2), 2)
    vehicle = np.tile([0, 1], 75)
    x = 40.0 * (1 - vehicle) + speed * time
    size = len(time)
    return Trajectories(
        time=time,
        vehicle=vehicle,
        x=x,
        y=3.6 * vehicle,
        yaw=np.zeros(size),
        hitch=np.where(vehicle == 1, 0.05, 0.0),
        speed=np.full(size, speed),
        accel=np.zeros(size),
        lane=vehicle,
        position=x + 4.0,
        lateral=np.zeros(size),
        controlled=np.full(size, controlled),
        target_speed=np.full(size, 25.0),
        alpha=np.full(size, 0.7 if controlled else np.nan),
        vehicle_ids=("car", "semi"),
        vehicle_types=("car", "semi"),
        emission_classes=("Zero", "Zero"),
        shape=np.array([[5, 1.8, 3, 1, 0, 0, 0, 0], [7, 2.6, 5.2, 0.7, 15, 2.6, 12, 0.9]]),
        length=np.array([5.0, 20.4]),
        lane_ids=("e_0", "e_1"),
        lane_edges=("e", "e"),
        lane_length=np.array([400.0, 400.0]),
        lane_speed=np.array([30.0, 30.0]),
        lane_next=((), ()),
        period=0.2,
    )
