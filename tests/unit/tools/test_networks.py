"""The shipped networks and scenarios: they convert, read as what they are meant to be, and can be remade."""

from __future__ import annotations

import csv
import re
import subprocess
from collections import Counter
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
import sumolib
from shapely.geometry import LineString, MultiLineString

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.net_xml import parse_net
from phase_sumo.bridge.maps.road_lines import road_edges
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import POOLS, REGIMES
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.pool import StartGoalPool
from phase_sumo.sim.tuples import map_regime_tuples
from tests.helpers.places import ROOT
from tools.networks.features import features
from tools.networks.generate import generate
from tools.networks.hard import generate as generate_hard
from tools.networks.specs import SPECS
from tools.networks.traffic import run_sumo
from tools.scenarios import generate as generate_scenario

NETWORKS = sorted((ROOT / "networks").glob("*.net.xml"))
HARD = sorted((ROOT / "networks" / "hard").glob("*.net.xml"))
HELD_OUT = sorted((ROOT / "networks" / "held_out").glob("*.net.xml"))
MERGE = ROOT / "scenarios" / "merge" / "merge.net.xml"
# the files were made by this version; another one may write other attributes
MADE_WITH = "1.28"
same_sumo = pytest.mark.skipif(
    not version("eclipse-sumo").startswith(f"{MADE_WITH}."),
    reason=f"the files were made with SUMO {MADE_WITH}",
)


def name_of(path: Path) -> str:
    return path.name.split(".")[0]


def read(path: Path) -> LaneNetwork:
    network = read_network(path)
    assert network.warnings == ()
    return network


@cache
def bundle_of(path: Path) -> MapBundle:
    return build_bundle(read(path))


def ends(network: LaneNetwork) -> tuple[int, int, int]:
    """Lanes by which vehicles leave, lanes that end within the road, lanes that start within it."""
    goes_on = {a for a, _ in network.successors}
    leaves = sum(i not in goes_on and not lane.dead_end for i, lane in enumerate(network.lanes))
    lanes = network.lanes
    return leaves, sum(lane.dead_end for lane in lanes), sum(lane.dead_start for lane in lanes)


def test_every_network_is_there_once():
    assert [name_of(p) for p in NETWORKS] == [s.name for s in SPECS if not s.held_out]
    assert [name_of(p) for p in HELD_OUT] == [s.name for s in SPECS if s.held_out]
    assert (len(NETWORKS), len(HELD_OUT)) == (22, 6)


@pytest.mark.parametrize("path", [*NETWORKS, *HELD_OUT, MERGE], ids=name_of)
def test_the_network_converts_into_a_road_that_can_be_driven(path):
    network, graph = read(path), bundle_of(path).graph
    # no corner, no jump, no curve tighter than a loop ramp
    a, column = np.nonzero(graph.successor >= 0)
    b = graph.successor[a, column]
    turn = np.abs((graph.node_yaw[b] - graph.node_yaw[a] + np.pi) % (2 * np.pi) - np.pi)
    assert turn.max() < 0.05
    kinds = {lane.edge: lane.kind for lane in parse_net(path).lanes.values()}
    ramp = np.array(["_link" in kinds[lane.edge] or lane.connector for lane in network.lanes])
    curvature = np.abs(graph.node_curvature)
    assert curvature.max() < 1 / 38  # loops of 40 m radius, measured over a few metres
    assert curvature[~ramp[graph.node_lane]].max() < 1 / 180
    assert graph.step[a, column].min() > 0.9
    assert graph.step[a, column].max() < 1.1
    # one piece of road whose edges keep half a lane's distance
    edges = MultiLineString([LineString(line.points) for line in road_edges(network)])
    clearance = shapely.distance(shapely.points(graph.node_xy.astype(float)), edges)
    assert (clearance / np.array([lane.width for lane in network.lanes])[graph.node_lane]).min() > 0.45


@pytest.mark.parametrize("path", [*NETWORKS, *HELD_OUT], ids=name_of)
def test_the_network_offers_tasks_for_cars_and_trucks(path):
    graph, pools = bundle_of(path).graph, bundle_of(path).pools
    rows = (ROOT / "networks" / "tuples.csv").read_text().split()
    for regime, pool in zip(POOLS, pools, strict=True):
        if regime.name == "free" and f"{name_of(path)},free" not in rows:
            continue  # too curved or too short for the fastest traffic
        assert len(pool.start) > 1000
        assert (pool.lane_changes < 0).any()
        assert (pool.lane_changes > 0).any()
        assert pool.truck.mean() > 0.4
    lanes_left = set(graph.node_lane.tolist()) - set(graph.node_lane[pools[0].goal].tolist())
    # every lane is somebody's goal, but for those within the shortest path from where vehicles enter
    short = REGIMES[0].path_bounds[0]
    for lane in lanes_left:
        assert graph.node_upstream[graph.node_lane == lane].max() < short


