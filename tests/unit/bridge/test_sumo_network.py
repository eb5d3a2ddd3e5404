"""Reading `.net.xml`: permissions, neighbours, connectors, dead ends, what counts as freeway."""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
import pytest
from shapely.geometry import LineString, Point

from phase_sumo.bridge.maps.convert import lateral_kinks
from phase_sumo.bridge.maps.line_geometry import arc_length
from phase_sumo.bridge.maps.sumo_network import odd_lengths, read_network
from phase_sumo.errors import PhaseError
from phase_sumo.sim.lane_graph import build_lane_graph
from phase_sumo.sim.lanes import Lane, LaneNetwork
from tests.helpers.small_nets import SmallNet, lanes_from

W = 3.6


@pytest.fixture
def read(tmp_path):
    def reader(net: SmallNet, **options) -> LaneNetwork:
        return read_network(net.write(tmp_path / "small.net.xml"), **options)

    return reader


def by_id(network: LaneNetwork) -> dict[str, Lane]:
    return {lane.id: lane for lane in network.lanes}


def links(network: LaneNetwork) -> set[tuple[str, str]]:
    return {(network.lanes[a].id, network.lanes[b].id) for a, b in network.successors}


def two_roads(shift: float = 0.0, gap: float = 0.0) -> SmallNet:
    """Two edges of two lanes one after the other, joined lane by lane, without internal lanes."""
    net = SmallNet().edge("a", lanes_from(0, 200, 0, W))
    net.edge("b", lanes_from(200 + gap, 400 + gap, shift, W + shift))
    return net.connect("a", "b", (0, 0), (1, 1))


def test_lanes_carry_what_the_file_says(read):
    network = read(SmallNet().edge("a", lanes_from(0, 100, 0, W), {1: {"width": None, "speed": 27.5}}))
    right, left = network.lanes
    assert (right.id, right.edge, right.width, right.speed_limit) == ("a_0", "a", 3.6, 30.0)
    assert (left.width, left.speed_limit) == (3.2, 27.5)  # SUMO's default width
    np.testing.assert_allclose(left.points, [[0, W], [100, W]])


def test_permissions_by_vehicle_class(read):
    extra = {
        0: {"disallow": "all"},
        1: {"allow": "pedestrian bicycle"},
        2: {"disallow": "truck"},
        3: {"allow": "passenger truck"},
        4: {"allow": "truck trailer"},
        5: {"allow": "all"},
    }
    lanes = by_id(read(SmallNet().edge("a", lanes_from(0, 100, *(k * W for k in range(6))), extra)))
    allowed = {name: (lane.allows_car, lane.allows_truck) for name, lane in lanes.items()}
    # a truck here is a tractor with a trailer: both classes must be allowed
    assert allowed == {"a_2": (True, False), "a_3": (True, False), "a_4": (False, True), "a_5": (True, True)}
    assert lanes["a_2"].right == -1, "a footway is no neighbour"


def test_lane_0_is_the_rightmost_or_the_leftmost_in_left_hand_traffic(read):
    net = SmallNet().edge("a", lanes_from(0, 100, 0, W, 2 * W))
    assert [(lane.left, lane.right) for lane in read(net).lanes] == [(1, -1), (2, 0), (-1, 1)]
    net = SmallNet({"lefthand": "1"}).edge("a", lanes_from(0, 100, 0, -W, -2 * W))
    network = read(net)
    assert network.left_hand
    assert [(lane.left, lane.right) for lane in network.lanes] == [(-1, 1), (0, 2), (1, -1)]


@pytest.mark.parametrize("left_hand", [False, True])
def test_forbidden_lane_changes_are_solid_lines(read, left_hand):
    net = SmallNet({"lefthand": "true"} if left_hand else {})
    sign = -1 if left_hand else 1
    net.edge("a", lanes_from(0, 100, 0, sign * W), {0: {"changeLeft": "emergency"}})
    low, high = read(net).lanes
    towards, back = ("right", "left") if left_hand else ("left", "right")
    assert (getattr(low, towards), getattr(low, f"solid_{towards}")) == (-1, True)
    assert (getattr(high, back), getattr(high, f"solid_{back}")) == (0, False)


def test_coinciding_ends_are_linked_without_a_connector(read):
    assert links(read(two_roads())) == {("a_0", "b_0"), ("a_1", "b_1")}


