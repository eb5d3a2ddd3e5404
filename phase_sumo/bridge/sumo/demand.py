"""Route and additional files rewritten into a folder of ours: another car-following model, other outputs."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.sumo.file_names import OutputFolder, writes_file
from phase_sumo.errors import PhaseError, nearest

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
    "variableSpeedSign": "file",
}
OUTPUT_KEY = re.compile(r"device\.\w+\.(file|output)")  # parameters of vehicles and vTypes
BUILT_IN = {"DEFAULT_VEHTYPE": "passenger", "DEFAULT_TAXITYPE": "taxi"}  # motor vehicles, with their vClass


def sumo_model(name: str) -> str:
    """SUMO's spelling of a car-following model, e.g. ``"idm"`` -> ``"IDM"``."""
    try:
        return MODELS[name.lower()]
    except KeyError:
        raise PhaseError(
            f"model {name!r} is not known{nearest(name, MODELS)}; choose from phase, phase:0.3 (30 % PHASE), "
            f"{', '.join(MODELS)}"
        ) from None


class InputFiles:
    """Input files as a run loads them, those that they include among them: another car-following model for
    every motor vehicle's type, outputs in another folder. A file in which nothing changes is used as it is.
    """

    def __init__(self, folder: Path, model: str | None = None, outputs: OutputFolder | None = None) -> None:
        """``folder`` holds what is rewritten; ``model`` is SUMO's name of one."""
        self._folder, self._model, self._outputs = folder, model, outputs
        marks = ["<include"] + ["<vType"] * bool(model)
        if outputs:
            marks += ["device.", *(f"<{tag}" for tag in OUTPUT_ATTRIBUTES)]
        self._marks = tuple(marks)
        self._files: dict[Path, Path] = {}
        self._defined: set[str] = set()  # of the built-in types

    def rewritten(self, paths: tuple[Path, ...]) -> tuple[Path, ...]:
        """The files to load instead."""
        return tuple(self._rewrite(path) for path in paths)

    def with_types(self, additional: tuple[Path, ...]) -> tuple[Path, ...]:
        """Additional files, with SUMO's built-in types where no file read so far defines them."""
        files = self.rewritten(additional)
        missing = {name: vclass for name, vclass in BUILT_IN.items() if name not in self._defined}
        return (self._built_in(missing), *files) if self._model and missing else files

    def _rewrite(self, path: Path) -> Path:
        known = path.resolve()
        if known not in self._files:
            self._files[known] = path  # also of a file that includes itself
            if (self._model or self._outputs) and mentions(path, self._marks):
                self._files[known] = self._copy(path)
        return self._files[known]

    def _copy(self, path: Path) -> Path:
        tree = _parse(path)
        changes = [self._change(element, path) for element in tree.iter() if isinstance(element.tag, str)]
        if not any(changes):
            return path
        _absolute_inputs(tree, path.parent)
        self._folder.mkdir(parents=True, exist_ok=True)
        target = self._folder / f"{len(self._files)}_{path.name.removesuffix('.gz')}"
        tree.write(str(target), encoding="UTF-8", xml_declaration=True)
        return target

    def _change(self, element: etree._Element, path: Path) -> bool:
        """Change one element of a file; whether that was needed."""
        if element.tag == "include" and element.get("href"):
            included = (path.parent / element.get("href")).resolve()
            new = self._rewrite(included) if included.is_file() else included
            element.set("href", str(new))
            return new != included
        if element.tag == "vType" and self._model:
            self._defined.add(element.get("id", ""))
            return _set_model(element, self._model)
        if not self._outputs:
            return False
        attribute = OUTPUT_ATTRIBUTES.get(element.tag)
        if element.tag == "param" and OUTPUT_KEY.fullmatch(element.get("key", "")):
            attribute = "value"
        value = element.get(attribute) if attribute else None
        if not value:
            return False
        element.set(attribute, self._outputs.place(value, path.parent))
        return True

    def _built_in(self, missing: dict[str, str]) -> Path:
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / "built_in_types.add.xml"
        rows = [
            f'    <vType id="{name}" vClass="{vclass}" carFollowModel="{self._model}"/>'
            for name, vclass in missing.items()
        ]
        path.write_text("\n".join(["<additional>", *rows, "</additional>", ""]), encoding="utf-8")
        return path


def empty_settings(folder: Path) -> Path:
    """An empty view settings file, for scenarios whose own is missing."""
    path = folder / "view.xml"
    path.write_text("<viewsettings/>\n", encoding="utf-8")
    return path


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
        if value and writes_file(value):
            element.set(attribute, str((base / value).resolve()))


def _parse(path: Path) -> etree._ElementTree:
    with open_input(path) as file:
        return etree.parse(file, etree.XMLParser(huge_tree=True, remove_comments=True))


def mentions(path: Path, marks: tuple[str, ...]) -> bool:
    wanted = [m.encode() for m in marks]
    return any(mark in block for block in _blocks(path) for mark in wanted)


def _blocks(path: Path, size: int = 1 << 20) -> Iterator[bytes]:
    tail = b""
    with open_input(path) as file:
        while block := file.read(size):
            yield tail + block
            tail = block[-64:]


@contextmanager
def open_input(path: Path) -> Iterator[BinaryIO | gzip.GzipFile]:
    """The bytes of a file that may be gzipped; whoever reads them as XML need not look for damage."""
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as file:
            yield file
    except (etree.XMLSyntaxError, OSError, EOFError, zlib.error) as error:
        raise PhaseError(f"{path}: not readable as XML ({error}); write the file again") from None
