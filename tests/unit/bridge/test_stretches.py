"""Cutting long networks: where, that nothing is lost or doubled, and that lane positions stay."""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from phase_sumo.bridge.maps.convert import convert
from phase_sumo.bridge.maps.coordinates import LanePositions
from phase_sumo.bridge.maps.line_geometry import arc_length
from phase_sumo.bridge.maps.road_lines import road_lines
from phase_sumo.bridge.maps.stretches import cut
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.errors import PhaseError
from phase_sumo.report.map_picture import draw_map
from phase_sumo.sim.bundle import load_bundle
from phase_sumo.sim.lane_graph import build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.road_map import RoadKind
from tests.helpers.small_nets import SmallNet, lanes_from

W = 3.6


@pytest.fixture
def read(tmp_path):
    def reader(net: SmallNet, **options: Any) -> LaneNetwork:
        return read_network(net.write(tmp_path / "road.net.xml"), **options)

    return reader


def motorway(ramp: float = 300.0) -> SmallNet:
    """Three edges of 800 m with two lanes, and a ramp that joins at x = 800 m by a lane that ends."""
    net = SmallNet().edge("a", lanes_from(0, 800, W, 2 * W)).edge("b", lanes_from(800, 1600, 0, W, 2 * W))
    net.edge("c", lanes_from(1600, 2400, W, 2 * W)).edge("r", [[(800 - ramp, -60), (780, -2), (800, 0)]])
    net.connect("a", "b", (0, 1), (1, 2)).connect("b", "c", (1, 0), (2, 1))
    return net.connect("r", "b", (0, 0))


def metres(network: LaneNetwork) -> dict[str, float]:
    total: dict[str, float] = defaultdict(float)
    for lane in network.lanes:
        total[lane.id] += float(arc_length(lane.points)[-1])
    return total


def test_every_metre_of_lane_lies_in_one_stretch(read):
    whole = read(motorway())
    parts = cut(whole, 500.0)
    assert [part.name for part in parts] == [f"road_{k:02d}" for k in range(5)]
    cut_up: dict[str, float] = defaultdict(float)
    for part in parts:
        for name, length in metres(part).items():
            cut_up[name] += length
    assert cut_up == pytest.approx(metres(whole))
    covered = defaultdict(list)
    for part in parts:
        for lane in part.lanes:
            positions = (0.0, lane.length) if lane.positions is None else lane.positions[[0, -1]]
            covered[lane.id].append(tuple(positions))
    for name, spans in covered.items():
        spans.sort()
        assert spans[0][0] == 0.0, name
        for (_, end), (start, _) in pairwise(spans):
            assert end == pytest.approx(start)


def test_lanes_abreast_are_cut_at_one_cross_section(read):
    for part in cut(read(motorway()), 500.0):
        ends = defaultdict(set)
        for lane in part.lanes:
            if lane.edge in ("a", "b", "c"):
                ends[lane.edge].add(tuple(lane.points[[0, -1], 0].round(3)))
        assert all(len(sections) == 1 for sections in ends.values())
        for i, lane in enumerate(part.lanes):
            if lane.left >= 0:
                assert part.lanes[lane.left].right == i
                assert part.lanes[lane.left].edge == lane.edge


def test_cuts_keep_away_from_junctions(read):
    """A cut wanted at x = 800 m, where the ramp joins, moves to where all that is over."""
    parts = cut(read(motorway()), 800.0)
    ends = {round(float(x)) for part in parts for lane in part.lanes for x in lane.points[[0, -1], 0]}
    assert 850 in ends or 750 in ends


def test_a_ramp_belongs_to_the_stretch_where_it_joins(read):
    parts = cut(read(motorway()), 500.0)
    (home,) = [part for part in parts if any(lane.edge == "r" for lane in part.lanes)]
    index = {lane.id: i for i, lane in enumerate(home.lanes)}
    assert (index["r_0"], index["b_0"]) in home.successors


def test_a_long_ramp_is_cut_as_well(read):
    parts = cut(read(motorway(ramp=790.0)), 500.0)
    assert sum(any(lane.edge == "r" for lane in part.lanes) for part in parts) == 2


