"""Flow, density and speed by Edie's definitions: points of the fundamental diagram.

In a region of space and time with area |A| = length x duration, q = sum of distances / |A|, k = sum of
times / |A| and v = q / k (Edie 1963). A region here is one lane's cell over one slice of time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.evaluate.traffic import FloatArray, steps
from phase_sumo.evaluate.trajectories import Trajectories

CELL = 200.0  # m, about
SHORTEST_LANE = 100.0  # m: shorter lanes hold too few vehicles at a time
SLICE = 60.0  # s


@dataclass(frozen=True)
class Cells:
    """Space-time cells of single lanes that a vehicle was in.

    Attributes:
        flow: [C] veh/h.
        density: [C] veh/km.
        speed: [C] m/s.
    """

    flow: FloatArray
    density: FloatArray
    speed: FloatArray


def edie_cells(t: Trajectories, cell: float = CELL, duration: float = SLICE) -> Cells:
    """Cells of equal parts of about ``cell`` m of each lane outside junctions, over full slices of time.

    A step counts where its middle lies, so a cell's sums are off by at most one sampling period per
    vehicle that enters or leaves.
    """
    s = steps(t)
    outside = np.array([not name.startswith(":") for name in t.lane_edges], bool)
    usable = outside & (t.lane_length >= SHORTEST_LANE)
    parts = np.maximum(np.rint(t.lane_length / cell), 1.0).astype(np.int64)
    first = np.concatenate(([0], np.cumsum(parts)))
    size = t.lane_length / parts
    begin = float(t.time[0]) if len(t.time) else 0.0
    slices = int((float(t.time[-1]) - begin) / duration + 1e-6) if len(t.time) else 0
    lane = t.lane[s.after]
    when = ((0.5 * (t.time[s.before] + t.time[s.after]) - begin) / duration).astype(np.int64)
    kept = (lane >= 0) & (when < slices)
    kept &= np.append(usable, False)[lane]
    lane, when, seconds = lane[kept], when[kept], s.seconds[kept]
    metres = 0.5 * (t.speed[s.before] + t.speed[s.after])[kept] * seconds
    middle = np.clip(t.position[s.after[kept]] - 0.5 * metres, 0.0, None)
    place = first[lane] + np.minimum((middle / size[lane]).astype(np.int64), parts[lane] - 1)
    number = when * int(first[-1]) + place
    used, inverse = np.unique(number, return_inverse=True)
    distance, time = np.bincount(inverse, metres), np.bincount(inverse, seconds)
    area = np.repeat(size, parts)[used % max(int(first[-1]), 1)] * duration
    density, flow = 1000.0 * time / area, 3600.0 * distance / area
    return Cells(flow, density, distance / np.maximum(time, 1e-9))