def test_a_gap_without_internal_lanes_is_bridged(read):
    network = read(two_roads(gap=12.0))
    connectors = [lane for lane in network.lanes if lane.connector]
    assert [lane.length for lane in connectors] == pytest.approx([12.0, 12.0], abs=0.01)
    assert len(links(network)) == 4
    # connectors whose ends lie abreast lie abreast themselves
    assert network.lanes[connectors[0].left] is connectors[1]
    assert network.lanes[connectors[1].right] is connectors[0]


def test_a_chain_of_internal_lanes_becomes_one_connector(read):
    net = SmallNet().edge("a", lanes_from(0, 100, 0)).edge("b", lanes_from(110, 200, 0))
    net.edge(":n_0", [[(100, 0), (104, 0)]], function="internal")
    net.edge(":n_1", [[(104, 0), (110, 0)]], function="internal")
    net.connect("a", "b", (0, 0), via=":n_0_0")
    net.connect(":n_0", "b", (0, 0), via=":n_1_0").connect(":n_1", "b", (0, 0))
    network = read(net)
    assert links(network) == {("a_0", ":n_0_0"), (":n_0_0", "b_0")}
    connector = by_id(network)[":n_0_0"]
    assert connector.connector
    assert connector.length == pytest.approx(10.0)
    assert connector.parts == ((":n_0_0", 0.0), (":n_1_0", 4.0))
    np.testing.assert_allclose(connector.points[[0, -1]], [[100, 0], [110, 0]])


def test_heights_and_repeated_points_are_dropped(read):
    shape = [(0, 0, 10.0), (50, 0), (50, 0, 11.0), (50.001, 0), (100, 0, 12.0)]
    lane = read(SmallNet().edge("a", [shape])).lanes[0]
    np.testing.assert_allclose(lane.points, [[0, 0], [50, 0], [100, 0]])


def test_ids_with_awkward_characters(read):
    net = SmallNet().edge("-4#0.5 ü", lanes_from(0, 100, 0)).edge("b", lanes_from(100, 200, 0))
    assert links(read(net.connect("-4#0.5 ü", "b", (0, 0)))) == {("-4#0.5 ü_0", "b_0")}


def test_a_gzipped_file_reads_the_same(tmp_path):
    net = two_roads()
    plain = read_network(net.write(tmp_path / "small.net.xml"))
    packed = tmp_path / "small.net.xml.gz"
    packed.write_bytes(gzip.compress(net.text.encode()))
    again = read_network(packed)
    assert again.name == plain.name == "small"
    assert [lane.id for lane in again.lanes] == [lane.id for lane in plain.lanes]
    assert again.successors == plain.successors


def test_a_lane_that_stops_within_the_road_is_a_dead_end(read):
    net = SmallNet().edge("a", lanes_from(0, 200, 0, W)).edge("b", lanes_from(200, 400, W))
    lanes = by_id(read(net.connect("a", "b", (1, 0))))
    assert {name: lane.dead_end for name, lane in lanes.items()} == {"a_0": True, "a_1": False, "b_0": False}
    assert not any(lane.dead_start for lane in lanes.values())


def test_a_lane_that_starts_within_the_road_is_a_dead_start(read):
    net = SmallNet().edge("a", lanes_from(0, 200, W)).edge("b", lanes_from(200, 400, 0, W))
    lanes = by_id(read(net.connect("a", "b", (0, 1))))
    assert {name: lane.dead_start for name, lane in lanes.items()} == {
        "a_0": False,
        "b_0": True,
        "b_1": False,
    }


def test_a_lane_that_goes_on_to_a_road_left_out_is_an_exit(read):
    kinds: dict[str, Any] = {"type": "highway.motorway"}
    net = SmallNet().edge("a", lanes_from(0, 200, 0, W), **kinds).edge("b", lanes_from(200, 400, W), **kinds)
    net.edge("street", [[(200, 0), (300, -50)]], speed=13.9, type="highway.residential")
    net.connect("a", "b", (1, 0)).connect("a", "street", (0, 0))
    network = read(net)
    assert set(by_id(network)) == {"a_0", "a_1", "b_0"}
    assert not by_id(network)["a_0"].dead_end
    assert network.warnings == ("1 of 4 lanes are not freeway, left out (residential 1)",)
    assert "street_0" in by_id(read(net, keep="all"))


def test_roads_without_a_class_are_chosen_by_speed(read):
    net = SmallNet().edge("main", lanes_from(0, 300, 0), speed=25.0)
    net.edge("ramp", [[(300, 0), (400, -20)]], speed=13.9).connect("main", "ramp", (0, 0))
    net.edge("far", lanes_from(0, 300, 500), speed=13.9)  # as fast as the ramp, but not joined to it
    net.edge("slow", [[(400, -20), (500, -40)]], speed=8.3).connect("ramp", "slow", (0, 0))
    lanes = {lane.id for lane in read(net).lanes if not lane.connector}
    assert lanes == {"main_0", "ramp_0"}


