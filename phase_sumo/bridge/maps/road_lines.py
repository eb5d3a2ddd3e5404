"""Lane boundaries and road edges of a lane network, as polylines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiLineString, Polygon
from shapely.geometry.base import BaseGeometry

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.bridge.maps.line_geometry import arc_length, normals, resample
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.near import abeam, pairs_within
from phase_sumo.sim.polylines import Polylines
from phase_sumo.sim.road_build import RoadLine
from phase_sumo.sim.road_cells import point_segment_distance
from phase_sumo.sim.road_map import RoadKind

TAPER = 40.0  # m over which the border closes after a lane's end or opens before its start
CLOSE_GAP = 0.3  # m: gaps up to twice this between lanes belong to the road
TOLERANCE = 0.05  # m of simplification
SEPARATE = 0.8  # m: a boundary is drawn where two lanes lie this exactly side by side
SMALLEST_HOLE = 20.0  # m^2: smaller holes in the surface are seams between lanes, not islands
OPPOSITE = 0.6  # m: lanes of opposite directions whose borders are closer share a divided surface
SPACING = 2.0  # m between points of borders before they are simplified
SHORTEST_EDGE = 0.5  # m: shorter pieces of border are left-overs of cutting the open ends


def road_lines(network: LaneNetwork) -> list[RoadLine]:
    """Lane boundaries between lanes abreast, dividers of two-way roads, and the border of the surface."""
    return lane_boundaries(network) + dividers(network) + road_edges(network)


def lane_boundaries(network: LaneNetwork) -> list[RoadLine]:
    """One line per pair of lanes abreast: the left border of the right-hand one of the two.

    The line may be crossed when a change is allowed in either direction.
    """
    lanes = _Centres.of(network)
    crossed_from_left = {lane.right for lane in network.lanes if lane.right >= 0}
    left = np.array([lane.left for lane in network.lanes])[lanes.owner]
    wanted = 0.5 * (lanes.width + lanes.width_of[left])
    # where a lane forks off or merges, the two are still one: no line there
    apart = (left < 0) | (np.abs(_gap_to(lanes, left) - wanted) < SEPARATE)
    border = lanes.xy + 0.5 * lanes.width[:, None] * lanes.normal
    lines = []
    for i, lane in enumerate(network.lanes):
        if lane.left < 0 and not lane.solid_left:
            continue
        kind = RoadKind.LANE_BOUNDARY if lane.left >= 0 or i in crossed_from_left else RoadKind.SOLID_BOUNDARY
        lines += _pieces(kind, border[lanes.points(i)], apart[lanes.points(i)])
    return lines


def dividers(network: LaneNetwork) -> list[RoadLine]:
    """Solid lines between touching lanes of opposite directions, which have no road edge between them."""
    lanes = _Centres.of(network)
    inner = np.array(
        [lane.connector or (lane.right if network.left_hand else lane.left) >= 0 for lane in network.lanes]
    )
    border = lanes.xy + (-0.5 if network.left_hand else 0.5) * lanes.width[:, None] * lanes.normal
    asked = np.flatnonzero(~inner[lanes.owner])
    q, k = pairs_within(border[asked], lanes.xy, 0.5 * float(lanes.width.max()) + OPPOSITE)
    q = asked[q]
    gap = np.abs(np.hypot(*(border[q] - lanes.xy[k]).T) - 0.5 * lanes.width[k])
    against = (lanes.normal[q] * lanes.normal[k]).sum(1) < -0.7
    near = np.zeros(len(border), bool)
    near[q[against & (gap < OPPOSITE) & (lanes.owner[k] > lanes.owner[q])]] = True
    lines = []
    for i in np.unique(lanes.owner[near]):
        lines += _pieces(RoadKind.SOLID_BOUNDARY, border[lanes.points(i)], near[lanes.points(i)])
    return lines


@dataclass(frozen=True)
class _Centres:
    """Points about `SPACING` apart on all centre lines.

    Attributes:
        xy, normal: [N, 2] m and unit normal to the left.
        owner, width: [N] lane of each point and its width in m.
        first: [L + 1] first point of each lane.
        width_of: [L] m.
    """

    xy: FloatArray
    normal: FloatArray
    owner: IntArray
    width: FloatArray
    first: IntArray
    width_of: FloatArray

    @staticmethod
    def of(network: LaneNetwork) -> _Centres:
        lines = Polylines.of([lane.points for lane in network.lanes])
        samples = lines.samples(SPACING)
        xy = lines.at(samples)
        first = np.concatenate(([0], np.cumsum(samples.counts)))
        owner = np.repeat(np.arange(len(samples.counts)), samples.counts)
        node = np.arange(len(xy))
        along = xy[np.minimum(node + 1, first[owner + 1] - 1)] - xy[np.maximum(node - 1, first[owner])]
        along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
        normal = np.stack((-along[:, 1], along[:, 0]), -1)
        width_of = np.array([lane.width for lane in network.lanes])
        return _Centres(xy, normal, owner, width_of[owner], first, width_of)

    def points(self, lane: int) -> slice:
        """Points of one lane."""
        return slice(int(self.first[lane]), int(self.first[lane + 1]))


def _gap_to(lanes: _Centres, other: IntArray) -> FloatArray:
    """[N] distance in m from each point to the centre line of lane ``other`` [N]; inf where that is -1."""
    asked = np.flatnonzero(other >= 0)
    at, own = lanes.xy[asked], lanes.owner[asked]
    first, last = lanes.first[other[asked]], lanes.first[other[asked] + 1] - 1
    share = (asked - lanes.first[own]) / (lanes.first[own + 1] - 1 - lanes.first[own])
    guess = first + np.rint(share * (last - first)).astype(np.int64)
    along = np.stack((lanes.normal[:, 1], -lanes.normal[:, 0]), -1)
    near = abeam(at, guess, lanes.xy, along, (first, last), SPACING, 3)
    pieces = (lanes.xy[np.maximum(near - 1, first)], lanes.xy[near], lanes.xy[np.minimum(near + 1, last)])
    gap = np.full(len(other), np.inf)
    gap[asked] = np.minimum(
        point_segment_distance(at, np.hstack(pieces[:2])), point_segment_distance(at, np.hstack(pieces[1:]))
    )
    return gap


def _pieces(kind: RoadKind, line: FloatArray, drawn: NDArray[np.bool_]) -> list[RoadLine]:
    """The stretches of a line where it is drawn."""
    return [RoadLine(kind, _simplified(line[a:b])) for a, b in _runs(drawn)]


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Half-open ranges of at least two true entries."""
    change = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(change[::2], change[1::2], strict=True) if b - a >= 2]


