"""What the demand and additional files of a scenario hold, without running it."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.sumo.demand import BUILT_IN, open_input

VEHICLES = ("vehicle", "trip", "flow")
PEOPLE = ("person", "personFlow", "container", "containerFlow")
STOPPING_PLACES = ("busStop", "trainStop", "parkingArea", "chargingStation", "containerStop")
EVENTS = ("closingLaneReroute", "closingReroute", "destProbReroute", "routeProbReroute", "parkingAreaReroute")
DEFAULT_LENGTH = {"truck": 7.1, "trailer": 16.5, "bus": 12.0, "coach": 14.0}  # m, SUMO's by vehicle class


@dataclass
class VType:
    """What a vType says of itself.

    Attributes:
        vclass, length: SUMO's vehicle class, and m.
        params: its generic parameters.
    """

    vclass: str = "passenger"
    length: float = 5.0
    params: dict[str, str] = field(default_factory=dict)


@dataclass
class DemandSurvey:
    """Counts over all files.

    Attributes:
        types: vType id -> what it says.
        mixes: id of a vTypeDistribution -> share of each of its vTypes.
        vehicles: vType or mix -> vehicles until the end; of flows about as many as they will bring.
        ids: of vehicles and flows.
        people: persons and containers, flows of them counted once.
        params: (who, key, value) of every generic parameter of a vehicle or vType.
        stops: (owner, edge) of every stop of a vehicle, its flow counted once.
        rerouters: edges of each.
        events: kind of what rerouters do -> how often; with the edges that closings name.
        closed: edges and edges of lanes that rerouters close.
        calibrators, speed_signs: their edges.
        open_ended: vehicles may come that no file names (calibrators, a loaded state).
    """

    types: dict[str, VType] = field(default_factory=dict)
    mixes: dict[str, dict[str, float]] = field(default_factory=dict)
    vehicles: Counter[str] = field(default_factory=Counter)
    ids: set[str] = field(default_factory=set)
    people: int = 0
    params: list[tuple[str, str, str]] = field(default_factory=list)
    stops: list[tuple[str, str]] = field(default_factory=list)
    rerouters: list[tuple[str, ...]] = field(default_factory=list)
    events: Counter[str] = field(default_factory=Counter)
    closed: set[str] = field(default_factory=set)
    calibrators: list[str] = field(default_factory=list)
    speed_signs: list[str] = field(default_factory=list)
    open_ended: bool = False

    def by_class(self) -> Counter[tuple[str, str]]:
        """(vType, vehicle class) -> vehicles, those of mixes shared out."""
        found: Counter[tuple[str, str]] = Counter()
        for name, count in self.vehicles.items():
            mix = self.mixes.get(name, {name: 1.0})
            total = sum(mix.values()) or 1.0
            for kind, share in mix.items():
                found[kind, self.type(kind).vclass] += round(count * share / total)
        return found

    def type(self, name: str) -> VType:
        """A vType, SUMO's built-in ones among them."""
        return self.types.get(name) or VType(BUILT_IN.get(name, "passenger"))

    def knows(self, vehicle: str) -> bool:
        """Whether a file names the vehicle, or the flow that it is of."""
        return vehicle in self.ids or vehicle.rpartition(".")[0] in self.ids


def survey(files: tuple[Path, ...], begin: float, end: float | None) -> DemandSurvey:
    """Read route, additional and state files and those that they include.

    Args:
        begin, end: of the scenario, in s.

    Raises:
        PhaseError: a file is damaged.
    """
    found = DemandSurvey()
    places: dict[str, str] = {}  # stopping place -> edge
    pending: list[tuple[str, str]] = []
    for element, of_state in _elements(files):
        _note(found, element, places, pending, (begin, math.inf if end is None else end))
        found.open_ended |= element.tag == "calibrator" or of_state
    found.stops += [(owner, places.get(place, "")) for owner, place in pending]
    return found


def _elements(files: tuple[Path, ...]) -> Iterator[tuple[Any, bool]]:
    """The elements below each root, freed when done with, and whether they are of a saved state."""
    waiting, seen = list(files), set[Path]()
    while waiting:
        path = waiting.pop(0)
        if path.resolve() in seen or not path.is_file():
            continue
        seen.add(path.resolve())
        with open_input(path) as file:
            for _, element in etree.iterparse(file, events=("end",), huge_tree=True):
                root = element.getparent()
                if root is None or root.getparent() is not None or not isinstance(element.tag, str):
                    continue
                if element.tag == "include" and element.get("href"):
                    waiting.append(path.parent / element.get("href"))
                yield element, root.tag == "snapshot"
                element.clear()
                while element.getprevious() is not None:
                    del root[0]


