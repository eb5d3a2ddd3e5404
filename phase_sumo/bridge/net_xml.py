"""SUMO's ``.net.xml`` as plain records; nothing here interprets the road."""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lxml import etree  # type: ignore[attr-defined]  # has no stubs
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError

DEFAULT_WIDTH = 3.2  # m, SUMO's


@dataclass(frozen=True)
class XmlLane:
    """One ``<lane>`` with the attributes of its edge that matter.

    ``change_up`` and ``change_down`` tell whether cars may change to the next higher or lower lane index
    (SUMO's changeLeft and changeRight, which count indices also where traffic drives on the left).
    """

    id: str
    edge: str
    index: int
    points: NDArray[np.float64]  # [P, 2] m
    width: float  # m
    speed: float  # m/s
    length: float  # m
    car: bool
    truck: bool
    change_up: bool
    change_down: bool
    kind: str  # the edge's type, "" where it has none
    internal: bool
    start_node: str
    end_node: str


@dataclass(frozen=True)
class XmlConnection:
    """One ``<connection>`` between two lane ids; ``via`` is the first internal lane or None."""

    source: str
    target: str
    via: str | None


@dataclass(frozen=True)
class XmlNet:
    lanes: dict[str, XmlLane]
    connections: list[XmlConnection]
    left_hand: bool


def network_name(path: Path) -> str:
    """The file name without ``.net.xml`` and the like: ``a10.v2.net.xml.gz`` -> ``a10.v2``."""
    name = path.name
    for ending in (".gz", ".xml", ".net"):
        name = name.removesuffix(ending)
    return name or path.name


def parse_net(path: Path) -> XmlNet:
    """Read a network file, gzipped or not."""
    root = _root(path)
    lanes: dict[str, XmlLane] = {}
    for edge in root.iterfind("edge"):
        if edge.get("function") not in (None, "normal", "internal", "connector"):
            continue  # crossings and walking areas
        for lane in edge.iterfind("lane"):
            record = _lane(edge, lane, path)
            lanes[record.id] = record
    by_edge = {(lane.edge, lane.index): lane.id for lane in lanes.values()}
    connections = []
    for row in root.iterfind("connection"):
        source = by_edge.get((row.get("from"), _integer(row, "fromLane", path)))
        target = by_edge.get((row.get("to"), _integer(row, "toLane", path)))
        if source is not None and target is not None:
            connections.append(XmlConnection(source, target, row.get("via")))
    return XmlNet(lanes, connections, root.get("lefthand") in ("1", "true"))


def _root(path: Path) -> etree._Element:
    if not path.is_file():
        raise PhaseError(f"{path}: no such network file; pass a SUMO .net.xml or .net.xml.gz")
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
        root = etree.fromstring(data, etree.XMLParser(huge_tree=True, resolve_entities=False))
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise PhaseError(f"{path}: damaged gzip file ({error}); copy or compress it again") from error
    except etree.XMLSyntaxError as error:
        raise PhaseError(f"{path}: not well-formed XML ({error}); write it again with netconvert") from error
    except OSError as error:
        raise PhaseError(f"{path}: cannot be read ({error.strerror or error})") from error
    if root.tag != "net":
        raise PhaseError(
            f"{path}: root element is <{root.tag}>, a SUMO network has <net>; convert it with netconvert"
        )
    return root


def _lane(edge: etree._Element, lane: etree._Element, path: Path) -> XmlLane:
    change_up, change_down = lane.get("changeLeft"), lane.get("changeRight")
    return XmlLane(
        id=lane.get("id", ""),
        edge=edge.get("id", ""),
        index=_integer(lane, "index", path),
        points=_shape(lane, path),
        width=_number(lane, "width", path, DEFAULT_WIDTH),
        speed=_number(lane, "speed", path),
        length=_number(lane, "length", path),
        car=_allows(lane, "passenger"),
        truck=_allows(lane, "truck") and _allows(lane, "trailer"),
        change_up=change_up is None or _names(change_up, "passenger"),
        change_down=change_down is None or _names(change_down, "passenger"),
        kind=edge.get("type", ""),
        internal=edge.get("function") == "internal",
        start_node=edge.get("from", ""),
        end_node=edge.get("to", ""),
    )


def _names(classes: str, vehicle_class: str) -> bool:
    words = classes.split()
    return vehicle_class in words or "all" in words


def _allows(lane: etree._Element, vehicle_class: str) -> bool:
    allow, disallow = lane.get("allow"), lane.get("disallow")
    if allow is not None:
        return _names(allow, vehicle_class)
    return disallow is None or not _names(disallow, vehicle_class)


def _shape(lane: etree._Element, path: Path) -> NDArray[np.float64]:
    """[P, 2] points; heights are dropped, also where only some points have one."""
    text = lane.get("shape", "")
    try:
        points = np.array([[float(v) for v in point.split(",")[:2]] for point in text.split()])
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise ValueError(text)
    except ValueError as error:
        raise PhaseError(
            f"{path}: lane {lane.get('id')!r} has the shape {text[:40]!r}, expected 'x,y x,y'; "
            "write the network again with netconvert"
        ) from error
    return points


def _number(element: etree._Element, name: str, path: Path, default: float | None = None) -> float:
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
        if not np.isfinite(value):
            raise ValueError(text)
    except ValueError as error:
        raise PhaseError(
            f"{path}: <{element.tag}> {element.get('id', '')!r} has {name}={text!r}, expected a number; "
            "write the network again with netconvert"
        ) from error
    return value


def _integer(element: etree._Element, name: str, path: Path) -> int:
    return int(_number(element, name, path))
