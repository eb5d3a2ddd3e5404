"""Real and generated networks become roads that a tractor with a trailer can follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
import sumo
import sumolib
from shapely.geometry import LineString
from sumolib import geomhelper

from phase_sumo.bridge.maps.alignment import BLEND
from phase_sumo.bridge.maps.convert import TURN, lateral_kinks, turn_per_metre
from phase_sumo.bridge.maps.coordinates import LanePositions
from phase_sumo.bridge.maps.line_geometry import arc_length
from phase_sumo.bridge.maps.net_xml import parse_net
from phase_sumo.bridge.maps.road_lines import road_edges, road_lines
from phase_sumo.bridge.maps.stretches import cut
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import REGIMES
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.pool import TIGHTEST, build_pool
from phase_sumo.sim.road_build import build_road_map
from tests.helpers.places import NOT_SHARED, ROOT, SHARED

REAL = SHARED / "nets"  # real networks that are not shipped
A10 = Path(sumo.SUMO_HOME) / "tools" / "game" / "A10KW" / "osm.net.xml"
SHIPPED = [*(ROOT / "networks").rglob("*.net.xml"), *(ROOT / "scenarios").rglob("*.net.xml")]
FILES = sorted(SHIPPED) + sorted(REAL.rglob("*.net.xml")) + [A10]
HAIRPINS = {  # rad/m
    "us_baltimore_01.net.xml": 0.3,  # an exit ends in a corner of 110 degrees within 12 m
    "f27_ramps1.net.xml": 0.2,  # curves of 13 m radius, drawn with few corners
    "f28_ramp2.net.xml": 0.2,
}

pytestmark = pytest.mark.filterwarnings("ignore:.*grid squares see more than:UserWarning")


@pytest.fixture(scope="module", params=FILES, ids=lambda path: path.name.split(".")[0])
def path(request) -> Path:
    if not request.param.is_file():
        pytest.skip(f"{request.param.name} is not part of this installation")
    return request.param


@pytest.fixture(scope="module")
def road(path) -> tuple[LaneNetwork, LaneGraph]:
    network = read_network(path)
    return network, build_lane_graph(network)


def test_the_real_networks_are_there():
    if not REAL.is_dir():
        pytest.skip(f"{NOT_SHARED}/nets")
    assert len(list(REAL.rglob("*.net.xml"))) >= 20


def test_no_path_has_a_kink(road):
    _, graph = road
    assert len(lateral_kinks(graph)) == 0


def test_a_trailer_can_follow_every_path(path, road):
    _, graph = road
    turn = turn_per_metre(graph)
    if path.name in HAIRPINS:
        assert (turn > TURN).sum() < 10
        assert turn.max() < HAIRPINS[path.name]
    else:
        assert turn.max() < TURN


def test_lane_positions_and_points_agree_both_ways(road):
    network, _ = road
    for part in cut(network, 500.0):
        at = LanePositions(part)
        names, positions = sampled(part)
        for offset in (0.0, 1.5, -1.5):
            xy = at.xy(names, positions, offset)
            again, left = at.on_lane(names, xy)
            assert np.hypot(*(at.xy(names, again, left) - xy).T).max() < 0.1
            if offset == 0.0:
                np.testing.assert_allclose(again, positions, atol=0.1)
                found, position, left = at.locate(xy)
                assert all(found)
                assert np.hypot(*(at.xy(found, position, left) - xy).T).max() < 0.1


def sampled(network: LaneNetwork) -> tuple[list[str], np.ndarray]:
    """About one lane position per metre of every lane."""
    names, positions = [], []
    for lane in network.lanes:
        start, end = (0.0, lane.length) if lane.positions is None else lane.positions[[0, -1]]
        own = np.linspace(start, end, max(2, round(end - start)))
        names += [lane.id] * len(own)
        positions.append(own)
    return names, np.concatenate(positions)


def test_lane_positions_are_sumos_own(path, road):
    """Where a lane was not smoothed, x and y are what SUMO's tools give for the lane position."""
    network, _ = road
    at, net = LanePositions(network), parse_net(path)
    for lane in network.lanes:
        if lane.connector or lane.positions is not None:
            continue
        shape = [tuple(point) for point in net.points(net.lanes[lane.id])]
        scale = geomhelper.polyLength(shape) / lane.length
        for position in np.linspace(0.0, lane.length, 7):
            within = min(position * scale, lane.length * scale - 1e-9)
            point = np.array(geomhelper.positionAtShapeOffset(shape, within))
            assert np.hypot(*(at.xy([lane.id], [position])[0] - point)) < 0.1


