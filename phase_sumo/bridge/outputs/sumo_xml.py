"""SUMO's output files as XML: read, put in order, written back whole or not at all."""

from __future__ import annotations

import gzip
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lxml import etree  # type: ignore[attr-defined]  # has no stubs


def read_output(path: Path) -> Any:
    """The tree of an output file, compressed or not.

    Raises:
        OSError, etree.XMLSyntaxError: there is no such file, or it holds no XML.
    """
    content = path.read_bytes()
    return etree.ElementTree(
        etree.fromstring(gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content)
    )


def write_output(path: Path, tree: Any) -> None:
    """Replace the file, in the compression that its name says."""
    content = etree.tostring(tree, xml_declaration=True, encoding="UTF-8") + b"\n"
    part = path.with_name(path.name + ".part")
    part.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
    part.replace(path)


def merge_by_time(root: Any, fresh: Iterable[Any]) -> None:
    """Put elements among those of the root, by their attribute ``time``."""
    rows = sorted([*root, *fresh], key=lambda element: float(element.get("time")))
    root[:] = rows
    root.text = "\n    " if rows else "\n"
    for row in rows:
        row.tail = "\n    "
    if rows:
        rows[-1].tail = "\n"
