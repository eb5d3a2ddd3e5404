"""Overlap tests against shapely."""

from __future__ import annotations

import math

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, Point, Polygon

from phase_sumo.sim.geometry import box_touches_segment, boxes_overlap, segment_distance, wrap_angle

coordinate = st.floats(-15, 15).map(lambda v: round(v, 3))
box_values = st.tuples(coordinate, coordinate, st.floats(-4, 4), st.floats(0.5, 9), st.floats(0.3, 1.5))


def box_of(values) -> torch.Tensor:
    x, y, yaw, half_length, half_width = values
    return torch.tensor([x, y, math.cos(yaw), math.sin(yaw), half_length, half_width], dtype=torch.float64)


def polygon_of(values) -> Polygon:
    x, y, yaw, a, b = values
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    return Polygon(np.array([[a, b], [-a, b], [-a, -b], [a, -b]]) @ turn + (x, y))


@settings(max_examples=300, deadline=None)
@given(box_values, box_values)
def test_box_overlap_agrees_with_shapely(first, second):
    p, q = polygon_of(first), polygon_of(second)
    if 0 < p.distance(q) < 1e-6 or (p.intersects(q) and p.intersection(q).area < 1e-9):
        return  # too close to call in floating point
    assert boxes_overlap(box_of(first), box_of(second)).item() == p.intersects(q)


@settings(max_examples=300, deadline=None)
@given(box_values, st.tuples(coordinate, coordinate, coordinate, coordinate))
def test_box_segment_contact_agrees_with_shapely(box, segment):
    polygon, line = polygon_of(box), LineString([segment[:2], segment[2:]])
    if polygon.exterior.distance(line) < 1e-6 and polygon.intersection(line).length < 1e-6:
        return
    ends = torch.tensor(segment, dtype=torch.float64).unbind()
    assert box_touches_segment(box_of(box), ends).item() == polygon.intersects(line)


@settings(max_examples=100, deadline=None)
@given(
    st.tuples(coordinate, coordinate), st.tuples(coordinate, coordinate), st.tuples(coordinate, coordinate)
)
def test_segment_distance_agrees_with_shapely(start, end, point):
    (ax, ay), (bx, by), (px, py) = torch.tensor([start, end, point], dtype=torch.float64)
    ours = segment_distance((ax, ay), (bx, by), (px, py)).item()
    assert math.isclose(ours, LineString([start, end]).distance(Point(point)), abs_tol=1e-5)


def test_wrap_angle():
    angles = torch.tensor([0.0, math.pi + 0.1, -math.pi - 0.1, 7.0])
    torch.testing.assert_close(
        wrap_angle(angles), torch.tensor([0.0, 0.1 - math.pi, math.pi - 0.1, 7.0 - 2 * math.pi])
    )