def test_a_cut_is_open_and_a_dead_end_stays_one(read):
    parts = cut(read(motorway()), 500.0)
    for part in parts:
        for lane in part.lanes:
            own_end = lane.edge == "b" and lane.id == "b_0" and lane.points[-1, 0] == 1600
            assert lane.dead_end == own_end
            assert not lane.dead_start
        edges = [line.points for line in road_lines(part) if line.kind == RoadKind.ROAD_EDGE]
        graph = build_lane_graph(part)
        for end in ([graph.node_xy[:, 0].min(), W], [graph.node_xy[:, 0].max(), W]):
            assert min(np.hypot(*(line - end).T).min() for line in edges) > 1.0


def test_lane_positions_are_sumos_in_every_stretch(read):
    net = SmallNet().edge("a", lanes_from(0, 2000, 0, W), {0: {"length": 1990.0}, 1: {"length": 1990.0}})
    for part in cut(read(net), 500.0):
        at = LanePositions(part)
        for lane in part.lanes:
            assert lane.positions is not None
            position = np.linspace(lane.positions[0], lane.positions[-1], 7)
            xy = at.xy([lane.id] * 7, position)
            np.testing.assert_allclose(xy[:, 0], position * 2000 / 1990, atol=1e-6)
            again, offset = at.on_lane([lane.id] * 7, xy)
            np.testing.assert_allclose((again, offset), (position, np.zeros(7)), atol=1e-6)
        graph = build_lane_graph(part)
        np.testing.assert_allclose(graph.node_position * 2000 / 1990, graph.node_xy[:, 0], atol=1e-3)


@pytest.mark.parametrize("length", [300, 740])
def test_what_is_hardly_longer_than_a_stretch_stays_whole(read, length):
    network = read(SmallNet().edge("a", lanes_from(0, length, 0)))
    assert cut(network, 500.0) == [network]


def test_nothing_is_cut_when_nobody_asks(read):
    network = read(motorway())
    assert cut(network, 0.0) == [network]


def test_pieces_have_about_the_length_asked_for(read):
    network = read(SmallNet().edge("a", lanes_from(0, 5000, 0, W)))
    for stretch in (200.0, 500.0, 1000.0):
        sizes = [arc_length(part.lanes[0].points)[-1] for part in cut(network, stretch)]
        assert sizes == pytest.approx([stretch] * round(5000 / stretch))


def test_a_ring_is_cut_too(read):
    angle = np.linspace(0, np.pi, 100)
    half = np.stack((600 * np.cos(angle), 600 * np.sin(angle)), -1)
    net = SmallNet().edge("a", [half.tolist()]).edge("b", [(-half).tolist()])
    parts = cut(read(net.connect("a", "b", (0, 0)).connect("b", "a", (0, 0))), 500.0)
    assert sum(sum(metres(part).values()) for part in parts) == pytest.approx(3769, abs=2)
    assert len(parts) == 8


def test_short_roads_that_meet_no_other_are_left_out_of_a_large_network(read):
    net = motorway().edge("far", lanes_from(0, 80, 900))
    parts = cut(read(net), 500.0)
    assert not any(lane.edge == "far" for part in parts for lane in part.lanes)


def test_convert_writes_a_bundle_per_stretch_and_one_row(tmp_path):
    path = motorway().write(tmp_path / "road.net.xml")
    (row,) = convert([path], tmp_path / "out", draw=draw_map)
    names = [f"road_{k:02d}" for k in range(5)]
    assert (row["stretches"], row["names"]) == (5, names)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(
        f"{name}.{ending}" for name in names for ending in ("npz", "png")
    )
    bundles = [load_bundle(tmp_path / "out" / f"{name}.npz") for name in names]
    assert row["nodes"] == sum(len(bundle.graph.node_lane) for bundle in bundles)
    assert row["pairs"] == sum(len(pool.goal) for bundle in bundles for pool in bundle.pools)
    assert row["lanes"] == 8
    (whole,) = convert([path], tmp_path / "whole", stretch=0)
    assert whole["names"] == ["road"]
    assert whole["lane_km"] == row["lane_km"]


def test_stretches_that_would_overwrite_another_network_are_refused(tmp_path):
    paths = [motorway().write(tmp_path / f"{name}.net.xml") for name in ("road", "road_01")]
    SmallNet().edge("a", lanes_from(0, 300, 0)).write(paths[1])
    with pytest.raises(PhaseError, match=r"both be written to road_01\.npz"):
        convert(paths, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("stretch", [-1.0, 10.0, float("nan"), float("inf")])
def test_a_stretch_too_short_to_drive_is_refused(tmp_path, stretch):
    with pytest.raises(PhaseError, match="at least 200 m"):
        convert([motorway().write(tmp_path / "road.net.xml")], tmp_path / "out", stretch=stretch)