def test_sumolib_reads_the_same(path):
    net, theirs = parse_net(path), sumolib.net.readNet(str(path), withInternal=True)
    lanes = {lane.getID(): lane for edge in theirs.getEdges() for lane in edge.getLanes()}
    on_foot = [name for name in lanes if ":" in name and name not in net.lanes]
    assert net.lanes.keys() | on_foot == lanes.keys()
    for name, lane in net.lanes.items():
        other = lanes[name]
        assert (lane.edge, lane.number) == (other.getEdge().getID(), other.getIndex())
        assert (lane.width, lane.speed, lane.length) == (
            other.getWidth(),
            other.getSpeed(),
            other.getLength(),
        )
        assert lane.car == other.allows("passenger")
        assert lane.truck == (other.allows("truck") and other.allows("trailer"))
        np.testing.assert_allclose(net.points(lane), [point[:2] for point in other.getShape()])
    connections = {
        (name, c.getToLane().getID(), c.getViaLaneID() or None)
        for name, lane in lanes.items()
        for c in lane.getOutgoing()
        if name in net.lanes and c.getToLane().getID() in net.lanes
    }
    assert {(c.source, c.target, c.via) for c in net.connections} == connections


def test_links_are_about_a_metre_long(road):
    _, graph = road
    assert graph.step.max() < 1.6


def test_no_road_edge_comes_near_a_lane_centre(road):
    network, graph = road
    edges = shapely.union_all([LineString(line.points) for line in road_edges(network)])
    room = 0.4 * np.array([lane.width for lane in network.lanes])[graph.node_lane]
    distance = shapely.distance(shapely.points(graph.node_xy.astype(np.float64)), edges)
    assert (distance > room).all()


def test_lanes_stay_close_to_the_file(path, road):
    """A lane that opens out of its neighbour starts in it, so blends move lanes by up to two widths.

    Elsewhere a centre line is off the file's only where a corner is rounded.
    """
    network, _ = road
    net = parse_net(path)
    for lane in network.lanes:
        if not lane.connector:
            away = shapely.distance(shapely.points(lane.points), LineString(net.points(net.lanes[lane.id])))
            assert away.max() < 2.0 * lane.width, lane.id
            s = arc_length(lane.points)
            assert away[(s > BLEND[1]) & (s < s[-1] - BLEND[1])].max(initial=0.0) < 1.0, lane.id


def test_the_road_map_is_finite_and_every_node_has_a_cell(road):
    network, graph = road
    road_map = build_road_map(road_lines(network), graph)
    for name, array in road_map.arrays().items():
        assert np.isfinite(array).all(), name
    maps = road_map.grid_offset.new_zeros(1)
    cell = road_map.cell(maps, *road_map.view.new_tensor(graph.node_xy)[None].unbind(-1))
    assert (cell < len(road_map.cell_yaw) - 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("regime", REGIMES, ids=lambda regime: regime.name)
def test_every_regime_finds_pairs_with_and_without_lane_changes(road, regime):
    _, graph = road
    pool = build_pool(graph, regime)
    # on roads that are too curved hardly any are left
    drivable = graph.bend <= TIGHTEST
    if drivable.mean() > 0.9:
        assert (pool.lane_changes == 0).sum() > 100
        assert (pool.lane_changes != 0).sum() > 100 or (graph.left < 0).all()
    assert drivable[pool.start].all() and drivable[pool.goal].all()
    low, high = regime.path_bounds
    assert ((pool.path_length >= low) & (pool.path_length <= high)).all()


def test_the_motorway_of_a_town_is_kept_and_the_town_left_out():
    if not A10.is_file():
        pytest.skip("SUMO was installed without its game scenarios")
    network = read_network(A10)
    assert any("not freeway" in warning for warning in network.warnings)
    everything = read_network(A10, keep="all")
    assert len(network.lanes) < 0.5 * len(everything.lanes)
    assert max(lane.speed_limit for lane in network.lanes) > 25.0