def test_a_two_way_street_is_no_ramp(read):
    net = SmallNet().edge("main", lanes_from(0, 300, 0), speed=25.0)
    text = net.edge("street", [[(300, 0), (400, -20)]], speed=13.9).connect("main", "street", (0, 0)).text
    back = '<edge id="back" from="street.end" to="street.start"><lane id="back_0" index="0" speed="13.9" '
    back += 'length="102" shape="400,-23 300,-3"/></edge></net>'
    net.rows = [text.removeprefix("<net>").replace("</net>", ""), back.removesuffix("</net>")]
    assert {lane.id for lane in read(net).lanes if not lane.connector} == {"main_0"}


@pytest.mark.parametrize("shift", [0.5, 1.8, 3.6])
def test_a_sideways_jump_becomes_a_curve_that_a_trailer_can_follow(read, shift):
    network = read(two_roads(shift, gap=0.5))
    assert any("sideways jump" in warning for warning in network.warnings)
    index = {lane.id: i for i, lane in enumerate(network.lanes)}
    after = dict(network.successors)
    chain = [index["a_0"]]
    while chain[-1] in after:
        chain.append(after[chain[-1]])
    line = np.concatenate([network.lanes[i].points for i in chain])
    line = line[np.concatenate(([True], np.hypot(*np.diff(line, axis=0).T) > 0.02))]
    delta = np.diff(line, axis=0)
    slope = np.abs(delta[:, 1] / delta[:, 0])
    assert slope.max() < 0.16
    np.testing.assert_allclose(line[[0, -1]], [[0, 0], [400.5, shift]], atol=0.01)
    assert arc_length(line)[-1] == pytest.approx(400.5, abs=0.5)


def test_lane_positions_stay_sumos_where_a_lane_was_smoothed(read):
    """A detour of half a metre in the middle must not shift the positions beyond it."""
    shape = [(0, 0), (100, 0), (110, 4), (120, 0), (220, 0)]
    lane = read(SmallNet().edge("a", [shape], {0: {"length": 444.0}})).lanes[0]
    assert lane.positions is not None, "the corners are rounded"
    own = LineString(shape)
    exact = np.array([own.project(Point(p)) for p in lane.points]) * 444.0 / own.length
    np.testing.assert_allclose(lane.positions, exact, atol=0.1)
    assert (np.diff(lane.positions) >= 0).all()


def test_a_turnaround_is_left_out(read):
    net = SmallNet().edge("a", lanes_from(0, 200, 0)).edge("b", [[(200, 4), (0, 4)]])
    network = read(net.connect("a", "b", (0, 0)))
    assert network.successors == ()
    assert network.warnings == ("1 turnarounds left out",)


def test_lanes_without_extent_are_left_out(read):
    net = SmallNet().edge("a", lanes_from(0, 100, 0)).edge("b", [[(100, 0), (100, 0)]])
    network = read(net)
    assert [lane.id for lane in network.lanes] == ["a_0"]
    assert network.warnings == ("1 lanes without extent left out",)


