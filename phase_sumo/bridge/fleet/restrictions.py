"""Limits of vehicle classes that additional files give roads by their type, beside the network's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.maps.network_facts import network_facts
from phase_sumo.bridge.sumo.demand import mentions, open_input


def restrictions(api: Any) -> Mapping[str, Mapping[str, float]]:
    """Edge -> vehicle class -> m/s, of a running simulation's ``<type><restriction/></type>`` elements."""
    option = api.simulation.getOption
    by_type: dict[str, dict[str, float]] = {}
    for path in map(Path, filter(None, option("additional-files").split(","))):
        if mentions(path, ("<restriction",)):
            _read(path, by_type)
    kinds = network_facts(Path(option("net-file"))).kinds if by_type else {}
    return {edge: by_type[kind] for edge, kind in kinds.items() if kind in by_type}


def _read(path: Path, by_type: dict[str, dict[str, float]]) -> None:
    with open_input(path) as file:
        for _, element in etree.iterparse(file, tag="type", huge_tree=True):
            own = {
                r.get("vClass", ""): float(r.get("speed", "inf")) for r in element.iterchildren("restriction")
            }
            by_type.setdefault(element.get("id", ""), {}).update(own)