def road_edges(network: LaneNetwork) -> list[RoadLine]:
    """Outlines of the union of all lanes, except where vehicles enter and leave the network."""
    surface = drivable_surface(network)
    rings = [
        LineString(ring.coords)
        for part in shapely.get_parts(surface)
        for ring in (part.exterior, *part.interiors)
    ]
    openings = shapely.union_all(_openings(network))
    lines = []
    for ring in rings:
        for piece in _merged(ring.difference(openings)):
            line = piece.simplify(TOLERANCE)
            if line.length > SHORTEST_EDGE:
                lines.append(RoadLine(RoadKind.ROAD_EDGE, np.asarray(line.coords)))
    return lines


def drivable_surface(network: LaneNetwork) -> BaseGeometry:
    """Union of all lanes and tapers; narrow gaps between them are closed."""
    centres = np.array([LineString(lane.points) for lane in network.lanes])
    half_width = 0.5 * np.array([lane.width for lane in network.lanes])
    parts = [*shapely.buffer(centres, half_width, cap_style="flat", join_style="mitre")]
    parts += tapers(network)
    parts += _seams(network)
    grown = shapely.union_all(parts).buffer(CLOSE_GAP, join_style="mitre", mitre_limit=2.0)
    surface = grown.buffer(-CLOSE_GAP, join_style="mitre", mitre_limit=2.0)
    return shapely.union_all([_without_small_holes(part) for part in shapely.get_parts(surface)])


