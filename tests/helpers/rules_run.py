"""Small roads made by netconvert, and runs on them with the stand-in for the policy."""

from __future__ import annotations

import re
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import sumolib

from phase_sumo.bridge.fleet.event_log import Event, read_events
from phase_sumo.bridge.run import run_scenario
from tests.helpers.standin import Standin

TYPES = """
    <vType id="car" vClass="passenger" length="4.8" width="1.9" speedDev="0" sigma="0"/>
    <vType id="truck" vClass="truck" length="11" width="2.5" speedDev="0" maxSpeed="30"/>
    <vType id="bus" vClass="bus" length="12" width="2.5" speedDev="0"/>
    <vType id="works" vClass="truck" length="8" width="2.5" speedDev="0" maxSpeed="1.4"/>
"""
ROAD = 'type="highway.trunk" numLanes="1" speed="20"'
RAMP = (
    '<node id="a" x="0" y="0"/><node id="b" x="400" y="0"/><node id="c" x="900" y="0"/>'
    '<node id="r" x="0" y="-120"/>',
    '<edge id="m0" from="a" to="b" numLanes="2" priority="9" type="highway.motorway" speed="25"/>'
    '<edge id="m1" from="b" to="c" numLanes="2" priority="9" type="highway.motorway" speed="25"/>'
    '<edge id="on" from="r" to="b" numLanes="1" priority="3" type="highway.motorway_link" speed="20"/>',
    '<connection from="m0" to="m1" fromLane="0" toLane="0"/>'
    '<connection from="m0" to="m1" fromLane="1" toLane="1"/>'
    '<connection from="on" to="m1" fromLane="0" toLane="0"/>',
)
LANES = (
    '<node id="a" x="0" y="0"/><node id="b" x="300" y="0"/><node id="c" x="600" y="0"/>'
    '<node id="d" x="900" y="0"/>',
    '<edge id="m0" from="a" to="b" type="highway.motorway" numLanes="2" speed="25">{lanes}</edge>'
    '<edge id="m1" from="b" to="c" type="highway.motorway" numLanes="2" speed="25">{lanes}</edge>'
    '<edge id="m2" from="c" to="d" type="highway.motorway" numLanes="2" speed="25">{lanes}</edge>',
    "",
)
FLOW = (
    '<flow id="f" type="{}" from="m0" to="m2" begin="0" end="8" period="4" departSpeed="20" departLane="{}"/>'
)


class Seen(NamedTuple):
    """One vehicle at one time in SUMO's output."""

    time: float
    lane: str
    y: float
    speed: float


class Run:
    """A scenario with the stand-in for the policy: what SUMO's output and our events say."""

    def __init__(
        self, folder: Path, net: tuple[str, str, str], demand: str, more: str = "", **changes
    ) -> None:
        self.folder = folder
        self._write(net, changes.get("in_net", ""))
        (folder / "v.rou.xml").write_text(f"<routes>{TYPES}{demand}</routes>")
        (folder / "m.add.xml").write_text(f"<additional>{more}</additional>")
        cfg = folder / "s.sumocfg"
        cfg.write_text(
            '<configuration><net-file value="s.net.xml"/><route-files value="v.rou.xml"/>'
            '<additional-files value="m.add.xml"/><fcd-output value="fcd.xml"/><step-length value="0.1"/>'
            f'<end value="{changes.get("end", 45)}"/></configuration>'
        )
        self.result = run_scenario(
            cfg,
            policy=Standin(),
            share=changes.get("share", 1.0),
            guard=changes.get("guard", True),
            output_dir=folder / "out",
            record=False,
        )
        self.events: list[Event] = read_events(folder / "out" / "events.csv")
        self.seen: dict[str, list[Seen]] = defaultdict(list)
        time = 0.0
        for line in (folder / "out" / "fcd.xml").read_text().splitlines():
            values = dict(re.findall(r'(\w+)="([^"]*)"', line))
            time = float(values.get("time", time))
            if "lane" in values:
                seen = Seen(time, values["lane"], float(values["y"]), float(values["speed"]))
                self.seen[values["id"]].append(seen)

    def _write(self, net: tuple[str, str, str], in_net: str) -> None:
        args = [sumolib.checkBinary("netconvert"), "-o", "s.net.xml", "--no-turnarounds", "true"]
        for letter, name, text in zip("nex", ("nodes", "edges", "connections"), net, strict=True):
            if text:
                (self.folder / f"s.{name}.xml").write_text(f"<{name}>{text}</{name}>")
                args += [f"-{letter}", f"s.{name}.xml"]
        subprocess.run(args, check=True, capture_output=True, cwd=self.folder)
        path = self.folder / "s.net.xml"
        path.write_text(path.read_text().replace("    <edge ", f"{in_net}\n    <edge ", 1))

    def reasons(self, kind: str = "hand-back") -> set[str]:
        return {event.reason for event in self.events if event.kind == kind}

    def on(self, *lanes: str) -> list[tuple[str, Seen]]:
        return [(v, s) for v, all_seen in self.seen.items() for s in all_seen if s.lane in lanes]


def taken_back(run: Run, vehicle: str) -> bool:
    kinds = [e.kind for e in run.events if e.vehicle == vehicle and e.kind in ("adoption", "hand-back")]
    return kinds[-1] == "adoption"
