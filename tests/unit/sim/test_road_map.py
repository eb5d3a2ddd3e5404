"""Road maps: borders of the road, points, segments and the grid index, compared with shapely."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import shapely
import torch
from shapely.geometry import LineString, MultiLineString, Point

from phase_sumo.bridge.maps.road_lines import road_edges, road_lines
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import ScenarioConfig
from phase_sumo.sim.bundle import MapBundle, bundle_key, load_if_current, save_bundle
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.near import nearest, pairs_within
from phase_sumo.sim.road_build import build_road_map
from phase_sumo.sim.road_cells import OFF_ROAD
from phase_sumo.sim.road_map import (
    ABSENT,
    BLOCK,
    CELL_SIZE,
    CONTACT_REACH,
    FAR,
    POINTS_PER_CELL,
    SEGMENTS_PER_CELL,
    RoadKind,
    RoadMap,
    merge,
)
from tests.helpers.small_nets import SmallNet, lanes_from
from tests.helpers.straight_road import straight_network

W = 3.6
FIRST = torch.zeros(1, dtype=torch.long)


@pytest.fixture(scope="module")
def ramp(tmp_path_factory) -> tuple[LaneNetwork, LaneGraph, RoadMap]:
    """Two lanes to the east (y = 0 and W); a third (y = -W) starts as a ramp, ends at x = 300."""
    net = SmallNet().edge("before", lanes_from(0, 100, 0, W))
    net.edge("ramp", [[(0, -40), (50, -13), (75, -W - 2), (100, -W)]])
    net.edge("merge", lanes_from(100, 300, -W, 0, W)).edge("after", lanes_from(300, 450, 0, W))
    net.connect("before", "merge", (0, 1), (1, 2)).connect("ramp", "merge", (0, 0))
    net.connect("merge", "after", (1, 0), (2, 1))
    network = read_network(net.write(tmp_path_factory.mktemp("ramp") / "ramp.net.xml"))
    graph = build_lane_graph(network)
    return network, graph, build_road_map(road_lines(network), graph)


def edge_lines(network: LaneNetwork) -> MultiLineString:
    return MultiLineString([LineString(line.points) for line in road_edges(network)])


# --- borders -------------------------------------------------------------------------------------------


def test_a_straight_road_has_an_edge_on_either_side_and_open_ends():
    edges = road_edges(straight_network(lanes=3, length=200.0, width=W))
    assert sorted(float(e.points[0, 1]) for e in edges) == pytest.approx([-W / 2, 2.5 * W])
    for edge in edges:
        assert float(np.ptp(edge.points[:, 1])) < 0.01
        assert float(np.ptp(edge.points[:, 0])) == pytest.approx(199.0, abs=0.1)


def test_boundaries_lie_between_lanes_abreast():
    lines = [
        line for line in road_lines(straight_network(lanes=3, width=W)) if line.kind == RoadKind.LANE_BOUNDARY
    ]
    assert sorted(float(line.points[0, 1]) for line in lines) == pytest.approx([W / 2, 1.5 * W])


@pytest.mark.parametrize(
    ("upwards", "downwards", "kind"),
    [
        ("emergency", "emergency", RoadKind.SOLID_BOUNDARY),
        ("emergency", "all", RoadKind.LANE_BOUNDARY),
        ("all", "emergency", RoadKind.LANE_BOUNDARY),
    ],
)
def test_a_line_is_solid_where_nobody_may_cross_it(tmp_path, upwards, downwards, kind):
    allowed = {0: {"changeLeft": upwards}, 1: {"changeRight": downwards}}
    net = SmallNet().edge("a", lanes_from(0, 100, 0, W), allowed)
    lines = road_lines(read_network(net.write(tmp_path / "small.net.xml")))
    assert {line.kind for line in lines} == {kind, RoadKind.ROAD_EDGE}


def test_no_edge_crosses_or_touches_a_lane_centre(ramp):
    network, _, _ = ramp
    edges = edge_lines(network)
    for lane in network.lanes:
        assert LineString(lane.points).distance(edges) > 0.45 * lane.width


def test_the_edge_closes_the_lane_that_ends(ramp):
    edges = edge_lines(ramp[0])
    beyond = LineString([(290, -W), (360, -W)])
    assert beyond.intersects(edges)
    # it leaves the merging vehicle a taper: at the lane's end the edge still is half a lane away
    assert Point(300, -W).distance(edges) == pytest.approx(W / 2, abs=0.2)
    heights = [LineString([(x, 0), (x, -20)]).intersection(edges).centroid.y for x in (305, 315, 325, 335)]
    assert (np.diff(heights) > 0.3).all(), "the edge comes closer over the taper"


def test_the_gore_between_ramp_and_road_is_closed(ramp):
    edges = edge_lines(ramp[0])
    assert LineString([(30, 0), (30, -25)]).intersects(edges)
    assert LineString([(60, 0), (50, -13)]).intersects(edges)
    assert not LineString([(110, W), (110, -W)]).intersects(edges)


def test_the_road_is_open_where_vehicles_enter_and_leave(ramp):
    edges = edge_lines(ramp[0])
    for entry in (Point(0, 0), Point(0, W), Point(0, -40), Point(450, 0), Point(450, W)):
        assert entry.distance(edges) > 0.4 * W


# --- tables --------------------------------------------------------------------------------------------


def test_the_tables_keep_their_empty_rows(ramp):
    road = ramp[2]
    assert road.count == 1
    for table, row in ((road.view, road.cell_view), (road.border, road.cell_border)):
        assert (table[-1, 4] == ABSENT).all()
        assert row[-1] == row.max() == len(table) - 1
        assert row.min() == 0
        assert (table[:, 4] >= 0).any(1)[:-1].all(), "no other empty row"
    assert road.cell_off_road[-1]
    assert road.view.shape[2] == POINTS_PER_CELL
    assert road.border.shape[2] <= SEGMENTS_PER_CELL


def test_points_lie_on_their_lines_and_point_with_the_traffic(ramp):
    network, _, road = ramp
    points = road.view.transpose(1, 2).reshape(-1, 5)
    points = points[points[:, 4] != ABSENT].unique(dim=0).numpy()
    xy, along, kind = points[:, :2], points[:, 2:4], points[:, 4]
    np.testing.assert_allclose(np.hypot(*along.T), 1.0, atol=1e-5)
    centres = MultiLineString([LineString(lane.points) for lane in network.lanes])
    lines = road_lines(network)
    for of_kind, drawn in (
        (RoadKind.LANE_CENTRE, centres),
        (RoadKind.ROAD_EDGE, edge_lines(network)),
        (
            RoadKind.LANE_BOUNDARY,
            MultiLineString([LineString(r.points) for r in lines if r.kind == RoadKind.LANE_BOUNDARY]),
        ),
    ):
        assert (kind == of_kind).sum() > 20
        assert shapely.distance(shapely.points(xy[kind == of_kind]), drawn).max() < 0.1
    # everything on this road leads east
    assert (along[:, 0] > 0.5).mean() > 0.97


def cell_centres(road: RoadMap) -> np.ndarray:
    """[C, 2] centre of each cell but the padding one."""
    centres = np.zeros((road.cell_yaw.shape[0] - 1, 2))
    grid, first, ny = road.grid.numpy(), road.grid_block.numpy(), int(road.grid_shape[0, 1])
    for block in np.flatnonzero(first > 0):
        cell = grid[first[block] : first[block] + BLOCK**2]
        used = np.flatnonzero(cell < len(centres))
        square = BLOCK * np.array(divmod(block, ny)) + np.stack(np.divmod(used, BLOCK), -1)
        centres[cell[used]] = road.grid_origin[0].numpy() + (square + 0.5) * CELL_SIZE
    return centres


def test_a_cell_knows_every_segment_that_a_vehicle_in_it_can_touch(ramp):
    road = ramp[2]
    centres = cell_centres(road)
    segment, _ = road.segments()
    number = {tuple(row): k for k, row in enumerate(segment.tolist())}
    lines = shapely.linestrings(segment.numpy().astype(float).reshape(-1, 2, 2))
    for cell in range(0, len(centres), 7):
        distance = shapely.distance(Point(centres[cell]), lines)
        *ends, kind = road.borders_at(torch.tensor(cell))
        rows = torch.stack(ends, -1)[kind != ABSENT].tolist()
        listed = {number[tuple(row)] for row in rows}
        assert len(listed) == len(rows), "each segment once"
        close = set(np.flatnonzero(distance < CONTACT_REACH - 0.01).tolist())
        wide = set(np.flatnonzero(distance < CONTACT_REACH + 0.01).tolist())
        assert close <= listed <= wide


def test_cell_direction_and_off_road_follow_the_nearest_lane(ramp):
    _, graph, road = ramp
    centres = cell_centres(road)
    distance = np.hypot(*(centres[:, None] - graph.node_xy[None]).transpose(2, 0, 1))
    node = distance.argmin(1)
    np.testing.assert_array_equal(road.cell_off_road[:-1].numpy(), distance.min(1) > OFF_ROAD)
    tie = np.sort(distance, 1)
    clear = tie[:, 1] - tie[:, 0] > 1e-3
    turn = np.abs(road.cell_yaw[:-1].numpy() - graph.node_yaw[node])[clear]
    assert turn[~road.cell_off_road[:-1].numpy()[clear]].max() < 1e-6
    assert turn.max() < 0.02, "off the road the node may be the next but one"


def test_cells_answer_on_the_road_and_only_there(ramp):
    _, graph, road = ramp
    padding = road.cell_yaw.shape[0] - 1
    on_road = torch.from_numpy(graph.node_xy)[None]
    cells = road.cell(FIRST, *on_road.unbind(-1))
    assert (cells < padding).all()
    assert not road.cell_off_road[cells].any()
    away = torch.tensor([[[200.0, 60.0], [-1000.0, 0.0], [1e6, 1e6], [600.0, 0.0]]])
    assert (road.cell(FIRST, *away.unbind(-1)) == padding).all()
    # the square that holds the position is meant: both sides of every grid line are told apart
    origin = road.grid_origin[0]
    step = torch.tensor([[[9.99 * CELL_SIZE, 10.0], [10.01 * CELL_SIZE, 10.0]]]) + origin
    low, high = road.cell(FIRST, *step.unbind(-1))[0]
    assert low != high


def test_what_is_seen_from_a_cell_lies_ahead(ramp):
    _, graph, road = ramp
    node = int(np.argmin(np.hypot(*(graph.node_xy - np.array([150.0, 0.0])).T)))
    cell = int(road.cell(FIRST, *torch.from_numpy(graph.node_xy[node])[None, None].unbind(-1))[0, 0])
    x, y, _, _, kind = road.seen_in(road.cell_view[torch.tensor(cell)])
    xy, kind = torch.stack((x, y), -1)[kind != ABSENT], kind[kind != ABSENT]
    assert len({tuple(point) for point in xy.tolist()}) == len(xy) >= 28
    assert xy[:, 0].min() > 140
    assert xy[:, 0].max() < 260
    counts = {
        k: int((kind == k).sum()) for k in (RoadKind.LANE_CENTRE, RoadKind.LANE_BOUNDARY, RoadKind.ROAD_EDGE)
    }
    assert min(counts.values()) >= 4
    edges = xy[kind == RoadKind.ROAD_EDGE, 1]
    assert (edges > 0).any()
    assert (edges < 0).any(), "the edges on both sides"


# --- several maps --------------------------------------------------------------------------------------


def one_map(lanes: int, length: float, shift: float) -> RoadMap:
    network = straight_network(lanes, length)
    moved = tuple(replace(lane, points=lane.points + shift) for lane in network.lanes)
    network = LaneNetwork("moved", moved, ())
    graph = build_lane_graph(network)
    return build_road_map(road_lines(network), graph)


def seen(road: RoadMap, index: int, xy: torch.Tensor) -> dict[str, torch.Tensor]:
    """Everything the map says about positions [n, 2], without the indices themselves."""
    cell = road.cell(torch.tensor([index]), *xy[None].unbind(-1))[0]
    *ends, kind = road.borders_at(cell)
    border = torch.stack((*ends, torch.where(kind == ABSENT, FAR, kind)), -1)
    return {
        "yaw": road.cell_yaw[cell],
        "off_road": road.cell_off_road[cell],
        "node": road.cell_node[cell],
        "points": torch.stack(road.seen_in(road.cell_view[cell]), -1),
        # maps differ in how many segments a row has room for
        "borders": torch.nn.functional.pad(border, (0, 0, 0, SEGMENTS_PER_CELL - border.shape[1]), value=FAR),
    }


def test_merged_maps_answer_like_the_single_ones(ramp):
    maps = [one_map(2, 120.0, 0.0), ramp[2], one_map(4, 200.0, 1000.0)]
    merged = merge(maps)
    assert merged.count == 3
    random = torch.Generator().manual_seed(0)
    for index, single in enumerate(maps):
        size = single.grid_shape[0] * BLOCK * CELL_SIZE
        xy = single.grid_origin[0] + size * (torch.rand(2000, 2, generator=random) * 1.4 - 0.2)
        expected, got = seen(single, 0, xy), seen(merged, index, xy)
        for name, values in expected.items():
            torch.testing.assert_close(got[name], values, rtol=0, atol=0, msg=name)


def test_a_map_of_a_hundred_kilometres_across_stores_only_blocks_with_road():
    far = [
        replace(lane, points=lane.points + np.array([x, y]), left=-1, right=-1)
        for lane in straight_network(1, 200.0).lanes
        for x, y in ((0.0, 0.0), (1e5, 1e5))
    ]
    network = LaneNetwork("far", tuple(far), ())
    graph = build_lane_graph(network)
    road = build_road_map(road_lines(network), graph)
    assert road.grid.shape[0] < 20 * BLOCK**2
    cells = road.cell(FIRST, *torch.from_numpy(graph.node_xy)[None].unbind(-1))[0]
    padding = road.cell_yaw.shape[0] - 1
    assert (cells < padding).all()
    assert set(cells[:201].tolist()).isdisjoint(cells[201:].tolist())
    beyond = torch.tensor([[[5e4, 5e4], [0.0, 1e5], [-1e5, 0.0], [1e5, 2e5]]])
    assert (road.cell(FIRST, *beyond.unbind(-1)) == padding).all()


# --- bundles -------------------------------------------------------------------------------------------


def test_a_bundle_is_current_only_for_what_it_was_made_from(tmp_path, straight_map: MapBundle):
    network, scenario = straight_network(), ScenarioConfig()
    key = bundle_key(network, scenario, 0)
    assert key == bundle_key(straight_network(), scenario, 0)
    moved = replace(network, lanes=(replace(network.lanes[0], points=network.lanes[0].points + 1e-3),))
    others = {
        bundle_key(moved, scenario, 0),
        bundle_key(network, scenario, 1),
        bundle_key(network, replace(scenario, max_lane_changes=1), 0),
    }
    assert len(others | {key}) == 4
    path = tmp_path / "map.npz"
    assert load_if_current(path, key) is None, "no file"
    save_bundle(path, replace(straight_map, key=key))
    again = load_if_current(path, key)
    assert again is not None
    assert again.key == key
    assert torch.equal(again.road_map.view, straight_map.road_map.view)
    assert all(load_if_current(path, other) is None for other in others)
    path.write_bytes(path.read_bytes()[:2000])
    assert load_if_current(path, key) is None, "damaged"


def test_arrays_and_back(straight_map: MapBundle):
    road = straight_map.road_map
    again = RoadMap.from_arrays(road.arrays())
    for f in fields(RoadMap):
        assert torch.equal(getattr(again, f.name), getattr(road, f.name))


# --- searching -----------------------------------------------------------------------------------------


def test_pairs_within_a_radius_are_all_found():
    random = np.random.default_rng(0)
    query, points = random.uniform(-50, 50, (80, 2)), random.uniform(-70, 30, (300, 2))
    q, p = pairs_within(query, points, 7.0)
    distance = np.hypot(*(query[:, None] - points[None]).transpose(2, 0, 1))
    assert set(zip(q.tolist(), p.tolist(), strict=True)) == set(
        zip(*np.nonzero(distance <= 7.0), strict=True)
    )
    index, found = nearest(query, points, 7.0)
    has = distance.min(1) <= 7.0
    np.testing.assert_array_equal(index, np.where(has, distance.argmin(1), -1))
    np.testing.assert_allclose(found[has], distance.min(1)[has])
    assert np.isinf(found[~has]).all()