def _seams(network: LaneNetwork) -> list[BaseGeometry]:
    """Cover the wedges between the square ends of lanes that meet at an angle."""
    pairs = [(network.lanes[a], network.lanes[b]) for a, b in network.successors]
    ends = np.array([np.concatenate((a.points[-2:], b.points[:2])) for a, b in pairs]).reshape(-1, 4, 2)
    half_width = 0.5 * np.array([min(a.width, b.width) for a, b in pairs])
    lines = shapely.linestrings(ends)
    return [*shapely.buffer(lines, half_width, cap_style="flat", join_style="round", quad_segs=3)]


def _without_small_holes(surface: Polygon) -> Polygon:
    return Polygon(surface.exterior, [r for r in surface.interiors if Polygon(r).area >= SMALLEST_HOLE])


def tapers(network: LaneNetwork) -> list[Polygon]:
    """Wedges that close the border beyond lanes that end within the road, or open it before they begin."""
    onward: dict[int, int] = {}
    backward: dict[int, int] = {}
    for a, b in network.successors:
        onward.setdefault(a, b)
        backward.setdefault(b, a)
    result = []
    for lane in network.lanes:
        for dead, chain in ((lane.dead_end, onward), (lane.dead_start, backward)):
            if dead and (side := _carrying_side(network, lane, chain)):
                result.append(_taper(network, lane, side, chain, at_end=chain is onward))
    return [polygon for polygon in result if polygon.is_valid and polygon.area > 0]


def _carrying_side(network: LaneNetwork, lane: Lane, chain: dict[int, int]) -> int:
    """+1 where the lane to the left goes on, -1 where the right one does, else 0."""
    for side, other in ((1, lane.left), (-1, lane.right)):
        if other >= 0 and other in chain:
            return side
    return 0


def _taper(network: LaneNetwork, lane: Lane, side: int, chain: dict[int, int], at_end: bool) -> Polygon:
    """A wedge along the lane that goes on, from the dead lane's width down to nothing."""
    at = lane.left if side > 0 else lane.right
    carrier = network.lanes[at]
    # start a little inside the dead lane so that the union has no slit
    pieces = [carrier.points[-2:] if at_end else carrier.points[:2][::-1]]
    while sum(arc_length(p)[-1] for p in pieces[1:]) < TAPER and at in chain:
        at = chain[at]
        points = network.lanes[at].points
        pieces.append(points if at_end else points[::-1])
    line = resample(np.concatenate([pieces[0][-1:], *pieces[1:]]), 2.0)
    s = arc_length(line)
    line, s = line[s <= TAPER], s[s <= TAPER]
    if len(line) < 2:
        return Polygon()
    # the dead lane lies on the other side of the carrier; backwards lines see it mirrored
    turn = -side if at_end else side
    normal = turn * normals(line)
    inner = line + (0.5 * carrier.width - 0.2) * normal
    outer = line + (0.5 * carrier.width + lane.width * (1 - s / s[-1]))[:, None] * normal
    return Polygon(np.concatenate((inner, outer[::-1])))


def _openings(network: LaneNetwork) -> list[Polygon]:
    """Boxes over the lane ends where vehicles enter or leave the network."""
    has_next = {a for a, _ in network.successors}
    has_previous = {b for _, b in network.successors}
    boxes = []
    for i, lane in enumerate(network.lanes):
        if i not in has_next and not lane.dead_end:
            boxes.append(_box(lane.points[-1], lane.points[-1] - lane.points[-2], lane.width))
        if i not in has_previous and not lane.dead_start:
            boxes.append(_box(lane.points[0], lane.points[0] - lane.points[1], lane.width))
    return boxes


def _box(at: FloatArray, outward: FloatArray, width: float) -> Polygon:
    """0.5 m into the road, 1 m out of it, a little wider than the lane."""
    along = outward / np.hypot(*outward)
    across = (0.5 * width + 0.1) * np.array([-along[1], along[0]])
    near, far = at - 0.5 * along, at + 1.0 * along
    return Polygon([near - across, near + across, far + across, far - across])


def _merged(geometry: BaseGeometry) -> list[LineString]:
    lines = [g for g in shapely.get_parts(geometry) if isinstance(g, LineString) and g.length > 0]
    merged = shapely.line_merge(MultiLineString(lines))
    return [g for g in shapely.get_parts(merged) if isinstance(g, LineString)]


def _simplified(points: FloatArray) -> FloatArray:
    return np.asarray(LineString(points).simplify(TOLERANCE).coords)