FEATURES = {
    *(f"{lanes} lanes" for lanes in range(2, 7)),
    *("straight", "curve", "S-curve", "two carriageways", "left-hand traffic"),
    *(
        "on-ramp",
        "off-ramp",
        "two-lane on-ramp",
        "two-lane off-ramp",
        "option lane",
        "left exit",
        "loop ramp",
    ),
    *("acceleration lane", "deceleration lane", "weaving lane", "lane drop", "lane addition", "zipper"),
    *("option lane", "collector-distributor road", "lane without trucks", "solid line"),
}


def test_the_training_networks_have_every_feature_of_us_freeways():
    found = {name_of(path): features(path) for path in NETWORKS}
    assert set().union(*found.values()) == FEATURES
    assert [name for name, has in found.items() if "left-hand traffic" in has] == ["f20_lefthand2"]
    assert [name for name, has in found.items() if "zipper" in has] == ["f13_zipper3"]
    ramps = {"on-ramp", "acceleration lane", "off-ramp", "deceleration lane"}
    assert features(MERGE) == {"3 lanes", "4 lanes", *ramps}


def test_dimensions_vary_and_no_network_repeats_another():
    limits = {lane.speed_limit for path in NETWORKS for lane in read(path).lanes}
    assert 24.5 < min(v for v in limits if v > 24.0) < max(limits) < 33.0
    widths = {lane.width for path in NETWORKS for lane in read(path).lanes}
    assert len(widths) >= 4
    assert 3.3 <= min(widths) < max(widths) == 3.66
    shapes = {bundle_of(path).graph.node_curvature.tobytes() for path in [*NETWORKS, *HELD_OUT]}
    assert len(shapes) == 28


def test_the_tuples_are_the_papers_77_and_those_that_training_takes():
    with (ROOT / "networks" / "tuples.csv").open(encoding="utf-8", newline="") as file:
        header, *rows = list(csv.reader(file))
    assert header == ["map", "regime"]
    found = Counter(regime for _, regime in rows)
    assert found == {regime.name: regime.tuples for regime in REGIMES}
    bundles = [bundle_of(path) for path in NETWORKS]
    assert [tuple(row) for row in rows] == [
        (bundles[m].name, REGIMES[r].name) for m, r in map_regime_tuples(bundles)
    ]


def test_ties_of_the_tuples_go_by_name_and_maps_without_room_are_left_out():
    some = bundle_of(NETWORKS[0])
    none = replace(
        some, name="a", pools=tuple(StartGoalPool(*(a[:0] for a in p.arrays().values())) for p in some.pools)
    )
    maps = [replace(some, name="c"), none, replace(some, name="b"), replace(some, name="d")]
    free = [m for m, r in map_regime_tuples(maps) if REGIMES[r].name == "free"]
    assert free == [0, 2]
    assert [m for m, r in map_regime_tuples(maps) if REGIMES[r].name == "jammed"] == [0, 2, 3]


@pytest.mark.slow
@pytest.mark.parametrize("path", [*NETWORKS, *HELD_OUT], ids=name_of)
def test_sumos_traffic_gets_from_every_entry_to_every_exit(path, tmp_path):
    result = run_sumo(path, tmp_path)
    assert result.inserted > 20
    assert result.collisions == result.teleports == result.emergency_stops == 0
    assert result.arrived == result.wanted


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("f01_straight3", (3, 0, 0)),
        ("f04_onramp3", (3, 1, 0)),
        ("f05_offramp3", (4, 0, 1)),
        ("f06_weave3", (4, 0, 0)),
        ("f07_drop4", (3, 1, 0)),
        ("f08_add2", (3, 0, 1)),
        ("f09_tworamp3", (4, 1, 0)),
        ("f13_zipper3", (2, 0, 0)),
        ("f14_collector2", (3, 1, 0)),
        ("f17_onramps2", (2, 2, 0)),
        ("f18_exit4", (6, 0, 1)),
        ("f19_leftexit2", (3, 0, 1)),
        ("f20_lefthand2", (2, 2, 0)),
        ("f21_bothways2", (5, 1, 1)),
    ],
)
def test_ramps_drops_and_additions_are_understood(name, expected):
    assert ends(read(ROOT / "networks" / f"{name}.net.xml")) == expected


