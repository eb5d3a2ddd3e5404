"""SUMO's ``.net.xml`` as plain records; nothing here interprets the road.

Geometry stays text until it is asked for: of a city only the freeway's is ever needed.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lxml import etree  # type: ignore[attr-defined]  # has no stubs
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError
from phase_sumo.sim.lanes import GeoReference

DEFAULT_WIDTH = 3.2  # m, SUMO's
FARTHEST = 1.0e7  # m from the origin: larger coordinates are damage, or degrees taken for metres
LONGEST = 1.0e5  # m of a lane
WIDEST = 100.0  # m of a lane, also of one that is not for cars
FASTEST = 200.0  # m/s, a speed limit
ROADS = (None, "normal", "internal", "connector")  # functions of edges, the others are for pedestrians


class XmlLane(NamedTuple):
    """One ``<lane>`` with the attributes of its edge that matter.

    ``change_up`` and ``change_down`` tell whether cars may change to the next higher or lower lane index
    (SUMO's changeLeft and changeRight, which count indices also where traffic drives on the left).
    """

    id: str
    edge: str
    number: int  # within its edge, 0 is the rightmost (the leftmost where traffic drives on the left)
    shape: str  # "x,y x,y,z ..." in m
    width: float  # m
    speed: float  # m/s
    length: float  # m
    car: bool
    truck: bool
    allow: str | None  # vehicle classes as written
    disallow: str | None
    change_up: bool
    change_down: bool
    kind: str  # the edge's type, "" where it has none
    internal: bool
    start_node: str
    end_node: str


class XmlConnection(NamedTuple):
    """One ``<connection>`` between two lane ids; ``via`` is the first internal lane or None.

    ``turn`` is SUMO's direction: "s" straight, "l" and "r" turns, "t" a turnaround ...
    """

    source: str
    target: str
    via: str | None
    turn: str


@dataclass(frozen=True)
class XmlNet:
    """A network file.

    Attributes:
        class_speeds: edge type -> vehicle class -> its own speed limit in m/s.
    """

    path: Path
    lanes: dict[str, XmlLane]
    connections: list[XmlConnection]
    left_hand: bool
    geo: GeoReference | None
    class_speeds: dict[str, dict[str, float]] = field(default_factory=dict)

    def points(self, lane: XmlLane) -> NDArray[np.float64]:
        """[P, 2] centre line in m; heights are dropped, also where only some points have one."""
        try:
            pairs = [point.split(",", 2)[:2] for point in lane.shape.split()]
            points = np.array([(float(x), float(y)) for x, y in pairs])
            if not len(points) or not (np.abs(points) < FARTHEST).all():
                raise ValueError(lane.shape)
            if np.hypot(*np.diff(points, axis=0).T).sum() > LONGEST:
                raise ValueError(lane.shape)
        except ValueError as error:
            raise PhaseError(
                f"{self.path}: lane {lane.id!r} has the shape {lane.shape[:40]!r}, expected 'x,y x,y' "
                f"of at most {LONGEST:g} m; write the network again with netconvert"
            ) from error
        return points


def network_name(path: Path) -> str:
    """The file name without ``.net.xml`` and the like: ``a10.v2.net.xml.gz`` -> ``a10.v2``."""
    name = path.name
    for ending in (".gz", ".xml", ".net", ".osm", ".xodr"):
        name = name.removesuffix(ending)
    return name or path.name


def parse_net(path: Path) -> XmlNet:
    """Read a network file, gzipped or not.

    Raises:
        PhaseError: it is missing, damaged, no network, or names lanes that it does not hold.
    """
    lanes: dict[str, XmlLane] = {}
    by_edge: dict[tuple[str, int], str] = {}
    rows: list[tuple[str, int, str, int, str | None, str]] = []
    others: set[str] = set()
    class_speeds: dict[str, dict[str, float]] = {}
    geo, left_hand = None, False
    for element in _elements(path):
        if element.tag == "edge":
            if element.get("function") not in ROADS:
                others.add(_text(element, "id", path))
                continue
            for lane in _lanes(element, path):
                if lane.id in lanes or (lane.edge, lane.number) in by_edge:
                    raise PhaseError(
                        f"{path}: lane {lane.id!r} is there twice; write the network again with netconvert"
                    )
                lanes[lane.id] = lane
                by_edge[lane.edge, lane.number] = lane.id
        elif element.tag == "connection":
            rows.append(_connection(element, path))
        elif element.tag == "type":
            limits = {_text(r, "vClass", path): _number(r, "speed", path, FASTEST) for r in element}
            class_speeds[_text(element, "id", path)] = limits
        elif element.tag == "location":
            geo = GeoReference(element.get("projParameter", ""), element.get("netOffset", ""))
        else:
            left_hand = element.get("lefthand") in ("1", "true")
    return XmlNet(path, lanes, _connections(rows, lanes, by_edge, others, path), left_hand, geo, class_speeds)


def _elements(path: Path) -> Iterator[etree._Element]:
    """Location, edges and connections, each freed when done with, and at last the root element."""
    with open_xml(path, "pass a SUMO .net.xml or .net.xml.gz", "write it again with netconvert") as file:
        wanted = ("location", "type", "edge", "connection")
        steps = etree.iterparse(file, tag=wanted, huge_tree=True, resolve_entities=False)
        for _, element in steps:
            root = element.getparent()
            if root is None or root.tag != "net" or root.getparent() is not None:
                break
            yield element
            element.clear()
            while element.getprevious() is not None:
                del root[0]
        else:
            element = steps.root
        root = element.getroottree().getroot()
        if root.tag != "net":
            raise PhaseError(
                f"{path}: root element is <{root.tag}>, a SUMO network has <net>; convert it with netconvert"
            )
        yield root


@contextmanager
def open_xml(path: Path, expected: str, remedy: str) -> Iterator[gzip.GzipFile]:
    """The bytes of an XML file, unpacked; what goes wrong while reading becomes a `PhaseError`."""
    if not path.is_file():
        raise PhaseError(f"{path}: no such network file; {expected}")
    try:
        with path.open("rb") as start:
            packed = start.read(2) == b"\x1f\x8b"
        with gzip.open(path) if packed else path.open("rb") as file:
            yield file  # type: ignore[misc]
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise PhaseError(f"{path}: damaged gzip file ({error}); copy or compress it again") from error
    except etree.XMLSyntaxError as error:
        reason = " ".join(str(error).split())
        raise PhaseError(f"{path}: not well-formed XML ({reason}); {remedy}") from error
    except OSError as error:
        raise PhaseError(f"{path}: cannot be read ({error.strerror or error})") from error


def _lanes(edge: etree._Element, path: Path) -> Iterator[XmlLane]:
    name, function = _text(edge, "id", path), edge.get("function")
    for number, lane in enumerate(edge.iterchildren("lane")):  # SUMO, too, counts and ignores the attribute
        get = lane.get
        allow, disallow = get("allow"), get("disallow")
        yield XmlLane(
            id=_text(lane, "id", path),
            edge=name,
            number=number,
            shape=get("shape", ""),
            width=_number(lane, "width", path, WIDEST, DEFAULT_WIDTH),
            speed=_number(lane, "speed", path, FASTEST),
            length=_number(lane, "length", path, LONGEST),
            car=allows(allow, disallow, "passenger"),
            truck=allows(allow, disallow, "truck") and allows(allow, disallow, "trailer"),
            allow=allow,
            disallow=disallow,
            change_up=allows(get("changeLeft"), None, "passenger"),
            change_down=allows(get("changeRight"), None, "passenger"),
            kind=edge.get("type", ""),
            internal=function == "internal",
            start_node=edge.get("from", ""),
            end_node=edge.get("to", ""),
        )


def allows(allow: str | None, disallow: str | None, vehicle_class: str) -> bool:
    """SUMO's reading: an empty list counts as none given."""
    if allow:
        return _names(allow, vehicle_class)
    return not disallow or not _names(disallow, vehicle_class)


def _names(classes: str, vehicle_class: str) -> bool:
    words = classes.split()
    return vehicle_class in words or "all" in words


def _connection(row: etree._Element, path: Path) -> tuple[str, int, str, int, str | None, str]:
    return (
        _text(row, "from", path),
        _integer(row, "fromLane", path),
        _text(row, "to", path),
        _integer(row, "toLane", path),
        row.get("via") or None,
        row.get("dir", "s"),
    )


def _connections(
    rows: list[tuple[str, int, str, int, str | None, str]],
    lanes: dict[str, XmlLane],
    by_edge: dict[tuple[str, int], str],
    others: set[str],
    path: Path,
) -> list[XmlConnection]:
    """Connections between lanes of roads; SUMO refuses a network that connects lanes it does not hold."""
    connections = []
    for source_edge, source_lane, target_edge, target_lane, via, turn in rows:
        if source_edge in others or target_edge in others:
            continue
        source = by_edge.get((source_edge, source_lane))
        target = by_edge.get((target_edge, target_lane))
        if source is None or target is None or (via is not None and via not in lanes):
            missing = (
                f"lane {source_lane} of edge {source_edge!r}"
                if source is None
                else f"lane {target_lane} of edge {target_edge!r}"
                if target is None
                else f"the internal lane {via!r}"
            )
            raise PhaseError(
                f"{path}: the connection from {source_edge!r} to {target_edge!r} names {missing}, "
                "which is not in the file; write the network again with netconvert"
            )
        connections.append(XmlConnection(source, target, via, turn))
    return connections


def _text(element: etree._Element, name: str, path: Path) -> str:
    text = element.get(name)
    if not text:
        raise PhaseError(
            f"{path}: line {element.sourceline}: <{element.tag}> {element.get('id', '')!r} has no {name}; "
            "write the network again with netconvert"
        )
    return text


def _number(
    element: etree._Element, name: str, path: Path, most: float, default: float | None = None
) -> float:
    """A number in 0 <= value < ``most``."""
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not 0.0 <= value < most:
        raise PhaseError(
            f"{path}: <{element.tag}> {element.get('id', '')!r} has {name}={text!r}, expected a number "
            f"between 0 and {most:g}; write the network again with netconvert"
        )
    return value


def _integer(element: etree._Element, name: str, path: Path) -> int:
    text = element.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 6):
        raise PhaseError(
            f"{path}: <{element.tag}> {element.get('id', '')!r} has {name}={element.get(name)!r}, "
            "expected a whole number; write the network again with netconvert"
        )
    return int(text)