def _note(
    found: DemandSurvey,
    top: Any,
    places: dict[str, str],
    pending: list[tuple[str, str]],
    times: tuple[float, float],
) -> None:
    for element in top.iter():
        tag, get = element.tag, element.get
        if tag == "vType":
            _type(found, element)
        elif tag == "vTypeDistribution":
            _mix(found, element)
        elif tag in VEHICLES:
            found.ids.add(get("id", ""))
            found.vehicles[get("type", "DEFAULT_VEHTYPE")] += _count(element, *times) if tag == "flow" else 1
        elif tag in PEOPLE:
            found.people += 1
        elif tag == "param":
            owner = element.getparent()
            if owner.tag in (*VEHICLES, "vType"):
                found.params.append((f"{owner.tag} {owner.get('id')!r}", get("key", ""), get("value", "")))
        elif tag == "stop" and element.getparent().tag in (*VEHICLES, "route"):
            owner = element.getparent().get("id") or element.getparent().getparent().get("id", "")
            place = next((get(name) for name in STOPPING_PLACES if get(name)), None)
            if place:
                pending.append((owner, place))
            else:
                found.stops.append((owner, _edge(get("lane")) or get("edge", "")))
        elif tag in STOPPING_PLACES:
            places[get("id", "")] = _edge(get("lane"))
        elif tag == "rerouter":
            found.rerouters.append(tuple(re.split(r"[,\s]+", get("edges", "").strip())))
        elif tag in EVENTS:
            found.events[tag] += 1
            if tag.startswith("closing"):
                found.closed.add(_edge(get("id")) if tag == "closingLaneReroute" else get("id", ""))
        elif tag == "calibrator":
            found.calibrators.append(get("edge") or _edge(get("lane")))
        elif tag == "variableSpeedSign":
            found.speed_signs += [_edge(lane) for lane in get("lanes", "").split()]


def _type(found: DemandSurvey, element: Any) -> None:
    name = element.get("id", "")
    vclass = element.get("vClass", BUILT_IN.get(name, "passenger"))
    length = float(element.get("length", DEFAULT_LENGTH.get(vclass, 5.0)))
    params = {p.get("key", ""): p.get("value", "") for p in element.iterchildren("param")}
    found.types[name] = VType(vclass, length, params)


def _mix(found: DemandSurvey, element: Any) -> None:
    inside = {e.get("id", ""): float(e.get("probability", 1.0)) for e in element.iterchildren("vType")}
    named = element.get("vTypes", "").split()
    shares = [float(p) for p in element.get("probabilities", "").split()] or [1.0] * len(named)
    found.mixes[element.get("id", "")] = inside | dict(zip(named, shares, strict=False))


def _count(flow: Any, begin: float, end: float) -> int:
    """About how many vehicles a flow brings within the scenario."""
    if flow.get("number"):
        return int(float(flow.get("number")))
    seconds = max(min(_number(flow.get("end"), end), end) - max(_number(flow.get("begin"), 0.0), begin), 0.0)
    rate = _number(flow.get("probability"), 0.0)
    per_hour = flow.get("vehsPerHour") or flow.get("perHour")
    if per_hour:
        rate = _number(per_hour, 0.0) / 3600.0
    period = flow.get("period", "")
    if period.startswith("exp("):
        rate = _number(period[4:-1], 0.0)
    elif period:
        rate = 1.0 / max(_number(period, math.inf), 1e-9)
    return round(rate * seconds) if math.isfinite(seconds) else 0


def _number(text: str | None, default: float) -> float:
    """A number or a time of SUMO's; what is neither is left to SUMO to refuse."""
    try:
        parts = [float(part) for part in (text or "").split(":")]
    except ValueError:
        return default
    return sum(
        part * scale for part, scale in zip(reversed(parts), (1.0, 60.0, 3600.0, 86400.0), strict=False)
    )


def _edge(lane: str | None) -> str:
    return (lane or "").rpartition("_")[0]