@same_sumo
@pytest.mark.parametrize(
    "name",
    ["f04_onramp3", "f13_zipper3", "f14_collector2", "f20_lefthand2", "f21_bothways2", "h01_curve_onramp2"],
)
def test_generating_a_network_again_gives_the_same_bytes(name, tmp_path):
    made = generate(next(s for s in SPECS if s.name == name), tmp_path)
    assert made.read_bytes() == (ROOT / "networks" / made.relative_to(tmp_path)).read_bytes()
    plain = sorted((tmp_path / "plain").iterdir())
    assert [p.name for p in plain] == [f"{name}.{kind}.xml" for kind in ("con", "edg", "nod")]
    for path in plain:
        assert path.read_bytes() == (ROOT / "networks" / "plain" / path.name).read_bytes()


@same_sumo
def test_generating_the_hard_networks_again_gives_the_same_bytes(tmp_path):
    made = generate_hard(tmp_path)
    assert sorted(made) == sorted(tmp_path.iterdir())
    assert sorted(path.name for path in made) == sorted(path.name for path in HARD)
    for path in made:
        assert path.read_bytes() == (ROOT / "networks" / "hard" / path.name).read_bytes()


def test_hard_networks_are_tighter_than_all_others():
    def tightest(bundle: MapBundle) -> float:
        return float(1.0 / bundle.graph.bend.max())

    hard = [build_bundle(read_network(path)) for path in HARD]
    assert len(hard) == 8
    assert max(tightest(bundle) for bundle in hard) < min(tightest(bundle_of(path)) for path in NETWORKS)
    assert min(tightest(bundle) for bundle in hard) > 10.0
    assert all(len(bundle.pools[0].start) > 300 for bundle in hard)


@same_sumo
def test_generating_the_merge_scenario_again_gives_the_same_bytes(tmp_path):
    generate_scenario(tmp_path)
    made = sorted(p.name for p in (tmp_path / "merge").iterdir())
    assert made == ["merge.net.xml", "merge.rou.xml", "merge.sumocfg"]
    for name in made:
        assert (tmp_path / "merge" / name).read_bytes() == (MERGE.parent / name).read_bytes()


def test_shipped_files_hold_no_times_paths_or_options():
    files = [*(ROOT / "networks").rglob("*.xml"), *MERGE.parent.iterdir()]
    assert len(files) > 40
    for path in files:
        text = path.read_text(encoding="utf-8")
        assert "<!--" not in text, path
        assert not re.search(r"/(home|root|tmp|work|Users)/|[A-Z]:\\\\", text), path


def test_the_merge_scenario_has_its_ramps_where_it_says():
    network = read(MERGE)
    assert ends(network) == (4, 1, 1)
    lanes = {lane.id: lane for lane in network.lanes}
    assert lanes["main1_0"].dead_end
    assert lanes["main1_0"].length == pytest.approx(250, abs=10)
    assert lanes["main3_0"].dead_start
    assert lanes["main1_0"].points[0, 0] == pytest.approx(800, abs=10)
    assert lanes["main0_0"].speed_limit == pytest.approx(29.06)
    assert 15 <= lanes["onramp1_0"].speed_limit <= 20


def test_everybody_gets_through_the_merge_scenario_with_sumos_idm(tmp_path):
    result, trips = tmp_path / "statistics.xml", tmp_path / "trips.xml"
    command = [sumolib.checkBinary("sumo"), "-c", MERGE.with_name("merge.sumocfg"), "--no-warnings"]
    command += ["--statistic-output", result, "--tripinfo-output", trips]
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)
    statistics = ElementTree.parse(result).getroot()

    def value(element: str, name: str) -> float:
        found = statistics.find(element)
        assert found is not None
        return float(found.get(name, "nan"))

    assert 260 <= value("vehicles", "inserted") <= 340
    for element, name in (
        ("vehicles", "running"),
        ("vehicles", "waiting"),
        ("teleports", "total"),
        ("safety", "collisions"),
        ("safety", "emergencyStops"),
        ("safety", "emergencyBraking"),
    ):
        assert value(element, name) == 0, name
    rows = list(ElementTree.parse(trips).getroot())
    assert max(float(row.get("departDelay", "nan")) for row in rows) < 10.0
    trucks = [row for row in rows if row.get("vType") in ("truck", "long_truck")]
    assert 0.05 < len(trucks) / len(rows) < 0.2
    ends_at = {row.get("arrivalLane", "").rsplit("_", 1)[0] for row in rows}
    assert ends_at == {"main4", "offramp3"}