def net_with(
    shape: str = "0,0 100,0", connection: str | None = None, twice: str | None = None, **values: str
) -> str:
    """One edge with one lane; ``connection`` is "from fromLane to toLane [via]"."""
    fields = {"id": "a_0", "index": "0", "speed": "30", "length": "100"} | values
    given = "".join(f' {name}="{value}"' for name, value in fields.items())
    edge = f'<edge id="a" from="x" to="y"><lane{given} shape="{shape}"/></edge>'
    text = edge + (edge if twice else "")
    if connection:
        names = ("from", "fromLane", "to", "toLane", "via")
        ends = "".join(f' {name}="{v}"' for name, v in zip(names, connection.split(), strict=False))
        text += f"<connection{ends}/>"
    return f"<net>{text}</net>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (net_with(shape="0,0 nan,1"), "shape"),
        (net_with(shape="0,0 1"), "shape"),
        (net_with(shape=""), "shape"),
        (net_with(speed="fast"), "speed='fast'"),
        (net_with(length="inf"), "length='inf'"),
        (net_with(length="1e6"), "length='1e6'"),
        (net_with(width="0"), "width=0"),
        (net_with(width="21"), "width=21"),
        (net_with(width="-3"), "width='-3'"),
        (net_with(shape="0,0 1e9,0"), "1e9"),
        (net_with(id=""), "has no id"),
        (net_with(connection="a 0 b 0"), "lane 0 of edge 'b'"),
        (net_with(connection="a 7 a 0"), "lane 7 of edge 'a'"),
        (net_with(connection="a 0 a 0 :x_0"), "the internal lane ':x_0'"),
        (net_with(connection="a one a 0"), "fromLane='one'"),
        (net_with(twice="1"), "'a_0' is there twice"),
        ("<additional/>", "<additional>"),
        ("<net", "not well-formed"),
        ("", "not well-formed"),
        ("<net/>", "no lane allows cars or trucks"),
        (net_with(disallow="all"), "no lane allows cars or trucks"),
        (net_with(speed="8.3"), "no freeway found"),
    ],
)
def test_a_bad_file_is_named_with_what_is_wrong(tmp_path, text, message):
    path = tmp_path / "bad.net.xml"
    path.write_text(text)
    with pytest.raises(PhaseError) as caught:
        read_network(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_attributes_are_named(tmp_path):
    path = tmp_path / "bad.net.xml"
    for name in ("id", "speed", "length", "shape"):
        path.write_text(net_with().replace(f' {name}="', f' no{name}="', 2 if name == "id" else 1))
        with pytest.raises(PhaseError, match=name):
            read_network(path)


# --- versions and rarities -----------------------------------------------------------------------------


def test_narrow_lanes_are_left_out_and_end_the_lane_before(read):
    """OpenDRIVE imports hold slivers of 0.4 m where a lane tapers off."""
    net = (
        SmallNet()
        .edge("a", lanes_from(0, 200, 0, W))
        .edge("b", lanes_from(200, 400, 0, W), {0: {"width": 0.4}})
    )
    network = read(net.connect("a", "b", (0, 0), (1, 1)))
    lanes = by_id(network)
    assert set(lanes) == {"a_0", "a_1", "b_1"}
    assert lanes["a_0"].dead_end and not lanes["a_1"].dead_end
    assert network.warnings == ("1 lanes narrower than 2 m left out",)


def test_empty_permission_lists_mean_none_given(read):
    extra = {0: {"allow": ""}, 1: {"disallow": ""}, 2: {"changeLeft": "", "changeRight": ""}}
    lanes = read(SmallNet().edge("a", lanes_from(0, 100, 0, W, 2 * W, 3 * W), extra)).lanes
    assert all(lane.allows_car and lane.allows_truck for lane in lanes)
    assert lanes[2].left == 3 and lanes[2].right == 1


def test_lanes_are_counted_as_sumo_does_it(read):
    """SUMO ignores the attribute; one of its own networks holds the same index twice."""
    extra = {1: {"index": 0}}
    lanes = by_id(read(SmallNet().edge("a", lanes_from(0, 100, 0, W), extra)))
    assert lanes["a_0"].left == 1 and lanes["a_1"].right == 0


def test_pedestrian_edges_and_their_connections_do_not_count(read):
    net = two_roads().edge(":c0", [[(0, -5), (0, 5)]], function="crossing")
    net.connect("a", ":c0", (0, 0)).connect(":c0", "a", (0, 0))
    assert links(read(net)) == {("a_0", "b_0"), ("a_1", "b_1")}


def test_edges_in_both_directions_on_one_line(read):
    """A bidi edge: the lane of one direction lies on that of the other."""
    net = SmallNet().edge("a", lanes_from(0, 300, 0), bidi="-a").edge("-a", [[(300, 0), (0, 0)]], bidi="a")
    network = read(net)
    assert len(network.lanes) == 2 and network.successors == ()


def test_a_network_without_classes_or_limits_keeps_the_roads_that_nothing_turns_off(read):
    """OpenDRIVE imports have SUMO's default of 13.89 m/s where the file gives no limit."""
    net = (
        SmallNet()
        .edge("a", lanes_from(0, 200, 0), speed=13.89)
        .edge("b", lanes_from(200, 400, 0), speed=13.89)
    )
    net.edge("c", [[(400, 0), (400, 100)]], speed=13.89).connect("a", "b", (0, 0))
    turn = '<connection from="b" to="c" fromLane="0" toLane="0" dir="l"/>'
    net.rows.append(turn)
    network = read(net)
    assert set(by_id(network)) == {"a_0"}
    assert "neither road classes nor speed limits" in network.warnings[0]


def test_a_connection_across_lanes_is_left_out(read):
    """Both lanes go on by themselves, and there is no room for a curve from one to the other."""
    net = two_roads().connect("a", "b", (0, 1))
    network = read(net)
    assert links(network) == {("a_0", "b_0"), ("a_1", "b_1")}
    assert "1 connections across lanes left out" in network.warnings


def test_a_lane_that_begins_behind_the_one_before_it_starts_at_its_end(read):
    network = read(two_roads(gap=-6.0))
    lanes = by_id(network)
    assert links(network) == {("a_0", "b_0"), ("a_1", "b_1")}
    np.testing.assert_allclose(lanes["b_0"].points[0], [200, 0], atol=0.1)
    assert lanes["b_0"].positions is not None
    assert lanes["b_0"].positions[[0, -1]] == pytest.approx([6.0, 200.0], abs=0.1)


def test_a_jump_is_shared_and_stays_within_its_blend(read):
    network = read(two_roads(1.8, gap=0.5))
    for lane in network.lanes:
        if not lane.connector:
            y = lane.points[:, 1] - (0.0 if lane.edge == "a" else 1.8) - (W if lane.id.endswith("1") else 0.0)
            far = np.abs(lane.points[:, 0] - 200.0) > 32.0
            assert np.abs(y).max() == pytest.approx(0.9, abs=0.05)
            assert np.abs(y[far]).max() < 0.01


def test_lanes_whose_length_is_not_that_of_their_shape_are_named(read):
    net = SmallNet().edge("odd", lanes_from(0, 200, 0, W), extra={1: {"length": 400.0}})
    net.edge("even", lanes_from(200, 400, 0, W), extra={0: {"length": 205.0}})
    network = read(net.connect("odd", "even", (0, 0), (1, 1)))
    (warning,) = odd_lengths(network.warnings)
    assert "odd_1 400 m, drawn 200 m" in warning
    assert "odd_0" not in warning and "even" not in warning
    many = SmallNet().edge(
        "far", lanes_from(0, 200, *(W * np.arange(8))), extra={k: {"length": 900.0} for k in range(8)}
    )
    (warning,) = odd_lengths(read(many).warnings)
    assert warning.startswith("8 lanes") and warning.count("drawn") == 5 and "and 3 more" in warning


@pytest.mark.parametrize("away", [(500_000.0, 5_400_000.0), (-5_000_000.0, 0.25)])
def test_a_network_far_from_the_origin_is_the_same_road(read, away):
    def net(x0, y0):
        bend = [[(x0, y + y0), (x0 + 200, y + y0), (x0 + 390, y + y0 + 61.7)] for y in (0, W)]
        net = SmallNet().edge("a", bend, type="highway.motorway")
        net.rows.append(f'<location netOffset="{x0},{y0}" projParameter="+proj=utm +zone=32"/>')
        return net

    near, far = read(net(0.0, 0.0)), read(net(*away))
    assert near.origin == (0.0, 0.0) and np.abs(np.concatenate([v.points for v in far.lanes])).max() < 300.0
    assert far.geo is not None
    offset = np.array([float(v) for v in far.geo.net_offset.split(",")])
    np.testing.assert_allclose(offset, np.array(away) - far.origin, atol=1e-6)
    back = far.moved(*far.origin)
    for a, b in zip(near.lanes, back.lanes, strict=True):
        np.testing.assert_allclose(b.points - away, a.points, atol=1e-5)
        assert (a.left, a.right) == (b.left, b.right)
    graphs = [build_lane_graph(network) for network in (near, far)]
    np.testing.assert_allclose(graphs[0].node_yaw, graphs[1].node_yaw, atol=1e-4)
    assert not len(lateral_kinks(graphs[1]))
    moved = read(net(away[0] + 1234.5, away[1] - 77.25))
    assert [v.points.tobytes() for v in moved.lanes] == [v.points.tobytes() for v in far.lanes]


def test_the_corner_of_an_exit_is_not_left_to_the_metres_within_the_junction(read):
    """Three lanes of which the right one leads off, at an angle of which 3.3 m would be far too tight."""
    for degrees in (6, 8, 10, 12):
        along = np.array([np.cos(np.radians(degrees)), -np.sin(np.radians(degrees))])
        start = np.array([403.3, -0.3])
        leads = [start.tolist(), (start + 200 * along).tolist()]
        net = SmallNet().edge("main", lanes_from(0, 400, 0, W, 2 * W))
        net.edge("on", lanes_from(403.3, 800, W, 2 * W)).edge("exit", [leads])
        net.connect("main", "exit", (0, 0)).connect("main", "on", (1, 0), (2, 1))
        graph = build_lane_graph(read(net))
        assert np.abs(graph.curvature(2)).max() < 0.035
