"""Exact overlap tests of oriented boxes, branch-free over any leading axes.

A box is the first axis of a tensor: centre x, y, cos yaw, sin yaw, half length, half width
(see `phase_sumo.sim.vehicles.boxes`), so that every component is contiguous. Touching counts as
overlapping.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor


def boxes_overlap(a: Iterable[Tensor], b: Iterable[Tensor]) -> Tensor:
    """Separating-axis test of two sets of boxes.

    Two boxes are disjoint iff one of their four face normals separates them.

    Args:
        a, b: the six numbers of the boxes, each [...], broadcast against each other.

    Returns:
        [...] bool.
    """
    ax, ay, acos, asin, alen, awid = a
    bx, by, bcos, bsin, blen, bwid = b
    dx, dy = bx - ax, by - ay
    cos = (acos * bcos + asin * bsin).abs()
    sin = (acos * bsin - asin * bcos).abs()
    # how far the boxes reach into each other along each axis; minima and one comparison are cheaper than four
    depth = torch.minimum(
        torch.minimum(
            alen + blen * cos + bwid * sin - (dx * acos + dy * asin).abs(),
            awid + blen * sin + bwid * cos - (dy * acos - dx * asin).abs(),
        ),
        torch.minimum(
            blen + alen * cos + awid * sin - (dx * bcos + dy * bsin).abs(),
            bwid + alen * sin + awid * cos - (dy * bcos - dx * bsin).abs(),
        ),
    )
    return depth >= 0.0


def box_touches_segment(box: Tensor, segment: Sequence[Tensor]) -> Tensor:
    """Separating-axis test of a box against line segments.

    Args:
        box: [6, ...].
        segment: end points ax, ay, bx, by, each [...], broadcast against ``box``.

    Returns:
        [...] bool.
    """
    x, y, cos, sin, half_length, half_width = box.unbind(0)
    ax, ay, bx, by = segment
    ax, ay, bx, by = ax - x, ay - y, bx - x, by - y
    au, av = ax * cos + ay * sin, ay * cos - ax * sin
    bu, bv = bx * cos + by * sin, by * cos - bx * sin
    du, dv = bu - au, bv - av
    # how far box and segment reach into each other along the box's axes and across the segment
    depth = torch.minimum(
        torch.minimum(half_length - torch.minimum(au, bu), half_length + torch.maximum(au, bu)),
        torch.minimum(half_width - torch.minimum(av, bv), half_width + torch.maximum(av, bv)),
    )
    across = half_length * dv.abs() + half_width * du.abs() - (au * dv - av * du).abs()
    return torch.minimum(depth, across) >= 0.0


def segment_distance(
    start: tuple[Tensor, Tensor], end: tuple[Tensor, Tensor], point: tuple[Tensor, Tensor]
) -> Tensor:
    """Distance in m from ``point`` to the segment ``start``-``end``, each x and y [...]."""
    (ax, ay), (bx, by), (px, py) = start, end, point
    ux, uy, dx, dy = bx - ax, by - ay, px - ax, py - ay
    share = ((dx * ux + dy * uy) / (ux * ux + uy * uy).clamp_min(1e-12)).clamp(0.0, 1.0)
    return torch.hypot(dx - share * ux, dy - share * uy)


def materialise(*values: Tensor) -> tuple[Tensor, ...]:
    """The same values, worked out once and kept in memory (all of one shape and type).

    A compiler fuses what it can into every loop that reads it; of a value per agent that a loop over its
    neighbours reads, that is many times the work. What was stacked is not fused.
    """
    return torch.stack(values).unbind(0)


def stored(mask: Tensor) -> Tensor:
    """The same bool tensor; compiled, it is written as bytes, sixteen at a time instead of one by one."""
    return torch.where(mask, 1.0, 0.0).to(torch.uint8).view(torch.bool)


def wrap_angle(angle: Tensor) -> Tensor:
    """``angle`` in rad brought to [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi
