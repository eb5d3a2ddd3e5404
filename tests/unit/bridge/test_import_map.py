"""OpenStreetMap and OpenDRIVE through netconvert, told by content, and what is refused."""

from __future__ import annotations

import gzip
import subprocess

import pytest

from phase_sumo.bridge.maps import import_map
from phase_sumo.bridge.maps.convert import convert
from phase_sumo.bridge.maps.import_map import read_map
from phase_sumo.errors import PhaseError
from tests.helpers.small_nets import SmallNet, lanes_from

NODES = {1: (40.0, -80.0), 2: (40.0, -79.995), 3: (40.0005, -79.99), 4: (39.999, -79.993), 5: (40.01, -80.0)}


def osm(*ways: tuple[str, str], lanes: int = 3) -> str:
    """An extract; each way is (class, nodes)."""
    text = "".join(f'<node id="{k}" lat="{lat}" lon="{lon}"/>' for k, (lat, lon) in NODES.items())
    for k, (kind, nodes) in enumerate(ways):
        ends = "".join(f'<nd ref="{n}"/>' for n in nodes.split())
        tags = {"highway": kind, "oneway": "yes"} | ({"lanes": str(lanes)} if kind == "motorway" else {})
        tags_text = "".join(f'<tag k="{name}" v="{value}"/>' for name, value in tags.items())
        text += f'<way id="{k + 10}">{ends}{tags_text}</way>'
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">{text}</osm>'


MOTORWAY = osm(("motorway", "1 2"), ("motorway", "2 3"), ("motorway_link", "2 4"), ("residential", "4 5"))


def opendrive(kind: str = "driving", width: float = 3.5) -> str:
    lane = '<lane id="{}" type="{}" level="false"><width sOffset="0" a="{}" b="0" c="0" d="0"/></lane>'
    lanes = lane.format(-1, kind, width) + lane.format(-2, kind, width) + lane.format(-3, "shoulder", 2.5)
    return f"""<?xml version="1.0"?>
<OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1"/>
<road name="a" length="400" id="1" junction="-1"><planView>
<geometry s="0" x="0" y="0" hdg="0" length="300"><line/></geometry>
<geometry s="300" x="300" y="0" hdg="0" length="100"><arc curvature="0.002"/></geometry></planView>
<elevationProfile/><lateralProfile/><lanes><laneSection s="0">
<center><lane id="0" type="none" level="false"/></center><right>{lanes}</right>
</laneSection></lanes></road></OpenDRIVE>"""


@pytest.mark.parametrize("name", ["map.osm", "map.osm.gz", "map.xml", "map.osm.xml.gz"])
def test_openstreetmap_is_told_by_its_content(tmp_path, name):
    path = tmp_path / name
    data = MOTORWAY.encode()
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    network = read_map(path)
    assert network.name == "map"
    # 3 + 3 lanes, 4 beside the exit that netconvert guesses, and the ramp
    assert len([lane for lane in network.lanes if not lane.connector]) == 11
    assert network.warnings[0] == "1 of 4 roads are not freeway, left out (residential 1)"
    assert {round(lane.width, 2) for lane in network.lanes} == {3.66}  # the US default
    assert {round(lane.speed_limit, 1) for lane in network.lanes} >= {29.1, 17.9}
    assert network.geo is not None and "+proj=utm +zone=17" in network.geo.projection


def test_all_roads_of_an_extract(tmp_path):
    path = tmp_path / "map.osm"
    path.write_text(MOTORWAY)
    assert any(lane.speed_limit < 14 for lane in read_map(path, "all").lanes)


def test_an_extract_from_where_traffic_drives_on_the_left(tmp_path):
    path = tmp_path / "map.osm"
    path.write_text(MOTORWAY)
    assert read_map(path, left_hand=True).left_hand
    assert not read_map(path).left_hand


def test_opendrive(tmp_path):
    path = tmp_path / "road.xodr"
    path.write_text(opendrive())
    network = read_map(path)
    assert [lane.width for lane in network.lanes] == [3.5, 3.5]  # no shoulder
    assert network.lanes[0].length == pytest.approx(400, abs=2)
    assert "neither road classes nor speed limits" in network.warnings[0]


def test_a_sumo_network_by_any_name(tmp_path):
    path = SmallNet().edge("a", lanes_from(0, 100, 0)).write(tmp_path / "road.xml")
    assert read_map(path).name == "road"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("map.osm", osm(("residential", "1 2")), "no motorway or trunk road among 1 roads"),
        ("map.osm", osm(), "no motorway or trunk road among 0 roads"),
        ("map.osm", MOTORWAY[:600], "not well-formed XML"),
        ("map.osm", "<osm", "not well-formed XML"),
        ("map.osm", osm(("motorway", "1 77")), "netconvert refuses the map"),
        ("map.xodr", "<OpenDRIVE></OpenDRIVE>", "netconvert refuses the map"),
        ("map.xodr", opendrive("sidewalk"), "map.xodr: "),
        ("map.xodr", opendrive()[:300], "map.xodr: "),
        ("map.xml", "<routes/>", "root element is <routes>"),
        ("map.xml", "", "not well-formed XML"),
    ],
)
def test_bad_maps_are_refused_in_one_line(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(PhaseError) as caught:
        convert([path], tmp_path / "out")
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message
    assert not (tmp_path / "out").exists()


def test_a_truncated_archive(tmp_path):
    path = tmp_path / "map.osm.gz"
    path.write_bytes(gzip.compress(MOTORWAY.encode() * 50)[:-30])
    with pytest.raises(PhaseError, match="damaged gzip"):
        read_map(path)


def test_an_import_that_takes_too_long(tmp_path, monkeypatch):
    def hang(command, timeout, **_):
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(import_map.subprocess, "run", hang)
    path = tmp_path / "map.osm"
    path.write_text(MOTORWAY)
    with pytest.raises(PhaseError, match="did not finish"):
        read_map(path)
