"""Real and generated networks become roads that a tractor with a trailer can follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
import sumo
from shapely.geometry import LineString

from phase_sumo.bridge.net_xml import parse_net
from phase_sumo.bridge.network import read_network
from phase_sumo.bridge.road_lines import road_edges, road_lines
from phase_sumo.config import REGIMES
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.pool import build_pool
from phase_sumo.sim.road_build import build_road_map

ROOT = Path(__file__).resolve().parents[2]
REAL = ROOT.parent / "shared" / "nets"  # real networks that are not shipped
A10 = Path(sumo.SUMO_HOME) / "tools" / "game" / "A10KW" / "osm.net.xml"
SHIPPED = [*(ROOT / "networks").rglob("*.net.xml"), *(ROOT / "scenarios").rglob("*.net.xml")]
FILES = sorted(SHIPPED) + sorted(REAL.rglob("*.net.xml")) + [A10]
LARGEST_TURN = 0.3  # rad per metre: 0.3 m sideways within 1 m

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
        pytest.skip(f"the folder of real networks ({REAL.name}) is not beside the repository")
    assert len(list(REAL.rglob("*.net.xml"))) >= 20


def test_no_centre_line_has_a_kink(road):
    _, graph = road
    xy = graph.node_xy.astype(np.float64)
    for first in range(graph.successor.shape[1]):
        a = np.flatnonzero(graph.successor[:, first] >= 0)
        b = graph.successor[a, first]
        for second in range(graph.successor.shape[1]):
            go = graph.successor[b, second] >= 0
            c = graph.successor[b[go], second]
            one, two = xy[b[go]] - xy[a[go]], xy[c] - xy[b[go]]
            cross = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
            turn = np.abs(np.arctan2(cross, (one * two).sum(1)))
            assert turn.max(initial=0.0) < LARGEST_TURN


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
    """A lane that opens out of its neighbour starts in it: blends move lanes by about a width, no more."""
    network, _ = road
    raw = parse_net(path).lanes
    for lane in network.lanes:
        if not lane.connector:
            away = shapely.distance(shapely.points(lane.points), LineString(raw[lane.id].points))
            assert away.max() < 1.5 * lane.width, lane.id


def test_the_road_map_is_finite_and_every_node_has_a_cell(road):
    network, graph = road
    road_map = build_road_map(road_lines(network), graph)
    for name, array in road_map.arrays().items():
        assert np.isfinite(array).all(), name
    maps = road_map.grid_offset.new_zeros(1)
    cell = road_map.cell(maps, road_map.point_xy.new_tensor(graph.node_xy)[None])
    assert (cell < len(road_map.cell_yaw) - 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("regime", REGIMES, ids=lambda regime: regime.name)
def test_every_regime_finds_pairs_with_and_without_lane_changes(road, regime):
    _, graph = road
    pool = build_pool(graph, regime)
    assert (pool.lane_changes == 0).sum() > 100
    assert (pool.lane_changes != 0).sum() > 100
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
