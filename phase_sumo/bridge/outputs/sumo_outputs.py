"""SUMO's own output files, made right for vehicles under the policy once SUMO has closed them.

SUMO writes no lane change of a moved vehicle, takes it for one straight box, and counts whole lanes in its
route length that it left sideways or was put back from. README says which outputs need nothing. The files are
written back whole or not at all.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Container, Iterable
from pathlib import Path
from typing import Any

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.atomic_files import write_whole
from phase_sumo.bridge.fleet.event_log import Event, under_policy
from phase_sumo.bridge.fleet.scene import REMOVED_BY_SUMO, Scene
from phase_sumo.bridge.outputs.lane_records import LaneChange, LaneChanges, LaneWays, RouteLengths
from phase_sumo.bridge.sumo.file_names import writes_file, written


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
    write_whole(path, gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)


def merge_by_time(root: Any, fresh: Iterable[Any]) -> None:
    """Put elements among those of the root, by their attribute ``time``."""
    rows = sorted([*root, *fresh], key=lambda element: float(element.get("time")))
    root[:] = rows
    root.text = "\n    " if rows else "\n"
    for row in rows:
        row.tail = "\n    "
    if rows:
        rows[-1].tail = "\n"


OUTPUTS = ("tripinfo-output", "collision-output", "lanechange-output", "statistic-output")
PAST_ARRIVAL = (
    80.0  # m that a vehicle drives in two steps of SUMO, which is when it asks for its place of arrival
)


class SumoOutputs:
    """Collects during the run what SUMO's files lack, and puts it in after SUMO's end.

    Attributes:
        warnings: files that could not be put right.
    """

    def __init__(self, scene: Scene, wanted: Container[str]) -> None:
        """Call it while the simulation runs: SUMO is asked where it writes.

        Args:
            wanted: outputs that the user asked for; others are for our own use and vanish at the end.
        """
        self._scene, self._wanted = scene, wanted
        self._path = {name: _path(scene.api, name) for name in OUTPUTS}
        self._dated = scene.api.simulation.getOption("human-readable-time").lower() == "true"
        self._precision = int(scene.api.simulation.getOption("precision"))
        ways = LaneWays(scene.api)
        self._changes = LaneChanges(scene.session, scene.table, scene.types, scene.events, ways)
        self._lengths = RouteLengths(scene, ways)
        self._gained: list[tuple[float, float]] = []  # by the correction of each trip: m, and m/s of its mean
        self._past_arrival = 0
        self.warnings: list[str] = []

    def update(self) -> None:
        """After every step."""
        if "lanechange-output" in self._wanted:
            self._changes.update()
        if "tripinfo-output" in self._wanted or "statistic-output" in self._wanted:
            self._lengths.update()

    def settle(self) -> None:
        """After SUMO closed its files: trips it ended on its own are marked, and the files put right."""
        if self._dated:
            self.warnings.append("human-readable-time: SUMO's own outputs are left as SUMO wrote them")
            self._path = dict.fromkeys(self._path)
        self._tripinfo()
        self._lane_changes()
        self._statistics(self._collisions())
        for name, path in self._path.items():
            if path is not None and name not in self._wanted:
                path.unlink(missing_ok=True)

    def _read(self, name: str) -> Any:
        path = self._path[name]
        if path is None:
            return None
        try:
            return read_output(path)
        except (OSError, etree.XMLSyntaxError):
            self.warnings.append(
                f"{name} {path}: not readable as XML, left as SUMO wrote it; name an .xml or .xml.gz file"
            )
            return None

    def _write(self, name: str, tree: Any) -> None:
        path = self._path[name]
        assert path is not None
        write_output(path, tree)

    def _tripinfo(self) -> None:
        tree = self._read("tripinfo-output")
        if tree is None:
            return
        for element in tree.iterfind("tripinfo"):
            self._mark_removed(element)
            self._correct_length(element)
        if self._gained:
            self._write("tripinfo-output", tree)
        if self._past_arrival:
            self.warnings.append(
                f"{self._past_arrival} vehicles under PHASE drove past their arrivalPos to the end of their "
                "last edge: PHASE looks for it in the demand files alone; split the edge there"
            )

    def _correct_length(self, element: Any) -> None:
        vehicle, lane, wanted = (element.get(name) for name in ("id", "arrivalLane", "arrivalPos"))
        position = self._lengths.driven_to(vehicle, lane, float(wanted))
        if position > float(wanted) and not element.get("vaporized"):
            element.set("arrivalPos", self._number(position))
            self._past_arrival += position > float(wanted) + PAST_ARRIVAL
        right = self._lengths.until(vehicle, lane, float(element.get("arrivalPos")))
        if right is not None:
            gain, duration = right - float(element.get("routeLength")), float(element.get("duration"))
            self._gained.append((gain, gain / duration if duration else 0.0))
            element.set("routeLength", self._number(right))

    def _mark_removed(self, element: Any) -> None:
        """SUMO lists vehicles that calibrators, vaporizers or a user took out as arrived."""
        how, vehicle = element.get("vaporized"), element.get("id")
        trip = self._scene.trips.get(vehicle)
        if trip is None or how in (None, "", "end") or trip.removed not in ("", REMOVED_BY_SUMO):
            return
        events = self._scene.events.events
        reason = f"{REMOVED_BY_SUMO}: {how}"
        known = next((e for e in events if e.kind == "removal" and e.vehicle == vehicle), None)
        if known is None:
            known = Event(float(element.get("arrival")), "removal", vehicle, type=trip.type)
            known.lane, known.position = element.get("arrivalLane"), float(element.get("arrivalPos"))
            known.speed = float(element.get("arrivalSpeed"))
            events.append(known)
            events.sort(key=lambda event: event.time)
        known.reason = trip.removed = reason
        trip.arrive, trip.seconds = math.nan, float(element.get("duration"))

    def _lane_changes(self) -> None:
        tree = self._read("lanechange-output")
        if tree is not None and self._changes.changes:
            merge_by_time(tree.getroot(), [self._change(change) for change in self._changes.changes])
            self._write("lanechange-output", tree)

    def _change(self, change: LaneChange) -> Any:
        values = {
            "id": change.vehicle,
            "type": change.type,
            "time": self._time(change.time),
            "from": change.source,
            "to": change.target,
            "dir": str(change.direction),
            "speed": self._number(change.speed),
            "pos": self._number(change.position),
            "reason": "traci",
        }
        for name in ("leader", "follower", "origLeader"):
            gaps = change.gaps.get(name)
            cells = [self._number(value) for value in gaps] if gaps else ["None"] * 3
            values |= zip((f"{name}Gap", f"{name}SecureGap", f"{name}Speed"), cells, strict=True)
        return etree.Element("change", values)

    def _collisions(self) -> int | None:
        """SUMO's collisions of its own vehicles with ours of the others; how many, None if not known."""
        tree = self._read("collision-output")
        if tree is None:
            return None
        root, turns = tree.getroot(), self._scene.events.turns()
        ours = [event for event in self._scene.events.of("collision") if event.with_phase]
        theirs = [
            element
            for element in root
            if any(
                under_policy(turns[element.get(role)], float(element.get("time")))
                for role in ("collider", "victim")
            )
        ]
        for element in theirs:
            root.remove(element)
        if ours or theirs:
            merge_by_time(root, [self._collision(event) for event in ours])
            self._write("collision-output", tree)
        return len(root)

    def _collision(self, event: Event) -> Any:
        return etree.Element(
            "collision",
            {
                "time": self._time(event.time),
                "type": "collision",
                "lane": event.lane,
                "pos": self._number(event.position if event.lane else -1.0),
                "collider": event.vehicle,
                "victim": event.other,
                "colliderType": event.type,
                "victimType": event.other_type,
                "colliderSpeed": self._number(event.speed),
                "victimSpeed": self._number(event.other_speed),
            },
        )

    def _statistics(self, collisions: int | None) -> None:
        tree = self._read("statistic-output")
        if tree is None:
            return
        if collisions is not None:
            tree.find("safety").set("collisions", str(collisions))
        mean = tree.find("vehicleTripStatistics")
        count = int(mean.get("count"))
        if self._gained:
            for name, gained in zip(("routeLength", "speed"), zip(*self._gained, strict=True), strict=True):
                mean.set(name, self._number(float(mean.get(name)) + sum(gained) / count))
        self._write("statistic-output", tree)

    def _number(self, value: float) -> str:
        return f"{value:.{self._precision}f}"

    def _time(self, value: float) -> str:
        return f"{value:.{min(max(self._precision, 2), 3)}f}"


def _path(api: Any, option: str) -> Path | None:
    """Where SUMO writes an output; None if it does not, or not to a file."""
    value, prefix, suffix = (api.simulation.getOption(n) for n in (option, "output-prefix", "output-suffix"))
    return written(value, prefix, suffix) if value and writes_file(value) else None
