"""Any map file -> `LaneNetwork`: SUMO networks directly, OpenStreetMap and OpenDRIVE through netconvert."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Literal

import sumo
import sumolib
from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.maps.freeway import FREEWAY_CLASSES
from phase_sumo.bridge.maps.net_xml import network_name, open_xml
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.errors import PhaseError
from phase_sumo.sim.lanes import LaneNetwork

TIMEOUT = 3600.0  # s for one import
START = 65536  # bytes in which the root element must appear
ROOT = re.compile(rb"<(osm|OpenDRIVE)[\s>]")
PATHS = ("footway", "path", "cycleway", "steps", "pedestrian", "bridleway", "corridor", "track")
# where the map gives none: 65 mph on freeways, 40 mph on ramps and lanes of 12 ft, as in the US
US_FREEWAY = """<types>
 <type id="highway.motorway" numLanes="3" speed="29.06" width="3.66" priority="14" oneway="true" {no}/>
 <type id="highway.motorway_link" numLanes="1" speed="17.88" width="3.66" priority="9" oneway="true" {no}/>
</types>""".format(
    no='disallow="rail rail_urban rail_electric rail_fast tram drone aircraft scooter container wheelchair '
    'subway cable_car ship pedestrian bicycle moped"'
)


def read_map(
    path: str | Path, keep: Literal["freeway", "all"] = "freeway", left_hand: bool = False
) -> LaneNetwork:
    """Read a SUMO network, an OpenStreetMap extract or an OpenDRIVE file, gzipped or not.

    The format is told from the content.

    Args:
        path: the file.
        keep: see `read_network`.
        left_hand: an OpenStreetMap extract is from where traffic drives on the left; the other formats
            say so themselves.

    Raises:
        PhaseError: the file is missing or damaged, netconvert refuses it, or it holds no lane to keep.
    """
    path = Path(path)
    kind = _format(path)
    if kind is None:
        return read_network(path, keep)
    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as temporary:
        folder = Path(temporary)
        source = folder / f"map.{kind}"
        with open_xml(path, "", "download or export it again") as packed, source.open("wb") as unpacked:
            shutil.copyfileobj(packed, unpacked)
        if kind == "osm":
            options, left_out = _osm_options(path, source, keep, left_hand)
        else:
            options, left_out = _opendrive_options(source), []
        target = folder / f"{network_name(path)}.net.xml"
        netconvert(path, [*options, "--output-file", str(target)])
        try:
            network = read_network(target, keep)
        except PhaseError as error:
            raise PhaseError(str(error).replace(str(target), str(path))) from None
    return replace(network, warnings=(*left_out, *network.warnings))


def _format(path: Path) -> str | None:
    """``"osm"``, ``"xodr"``, or None for everything else, which `read_network` takes or refuses."""
    with open_xml(path, "pass .net.xml, .osm or .xodr, gzipped or not", "") as file:
        found = ROOT.search(file.read(START))
    return None if found is None else {b"osm": "osm", b"OpenDRIVE": "xodr"}[found[1]]


def _osm_options(path: Path, source: Path, keep: str, left_hand: bool) -> tuple[list[str], list[str]]:
    ways = _osm_ways(path)
    wanted = {f"{name}{link}" for name in FREEWAY_CLASSES for link in ("", "_link")}
    if keep == "freeway" and not wanted & set(ways):
        raise PhaseError(
            f"{path}: no motorway or trunk road among {ways.total()} roads; keep all (--keep all)"
        )
    (source.parent / "us.typ.xml").write_text(US_FREEWAY, encoding="utf-8")
    standard = Path(sumo.SUMO_HOME) / "data" / "typemap" / "osmNetconvert.typ.xml"
    options = ["--osm-files", str(source), "--type-files", f"{standard},{source.parent / 'us.typ.xml'}"]
    options += ["--osm.lane-access", "--osm.turn-lanes", "--ramps.guess", "--geometry.remove"]
    options += ["--geometry.min-radius.fix", "--no-turnarounds", "--junctions.limit-turn-speed", "-1"]
    options += ["--lefthand"] if left_hand else []
    if keep == "all":
        return [*options, "--keep-edges.by-vclass", "passenger,truck"], []
    options += ["--keep-edges.by-type", ",".join(f"highway.{name}" for name in sorted(wanted))]
    others = Counter({name: count for name, count in ways.items() if name not in wanted})
    named = ", ".join(f"{name} {count}" for name, count in others.most_common())
    return options, [f"{others.total()} of {ways.total()} roads are not freeway, left out ({named})"] * bool(
        others
    )


def _osm_ways(path: Path) -> Counter[str]:
    """Number of roads of each class."""
    ways: Counter[str] = Counter()
    with open_xml(path, "", "download or export it again") as file:
        for _, element in etree.iterparse(file, tag=("node", "way", "relation"), huge_tree=True):
            if element.tag == "way":
                kinds = [tag.get("v", "") for tag in element.iterchildren("tag") if tag.get("k") == "highway"]
                ways.update(kind for kind in kinds if kind not in PATHS)
            element.clear()
            while element.getprevious() is not None:
                del element.getparent()[0]
    return ways


def _opendrive_options(source: Path) -> list[str]:
    options = ["--opendrive-files", str(source), "--opendrive.internal-shapes"]
    return [*options, "--opendrive.curve-resolution", "1", "--no-turnarounds"]


def netconvert(path: Path, options: list[str]) -> None:
    command = [sumolib.checkBinary("netconvert"), *options]
    environment = os.environ | {"SUMO_HOME": sumo.SUMO_HOME}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, errors="replace", timeout=TIMEOUT
        )
    except subprocess.TimeoutExpired:
        raise PhaseError(
            f"{path}: netconvert did not finish within {TIMEOUT:.0f} s; pass a smaller extract"
        ) from None
    except OSError as error:
        raise PhaseError(f"{path}: netconvert cannot be run ({error}); install eclipse-sumo") from error
    if done.returncode:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip().startswith("Error")]
        reason = " ".join(said)[:300].removeprefix("Error: ") or f"status {done.returncode}"
        raise PhaseError(f"{path}: netconvert refuses the map ({reason}); correct it or export it again")
