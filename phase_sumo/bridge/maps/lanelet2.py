"""Maps of recorded traffic in the coordinates of the tracks: Lanelet2 ``.osm``, or any other map file."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from lxml import etree  # type: ignore[attr-defined]  # has no stubs
from pyproj import Proj

from phase_sumo.arrays import FloatArray
from phase_sumo.bridge.maps.import_map import read_map
from phase_sumo.bridge.maps.net_xml import network_name, open_xml
from phase_sumo.errors import PhaseError
from phase_sumo.logs.recorded_roads import Strip, strip_road
from phase_sumo.sim.lanes import LaneNetwork

REMEDY = "download the map again"
ROADS = (
    None,
    "road",
    "highway",
    "exit",
    "merge",
)  # subtypes of lanelets for cars; others are shoulders, paths
CROSSABLE = ("dashed", "dashed_dashed")  # subtypes of markings that may be crossed from both sides
LINES = ("line_thin", "line_thick", "virtual")  # types of bounds that are no obstacle


def read_road(path: Path, origin: tuple[float, float] | None) -> LaneNetwork:
    """The road of a log.

    Args:
        path: a Lanelet2 map, or what `read_map` takes.
        origin: UTM east and north in m of the point that becomes x = y = 0 (exiD's ``xUtmOrigin`` and
            ``yUtmOrigin``); without it a Lanelet2 map stays in UTM coordinates. Other maps have the
            coordinates that are in their file.

    Raises:
        PhaseError: the file is damaged or has no lanes.
    """
    if is_lanelet2(path):
        return read_lanelet2(path, origin or (0.0, 0.0))
    network = read_map(path, "all")
    if path.name.removesuffix(".gz").endswith(".xodr") and network.geo is not None:
        # netconvert moves a map to positive coordinates
        x, y = (-float(v) for v in network.geo.net_offset.split(",")[:2])
        return replace(network.moved(x, y), geo=None, origin=(0.0, 0.0))
    return network


def is_lanelet2(path: Path) -> bool:
    """It is an ``.osm`` file with relations of type lanelet."""
    if not path.name.removesuffix(".gz").endswith(".osm"):
        return False
    with open_xml(path, "pass a map", REMEDY) as file:
        return any(
            element.get("k") == "type" and element.get("v") == "lanelet"
            for _, element in etree.iterparse(file, tag="tag", huge_tree=True, resolve_entities=False)
        )


def read_lanelet2(path: Path, origin: tuple[float, float]) -> LaneNetwork:
    """Lanelets as lanes.

    Bounds that two lanelets share lie between lanes abreast; a lanelet follows another one that ends on the
    two points where it begins.
    """
    with open_xml(path, "pass a Lanelet2 map", REMEDY) as file:
        root = etree.parse(file).getroot()
    nodes = _nodes(root, path, origin)
    ways = {way.get("id"): _Way.of(way) for way in root.iterchildren("way")}
    lanelets = []
    for relation in root.iterchildren("relation"):
        tags = _tags(relation)
        if tags.get("type") == "lanelet" and tags.get("subtype") in ROADS:
            lanelets.append(_lanelet(relation, ways, nodes, path))
    if not lanelets:
        raise PhaseError(f"{path}: no lanelet for cars in it; pass the map of the road")
    begins: dict[tuple[str, str], list[int]] = {}
    of_left: dict[str, list[int]] = {}
    of_right: dict[str, list[int]] = {}
    for i, lanelet in enumerate(lanelets):
        begins.setdefault((lanelet.left[0], lanelet.right[0]), []).append(i)
        for bounds, table in ((lanelet.left_ways, of_left), (lanelet.right_ways, of_right)):
            for way in bounds:
                table.setdefault(way, []).append(i)
    strips = [
        Strip(
            id=lanelet.id,
            left=np.array([nodes[n] for n in lanelet.left]),
            right=np.array([nodes[n] for n in lanelet.right]),
            left_of=_beside(lanelet.left_ways, of_right),
            right_of=_beside(lanelet.right_ways, of_left),
            solid_left=lanelet.solid_left,
            solid_right=lanelet.solid_right,
            successors=tuple(begins.get((lanelet.left[-1], lanelet.right[-1]), ())),
        )
        for lanelet in lanelets
    ]
    return strip_road(network_name(path), strips)


@dataclass(frozen=True)
class _Way:
    """A bound: its nodes, its type (``line_thin`` ...) and its subtype (``dashed`` ...)."""

    nodes: tuple[str, ...]
    kind: str
    subtype: str

    @staticmethod
    def of(way: etree._Element) -> _Way:
        tags = _tags(way)
        nodes = tuple(child.get("ref", "") for child in way.iterchildren("nd"))
        return _Way(nodes, tags.get("type", ""), tags.get("subtype", ""))


@dataclass(frozen=True)
class _Lanelet:
    """Nodes of the bounds in driving direction, the ways they consist of, and whether these are solid."""

    id: str
    left: tuple[str, ...]
    right: tuple[str, ...]
    left_ways: tuple[str, ...]
    right_ways: tuple[str, ...]
    solid_left: bool
    solid_right: bool


def _tags(element: etree._Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iterchildren("tag")}


def _nodes(root: etree._Element, path: Path, origin: tuple[float, float]) -> dict[str, FloatArray]:
    """Local coordinates of all nodes, through the UTM zone of the map's middle."""
    found = list(root.iterchildren("node"))
    try:
        lon = np.array([float(node.get("lon")) for node in found])
        lat = np.array([float(node.get("lat")) for node in found])
    except (TypeError, ValueError):
        raise PhaseError(f"{path}: a node without lon and lat in degrees; {REMEDY}") from None
    if not len(found):
        raise PhaseError(f"{path}: no node in it; {REMEDY}")
    zone = int((np.median(lon) + 180.0) // 6.0) + 1
    east, north = Proj(proj="utm", zone=zone, ellps="WGS84", south=bool(np.median(lat) < 0))(lon, lat)
    xy = np.stack((np.asarray(east) - origin[0], np.asarray(north) - origin[1]), -1)
    return {node.get("id", ""): at for node, at in zip(found, xy, strict=True)}


def _lanelet(
    relation: etree._Element, ways: dict[str, _Way], nodes: dict[str, FloatArray], path: Path
) -> _Lanelet:
    name = relation.get("id", "")
    members: dict[str, list[str]] = {"left": [], "right": []}
    for member in relation.iterchildren("member"):
        if member.get("role") in members and member.get("type") == "way":
            members[member.get("role")].append(member.get("ref", ""))
    try:
        left, right = (_joined([ways[way].nodes for way in members[side]]) for side in ("left", "right"))
        ends = np.array([nodes[n] for n in (left[0], left[-1], right[0], right[-1])])
    except (KeyError, IndexError):
        raise PhaseError(f"{path}: lanelet {name} lacks a bound or a point of one; {REMEDY}") from None
    # bounds may be drawn in either direction: side by side first, then so that left is left
    if np.hypot(*(ends[0] - ends[2])) + np.hypot(*(ends[1] - ends[3])) > np.hypot(
        *(ends[0] - ends[3])
    ) + np.hypot(*(ends[1] - ends[2])):
        right = right[::-1]
    a, b = (np.array([nodes[n] for n in line]) for line in (left, right))
    along, across = a[-1] - a[0] + b[-1] - b[0], a.mean(0) - b.mean(0)
    if along[0] * across[1] - along[1] * across[0] < 0:
        left, right = left[::-1], right[::-1]
    return _Lanelet(
        name,
        left,
        right,
        tuple(members["left"]),
        tuple(members["right"]),
        any(_solid(ways[way], left, "right") for way in members["left"]),
        any(_solid(ways[way], right, "left") for way in members["right"]),
    )


def _joined(pieces: list[tuple[str, ...]]) -> tuple[str, ...]:
    """One line of pieces that may each be drawn in either direction."""
    line = pieces[0]
    for piece in pieces[1:]:
        if line[-1] not in (piece[0], piece[-1]):
            line = line[::-1]
        line += piece[1:] if piece[0] == line[-1] else piece[-2::-1]
    return line


def _solid(way: _Way, bound: tuple[str, ...], side: str) -> bool:
    """A bound may not be crossed by who drives on that ``side`` of it.

    ``solid_dashed`` is solid on the left and dashed on the right of the way as it is drawn.
    """
    if way.kind == "virtual" or way.subtype in CROSSABLE:
        return False
    if way.kind in LINES and way.subtype in ("solid_dashed", "dashed_solid"):
        drawn_along = bound.index(way.nodes[0]) < bound.index(way.nodes[-1])
        on_left = (side == "left") == drawn_along
        return way.subtype.split("_")[0 if on_left else 1] == "solid"
    return True


def _beside(ways: tuple[str, ...], of_others: dict[str, list[int]]) -> int:
    """The lanelet that shares most of the ways, or -1."""
    shared = Counter(i for way in ways for i in of_others.get(way, ()))
    return shared.most_common(1)[0][0] if shared else -1
