"""The shipped networks and scenarios: they convert, read as what they are meant to be, and can be remade."""

from __future__ import annotations

import re
import subprocess
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
import sumolib
from shapely.geometry import LineString, MultiLineString

from networks.generate import LANE_WIDTH, SPECS, generate
from phase_sumo.bridge.network import read_network
from phase_sumo.bridge.road_lines import road_edges
from phase_sumo.config import REGIMES
from phase_sumo.sim.lane_graph import build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.pool import build_pool
from scenarios.generate import generate as generate_scenario

ROOT = Path(__file__).resolve().parents[2]
NETWORKS = sorted((ROOT / "networks").glob("*.net.xml"))
HELD_OUT = sorted((ROOT / "networks" / "held_out").glob("*.net.xml"))
MERGE = ROOT / "scenarios" / "merge" / "merge.net.xml"
# the files were made by this version; another one may write other attributes
MADE_WITH = "1.28"
same_sumo = pytest.mark.skipif(
    not version("eclipse-sumo").startswith(f"{MADE_WITH}."),
    reason=f"the files were made with SUMO {MADE_WITH}",
)


def read(path: Path) -> LaneNetwork:
    network = read_network(path)
    assert network.warnings == ()
    return network


def ends(network: LaneNetwork) -> tuple[int, int, int]:
    """Lanes by which vehicles leave, lanes that end within the road, lanes that start within it."""
    goes_on = {a for a, _ in network.successors}
    leaves = sum(i not in goes_on and not lane.dead_end for i, lane in enumerate(network.lanes))
    lanes = network.lanes
    return leaves, sum(lane.dead_end for lane in lanes), sum(lane.dead_start for lane in lanes)


def test_every_network_is_there_once():
    assert [p.name.removesuffix(".net.xml") for p in NETWORKS] == [s.name for s in SPECS if not s.held_out]
    assert [p.name.removesuffix(".net.xml") for p in HELD_OUT] == [s.name for s in SPECS if s.held_out]


@pytest.mark.parametrize("path", [*NETWORKS, *HELD_OUT, MERGE], ids=lambda p: p.name.split(".")[0])
def test_the_network_converts_into_a_road_that_can_be_driven(path):
    network = read(path)
    graph = build_lane_graph(network)
    assert {lane.width for lane in network.lanes} == {LANE_WIDTH}
    assert all(lane.allows_car and lane.allows_truck for lane in network.lanes)
    # no corner, no jump, no curve tighter than a ramp of 150 m
    a, column = np.nonzero(graph.successor >= 0)
    b = graph.successor[a, column]
    turn = np.abs((graph.node_yaw[b] - graph.node_yaw[a] + np.pi) % (2 * np.pi) - np.pi)
    assert turn.max() < 0.05
    assert np.abs(graph.node_curvature).max() < 1 / 150
    assert graph.step[a, column].min() > 0.9
    assert graph.step[a, column].max() < 1.1
    # one piece of road whose edges keep half a lane's distance
    edges = MultiLineString([LineString(line.points) for line in road_edges(network)])
    clearance = shapely.distance(shapely.points(graph.node_xy.astype(float)), edges)
    assert clearance.min() > 0.45 * LANE_WIDTH


@pytest.mark.parametrize("path", [*NETWORKS, *HELD_OUT], ids=lambda p: p.name.split(".")[0])
def test_the_network_offers_tasks_for_cars_and_trucks(path):
    graph = build_lane_graph(read(path))
    pool = build_pool(graph, REGIMES[0])
    assert len(pool.start) > 1000
    assert pool.truck.mean() > 0.8
    assert (pool.lane_changes < 0).any()
    assert (pool.lane_changes > 0).any()
    lanes_left = set(graph.node_lane.tolist()) - set(graph.node_lane[pool.goal].tolist())
    # every lane is somebody's goal, but for those within the shortest path from where vehicles enter
    short = REGIMES[0].path_bounds[0]
    for lane in lanes_left:
        assert graph.node_upstream[graph.node_lane == lane].max() < short


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
    ],
)
def test_ramps_drops_and_additions_are_understood(name, expected):
    assert ends(read(ROOT / "networks" / f"{name}.net.xml")) == expected


@same_sumo
def test_generating_a_network_again_gives_the_same_bytes(tmp_path):
    spec = next(s for s in SPECS if s.name == "f04_onramp3")
    made = generate(spec, tmp_path)
    assert made.read_bytes() == (ROOT / "networks" / made.name).read_bytes()
    plain = sorted((tmp_path / "plain").iterdir())
    assert [p.name for p in plain] == [f"f04_onramp3.{kind}.xml" for kind in ("con", "edg", "nod")]
    for path in plain:
        assert path.read_bytes() == (ROOT / "networks" / "plain" / path.name).read_bytes()


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
