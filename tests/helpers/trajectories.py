"""Trajectories by hand on a small road, for the traffic measures."""

from __future__ import annotations

import numpy as np

from phase_sumo.evaluate.trajectories import Trajectories

# edge A (lanes 0, 1; 100 m) -> junction :J (10 m) -> edge B (lane 3; 200 m), and a branch C (lane 4)
LANES = ("A_0", "A_1", ":J_0", "B_0", "C_0")
EDGES = ("A", "A", ":J", "B", "C")
LENGTHS = (100.0, 100.0, 10.0, 200.0, 200.0)
NEXT = ((2, 4), (), (3,), (), ())


def make(rows, period=1.0, lengths=(5.0, 5.0), target=30.0, accel=0.0, emission="test"):
    """Rows of (time, vehicle, lane, position, speed)."""
    rows = np.array(sorted(rows), float).reshape(-1, 5)
    size = len(rows)
    zeros = np.zeros(size)
    return Trajectories(
        time=rows[:, 0],
        vehicle=rows[:, 1].astype(np.int64),
        x=rows[:, 3],
        y=zeros,
        yaw=zeros,
        hitch=zeros,
        speed=rows[:, 4],
        accel=np.full(size, accel),
        lane=rows[:, 2].astype(np.int64),
        position=rows[:, 3],
        lateral=zeros,
        controlled=np.zeros(size, bool),
        target_speed=np.full(size, target),
        alpha=np.full(size, np.nan),
        vehicle_ids=tuple(f"v{i}" for i in range(len(lengths))),
        vehicle_types=("car",) * len(lengths),
        emission_classes=(emission,) * len(lengths),
        shape=np.tile([5.0, 1.8, 3.0, 1.0, 0, 0, 0, 0], (len(lengths), 1)),
        length=np.array(lengths),
        lane_ids=LANES,
        lane_edges=EDGES,
        lane_length=np.array(LENGTHS),
        lane_speed=np.full(5, 30.0),
        lane_next=NEXT,
        period=period,
    )
