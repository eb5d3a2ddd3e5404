"""Route and additional files rewritten into a folder of ours: another car-following model, other outputs."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.errors import PhaseError

# The car-following models of SUMO that a comparison can name
MODELS = {
    "idm": "IDM", "krauss": "Krauss", "eidm": "EIDM", "idmm": "IDMM", "acc": "ACC", "cacc": "CACC",
    "w99": "W99", "wiedemann": "Wiedemann", "bkerner": "BKerner", "krauss-orig1": "KraussOrig1",
}  # fmt: skip
NOT_DRIVEN = ("pedestrian", "bicycle", "rail", "tram", "ship", "aircraft", "container", "subway", "cable_car")
OUTPUT_ATTRIBUTES = {
    **dict.fromkeys(
        [
            "inductionLoop",
            "e1Detector",
            "laneAreaDetector",
            "e2Detector",
            "entryExitDetector",
            "e3Detector",
            "instantInductionLoop",
            "edgeData",
            "laneData",
            "routeProbe",
            "vTypeProbe",
        ],
        "file",
    ),
    "timedEvent": "dest",
    "calibrator": "output",
}
INPUT_ATTRIBUTES = {
    "include": "href",
    "poly": "imgFile",
    "poi": "imgFile",
    "vType": "imgFile",
    "rerouter": "file",
}
NO_FILE = ("NUL", "/dev/null", "stdout", "stderr", "-", "")


@dataclass(frozen=True)
class Rewrite:
    """What to change: every motor vehicle's ``carFollowModel``, and the folder that outputs go to."""

    model: str | None = None
    output_dir: Path | None = None


def sumo_model(name: str) -> str:
    """SUMO's spelling of a car-following model, e.g. ``"idm"`` -> ``"IDM"``."""
    try:
        return MODELS[name.lower()]
    except KeyError:
        raise PhaseError(
            f"model {name!r} is not known; choose from phase, phase:0.3 (30 % PHASE), {', '.join(MODELS)}"
        ) from None


def rewrite_files(
    route_files: tuple[Path, ...], additional_files: tuple[Path, ...], work_dir: Path, wanted: Rewrite
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """The files to load instead; a file in which nothing changes is returned as it is."""
    folder = work_dir / "inputs"
    routes = tuple(_rewrite(p, folder, i, wanted, ("<vType",)) for i, p in enumerate(route_files))
    marks = ("<vType", *(f"<{tag}" for tag in OUTPUT_ATTRIBUTES)) if wanted.output_dir else ("<vType",)
    start = len(route_files)
    additional = tuple(_rewrite(p, folder, start + i, wanted, marks) for i, p in enumerate(additional_files))
    if wanted.model:
        defined = any(
            mentions(p, ('"DEFAULT_VEHTYPE"',)) and _defines_default(p) for p in (*routes, *additional)
        )
        if not defined:
            additional = (_default_types(folder, wanted.model), *additional)
    return routes, additional


def redirect(value: str, folder: Path) -> str:
    """An output file name moved into ``folder``; ``NUL`` and the like stay."""
    if value in NO_FILE or ":" in value.replace(":\\", ""):
        return value
    return str((folder / Path(value.replace("\\", "/")).name).resolve())


def empty_settings(folder: Path) -> Path:
    """An empty view settings file, for scenarios whose own is missing."""
    path = folder / "view.xml"
    path.write_text("<viewsettings/>\n")
    return path


def _rewrite(path: Path, folder: Path, number: int, wanted: Rewrite, marks: tuple[str, ...]) -> Path:
    if not (wanted.model or wanted.output_dir) or not mentions(path, marks):
        return path
    tree = _parse(path)
    changed = False
    for element in tree.iter():
        if not isinstance(element.tag, str):
            continue
        if wanted.model and element.tag == "vType":
            changed |= _set_model(element, wanted.model)
        attribute = OUTPUT_ATTRIBUTES.get(element.tag)
        if wanted.output_dir and attribute and element.get(attribute):
            element.set(attribute, redirect(element.get(attribute), wanted.output_dir))
            changed = True
    if not changed:
        return path
    _absolute_inputs(tree, path.parent)
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{number}_{path.name.removesuffix('.gz')}"
    tree.write(str(target), encoding="UTF-8", xml_declaration=True)
    return target


def _set_model(element: etree._Element, model: str) -> bool:
    if element.get("vClass", "passenger") in NOT_DRIVEN:
        return False
    element.set("carFollowModel", model)
    for child in list(element):  # the old way of naming a model
        if isinstance(child.tag, str) and child.tag.startswith("carFollowing-"):
            element.remove(child)
    return True


def _absolute_inputs(tree: etree._ElementTree, base: Path) -> None:
    for element in tree.iter(*INPUT_ATTRIBUTES):
        attribute = INPUT_ATTRIBUTES[element.tag]
        value = element.get(attribute)
        if value and value not in NO_FILE:
            element.set(attribute, str((base / value).resolve()))


def _default_types(folder: Path, model: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "default_types.add.xml"
    path.write_text(
        "<additional>\n"
        f'    <vType id="DEFAULT_VEHTYPE" vClass="passenger" carFollowModel="{model}"/>\n'
        "</additional>\n"
    )
    return path


def _defines_default(path: Path) -> bool:
    return any(e.get("id") == "DEFAULT_VEHTYPE" for e in _parse(path).iter("vType"))


def _parse(path: Path) -> etree._ElementTree:
    with _open(path) as file:
        return etree.parse(file, etree.XMLParser(huge_tree=True, remove_comments=True))


def mentions(path: Path, marks: tuple[str, ...]) -> bool:
    wanted = [m.encode() for m in marks]
    return any(mark in block for block in _blocks(path) for mark in wanted)


def _blocks(path: Path, size: int = 1 << 20) -> Iterator[bytes]:
    tail = b""
    with _open(path) as file:
        while block := file.read(size):
            yield tail + block
            tail = block[-64:]


@contextmanager
def _open(path: Path) -> Iterator[BinaryIO | gzip.GzipFile]:
    """The bytes of a file that may be gzipped; whoever reads them as XML need not look for damage."""
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as file:
            yield file
    except (etree.XMLSyntaxError, OSError, EOFError, zlib.error) as error:
        raise PhaseError(f"{path}: not readable as XML ({error}); write the file again") from None
