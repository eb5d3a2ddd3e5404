"""How far each lane end moves sideways so that connected ends meet.

A connection that jumps sideways fixes how two lane ends lie to each other, but not which of them moves.
Each junction's ends therefore form groups that move as one, and the groups come to rest where a set of
springs does: every end is pulled to where the network file has it, lanes abreast are pulled to keep their
distance, and the two ends of a lane too short to blend between different shifts are pulled together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
LOOSE = 0.1  # spring of ends that only open out of another lane, close into one or end, against 1
ABREAST = 1.0  # spring between lanes abreast
BEND = 40.0  # m: the spring along a lane of this length is 1, and grows with curvature squared: (BEND/L)^4
STIFFEST = 1.0e4
ROOMY = 120.0  # m: a lane this long has room for the longest blend at either end, and needs no spring
PRECISION = 1.0e-4  # m


def lane_shifts(
    lengths: FloatArray, ends: IntArray, jumps: FloatArray, abreast: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Shifts at the lanes' starts and ends.

    Args:
        lengths: [L] of the lanes in m.
        ends: [C, 2] lane ends that each connection joins; end 2i is the start of lane i, 2i + 1 its end.
        jumps: [C] sideways offset of each connection in m, positive left.
        abreast: [A, 2] pairs of lanes next to each other.

    Returns:
        [2L] shift of every end in m, positive left, and [C] the jump that is left in each connection: zero
        except for those that lead across from one lane to another where both go on elsewhere.
    """
    group, offset, firm = _groups(2 * len(lengths), ends, jumps)
    pull = np.where(firm, 1.0, LOOSE)
    beside = np.concatenate((2 * abreast, 2 * abreast + 1))
    along = np.arange(2 * len(lengths)).reshape(-1, 2)
    bend = np.minimum((BEND / np.maximum(lengths, 1.0)) ** 4, STIFFEST) * (lengths < ROOMY)
    first = np.concatenate((beside[:, 0], along[:, 0]))
    second = np.concatenate((beside[:, 1], along[:, 1]))
    spring = np.concatenate((np.full(len(beside), ABREAST), bend))
    shifts = offset + _at_rest(group, offset, pull, first, second, spring)[group]
    return shifts, jumps + shifts[ends[:, 1]] - shifts[ends[:, 0]]


def _groups(count: int, ends: IntArray, jumps: FloatArray) -> tuple[IntArray, FloatArray, NDArray[np.bool_]]:
    """Ends that must meet.

    Ends are paired by the smallest jumps first; an end without a partner then joins the nearest pair as a
    lane that opens or closes there. What is left leads across from one lane to another.

    Returns:
        [E] group of every end, [E] its offset in the group in m, [E] whether it is one of a pair.
    """
    group, offset = np.arange(count), np.zeros(count)
    tied, firm = np.zeros(count, bool), np.zeros(count, bool)
    order = np.argsort(np.abs(jumps), kind="stable")
    for k in order:
        a, b = ends[k]
        if not (tied[a] or tied[b]):
            tied[[a, b]] = firm[[a, b]] = True
            group[b], offset[b] = group[a], -jumps[k]
    for k in order:
        a, b = ends[k]
        if tied[a] and not tied[b]:
            group[b], offset[b], tied[b] = group[a], offset[a] - jumps[k], True
        elif tied[b] and not tied[a]:
            group[a], offset[a], tied[a] = group[b], offset[b] + jumps[k], True
    return group, offset, firm


def _at_rest(
    group: IntArray,
    offset: FloatArray,
    pull: FloatArray,
    first: IntArray,
    second: IntArray,
    spring: FloatArray,
) -> FloatArray:
    """[G] shift t of every group that minimises the springs' energy, by conjugate gradients.

    sum pull_e (offset_e + t_g(e))^2 + sum spring_k (offset_a + t_g(a) - offset_b - t_g(b))^2
    """
    a, b = group[first], group[second]
    apart = offset[first] - offset[second]
    count = len(group)

    def gathered(on_ends: FloatArray, on_springs: FloatArray) -> FloatArray:
        total = np.bincount(group, on_ends, count).astype(np.float64)
        return total + np.bincount(a, on_springs, count) - np.bincount(b, on_springs, count)

    between = np.where(a != b, spring, 0.0)
    diagonal = (
        np.bincount(group, pull, count) + np.bincount(a, between, count) + np.bincount(b, between, count)
    )
    diagonal = np.where(diagonal > 0.0, diagonal, 1.0)  # numbers that are no group
    t = np.zeros(count)
    residual = -gathered(pull * offset, spring * apart)
    step = residual / diagonal
    size = residual @ step
    for _ in range(1000):
        if np.abs(residual / diagonal).max() < PRECISION:
            break
        force = gathered(pull * step[group], spring * (step[a] - step[b]))
        rate = size / (step @ force)
        t += rate * step
        residual = residual - rate * force
        scaled = residual / diagonal
        size, before = residual @ scaled, size
        step = scaled + size / before * step
    return t
