"""Whether a tractor with a trailer can follow every path through a lane graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lane_graph import LaneGraph

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
KINK = 0.3  # m sideways within 1 m of path that nothing on wheels follows
TURN = 0.125  # rad/m, a circle of 8 m: what the rear axle of a tractor with a semitrailer can still drive


def lateral_kinks(graph: LaneGraph) -> IntArray:
    """[k] nodes at which a path leaves the straight continuation of the metre before by more than `KINK`.

    Nodes lie about 1 m apart, so the sine of the turn from one step to the next is that distance in m.
    """
    node, turn, _ = _turns(graph)
    return np.unique(node[(np.sin(np.minimum(turn, 0.5 * np.pi)) > KINK)])


def turn_per_metre(graph: LaneGraph) -> FloatArray:
    """[V] largest heading change per metre of path at every node, rad/m."""
    node, turn, step = _turns(graph)
    result = np.zeros(len(graph.node_xy))
    np.maximum.at(result, node, turn / np.maximum(step, 0.5))
    return result


def _turns(graph: LaneGraph) -> tuple[IntArray, FloatArray, FloatArray]:
    """Every node between two others on a path: its index, the turn there in rad, the mean step in m."""
    before, column = np.nonzero(graph.successor >= 0)
    node = graph.successor[before, column].astype(np.int64)
    row, column = np.nonzero(graph.successor[node] >= 0)
    before, node = before[row], node[row]
    after = graph.successor[node, column]
    xy = graph.node_xy.astype(np.float64)
    one, two = xy[node] - xy[before], xy[after] - xy[node]
    across = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    turn = np.abs(np.arctan2(across, (one * two).sum(1)))
    return node, turn, 0.5 * (np.hypot(*one.T) + np.hypot(*two.T))
