"""Generate our own freeway networks: plain XML, then netconvert.

    python networks/generate.py            # all networks
    python networks/generate.py f04_onramp3

Every network is a carriageway of about 550 m along an alignment of straights and arcs. The reference line
is the LEFT border of the carriageway (``spreadType="right"``), so lanes added on the right never move the
others; ramps run on their own centre line and meet the outermost lane tangentially. The result is
deterministic: netconvert's comment with time and options is removed.
"""

from __future__ import annotations

import argparse
import math
import re
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import sumolib

HERE = Path(__file__).resolve().parent
LANE_WIDTH = 3.66  # m
MAIN_SPEED = 29.0  # m/s
CLASSES = (
    "private emergency authority army vip passenger hov taxi bus coach delivery truck trailer motorcycle"
)
LANES = f'width="{LANE_WIDTH}" oneway="1" allow="{CLASSES}"'
TYPES = f"""<types>
    <type id="highway.motorway" priority="14" numLanes="3" speed="29.00" {LANES}/>
    <type id="highway.motorway_link" priority="9" numLanes="1" speed="17.00" {LANES}/>
</types>
"""


@dataclass(frozen=True)
class Alignment:
    """Plan view of a line: pieces of (length in m, radius in m; 0 = straight, positive = left)."""

    pieces: tuple[tuple[float, float], ...]
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y in m, yaw in rad

    def at(self, s: float, offset: float = 0.0) -> tuple[float, float, float]:
        """x, y, yaw at arc length ``s``, ``offset`` m to the right of the line."""
        x, y, yaw = self.start
        rest = s
        for i, (length, radius) in enumerate(self.pieces):
            step = rest if i == len(self.pieces) - 1 else min(rest, length)
            if radius:
                turn = step / radius
                x += radius * (math.sin(yaw + turn) - math.sin(yaw))
                y -= radius * (math.cos(yaw + turn) - math.cos(yaw))
                yaw += turn
            else:
                x, y = x + step * math.cos(yaw), y + step * math.sin(yaw)
            rest -= step
            if rest <= 0:
                break
        return x + offset * math.sin(yaw), y - offset * math.cos(yaw), yaw

    def line(self, start: float, end: float, step: float = 10.0) -> list[tuple[float, float]]:
        count = max(1, round(abs(end - start) / step))
        return [self.at(start + (end - start) * i / count)[:2] for i in range(count + 1)]


@dataclass(frozen=True)
class Section:
    """A mainline stretch with a constant number of lanes.

    Attributes:
        length: m.
        lanes: lane count.
        on_ramp: lanes of a ramp that joins at the section's start, on the right.
        off_ramp: lanes of a ramp that leaves at the section's end, on the right.
        shared_exit: the last mainline lane left of the exit lanes may also leave.
    """

    length: float
    lanes: int
    on_ramp: int = 0
    off_ramp: int = 0
    shared_exit: bool = False


@dataclass(frozen=True)
class Spec:
    """One network; ``held_out`` ones never enter training. Lengths and radii in m, speeds in m/s."""

    name: str
    sections: tuple[Section, ...]
    pieces: tuple[tuple[float, float], ...] = ((1.0, 0.0),)
    yaw: float = 0.0
    speed: float = MAIN_SPEED
    ramp_speed: float = 17.0
    ramp_length: float = 180.0
    ramp_radius: float = 180.0
    held_out: bool = False


# Ramps (two of them also with two lanes), curves of 400-900 m, 2 to 5 lanes, weaving, drops, additions.
SPECS = (
    Spec("f01_straight3", (Section(550, 3),)),
    Spec("f02_straight5", (Section(550, 5),), yaw=0.6),
    Spec("f03_curve4", (Section(560, 4),), ((100, 0), (360, 600), (100, 0)), yaw=-0.4),
    Spec("f04_onramp3", (Section(150, 3), Section(250, 4, on_ramp=1), Section(160, 3))),
    Spec("f05_offramp3", (Section(180, 3), Section(220, 4, off_ramp=1), Section(160, 3)), yaw=1.2),
    Spec("f06_weave3", (Section(130, 3), Section(300, 4, on_ramp=1, off_ramp=1), Section(130, 3)), yaw=2.1),
    Spec("f07_drop4", (Section(300, 4), Section(260, 3)), ((150, 0), (400, -900)), yaw=0.3),
    Spec("f08_add2", (Section(250, 2), Section(300, 3)), ((80, 0), (470, 500)), yaw=-1.0),
    Spec("f09_tworamp3", (Section(130, 3), Section(250, 5, on_ramp=2), Section(180, 4)), yaw=-2.5),
    Spec("f10_curve2", (Section(540, 2),), ((120, 0), (180, -400), (60, 0), (180, 400)), yaw=0.9),
    Spec(
        "h01_curve_onramp2",
        (Section(160, 2), Section(230, 3, on_ramp=1), Section(160, 2)),
        ((100, 0), (450, 700)),
        yaw=-0.7,
        held_out=True,
    ),
    Spec(
        "h02_exit_drop4",
        (Section(120, 4), Section(200, 5, off_ramp=1), Section(120, 4), Section(130, 3)),
        ((250, 0), (320, -800)),
        yaw=0.2,
        held_out=True,
    ),
)


class PlainNetwork:
    """Collects nodes, edges and connections and writes netconvert's plain XML."""

    def __init__(self) -> None:
        self.nodes: list[str] = []
        self.edges: list[str] = []
        self.connections: list[str] = []

    def node(self, name: str, at: tuple[float, float]) -> None:
        self.nodes.append(f'    <node id={quoteattr(name)} x="{at[0]:.2f}" y="{at[1]:.2f}" type="priority"/>')

    def edge(self, name, ends, lanes, speed, line, ramp=False, acceleration=()) -> None:
        """``line``: the left border (mainline) or the centre (ramp); ``acceleration``: lane numbers."""
        shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in line)
        kind, spread = ("highway.motorway_link", "center") if ramp else ("highway.motorway", "right")
        lane_tags = "".join(f'<lane index="{i}" acceleration="1"/>' for i in acceleration)
        self.edges.append(
            f'    <edge id={quoteattr(name)} from={quoteattr(ends[0])} to={quoteattr(ends[1])} type="{kind}" '
            f'numLanes="{lanes}" speed="{speed:.2f}" spreadType="{spread}" shape="{shape}">{lane_tags}</edge>'
        )

    def connect(self, source: str, target: str, lanes: list[tuple[int, int]]) -> None:
        self.connections.extend(
            f'    <connection from={quoteattr(source)} to={quoteattr(target)} fromLane="{a}" toLane="{b}"/>'
            for a, b in lanes
        )

    def write(self, stem: Path) -> dict[str, Path]:
        paths = {kind: stem.with_name(f"{stem.name}.{kind}.xml") for kind in ("nod", "edg", "con")}
        for kind, root, rows in (
            ("nod", "nodes", self.nodes),
            ("edg", "edges", self.edges),
            ("con", "connections", self.connections),
        ):
            paths[kind].write_text(f"<{root}>\n" + "\n".join(rows) + f"\n</{root}>\n")
        return paths


def ramp_line(
    at: tuple[float, float, float], length: float, radius: float, leaving: bool
) -> list[tuple[float, float]]:
    """Centre line of a ramp that touches ``at`` (x, y, yaw) tangentially and bends away to the right."""
    x, y, yaw = at
    pieces = ((12.0, 0.0), (0.3 * length, -2.0 * radius), (0.2 * length, 0.0), (length, -radius))
    if leaving:
        return Alignment(pieces, (x, y, yaw)).line(0.0, length, 8.0)
    mirrored = tuple((part, -bend) for part, bend in pieces)
    return Alignment(mirrored, (x, y, yaw + math.pi)).line(0.0, length, 8.0)[::-1]


def build(spec: Spec) -> PlainNetwork:
    """Mainline sections with their ramps as a plain network."""
    net, road = PlainNetwork(), Alignment(spec.pieces, (0.0, 0.0, spec.yaw))
    starts = [sum(s.length for s in spec.sections[:i]) for i in range(len(spec.sections) + 1)]
    for i, s in enumerate(starts):
        net.node(f"n{i}", road.at(s)[:2])
    for i, section in enumerate(spec.sections):
        _mainline(net, spec, road, starts, i)
        if section.on_ramp:
            _on_ramp(net, spec, road, starts[i], i)
        if section.off_ramp:
            _off_ramp(net, spec, road, starts[i + 1], i)
    return net


def _mainline(net: PlainNetwork, spec: Spec, road: Alignment, starts: list[float], i: int) -> None:
    section = spec.sections[i]
    last = i + 1 == len(spec.sections)
    ending = 0 if last else section.lanes - section.off_ramp - spec.sections[i + 1].lanes
    net.edge(
        f"main{i}",
        (f"n{i}", f"n{i + 1}"),
        section.lanes,
        spec.speed,
        road.line(starts[i], starts[i + 1]),
        acceleration=range(max(ending, 0)) if section.on_ramp else (),
    )
    if last:
        return
    following = spec.sections[i + 1]
    through = min(section.lanes - section.off_ramp, following.lanes - following.on_ramp)
    pairs = [(section.lanes - k, following.lanes - k) for k in range(1, through + 1)]
    net.connect(f"main{i}", f"main{i + 1}", pairs)


def _on_ramp(net: PlainNetwork, spec: Spec, road: Alignment, s: float, i: int) -> None:
    section = spec.sections[i]
    line = ramp_line(
        road.at(s, (section.lanes - 0.5 * section.on_ramp) * LANE_WIDTH),
        spec.ramp_length,
        spec.ramp_radius,
        leaving=False,
    )
    net.node(f"on{i}", line[0])
    net.edge(f"onramp{i}", (f"on{i}", f"n{i}"), section.on_ramp, spec.ramp_speed, line, ramp=True)
    net.connect(f"onramp{i}", f"main{i}", [(k, k) for k in range(section.on_ramp)])


def _off_ramp(net: PlainNetwork, spec: Spec, road: Alignment, s: float, i: int) -> None:
    section = spec.sections[i]
    line = ramp_line(
        road.at(s, (section.lanes - 0.5 * section.off_ramp) * LANE_WIDTH),
        spec.ramp_length,
        spec.ramp_radius,
        leaving=True,
    )
    net.node(f"off{i}", line[-1])
    net.edge(f"offramp{i}", (f"n{i + 1}", f"off{i}"), section.off_ramp, spec.ramp_speed, line, ramp=True)
    shared = [(section.off_ramp, section.off_ramp - 1)] if section.shared_exit else []
    net.connect(f"main{i}", f"offramp{i}", [(k, k) for k in range(section.off_ramp)] + shared)


def netconvert(paths: dict[str, Path], output: Path) -> None:
    """Run netconvert and strip the comment that holds time, options and local paths."""
    with tempfile.TemporaryDirectory() as folder:
        types, raw = Path(folder) / "types.typ.xml", Path(folder) / "raw.net.xml"
        types.write_text(TYPES)
        options = {
            "node-files": paths["nod"],
            "edge-files": paths["edg"],
            "connection-files": paths["con"],
            "type-files": types,
            "output-file": raw,
            "no-turnarounds": "true",
            "junctions.limit-turn-speed": "-1",
            "junctions.corner-detail": "0",
            "offset.disable-normalization": "true",
            "xml-validation": "never",
        }
        command = [sumolib.checkBinary("netconvert"), *(f"--{key}={value}" for key, value in options.items())]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        text = raw.read_text(encoding="utf-8")
    output.write_text(re.sub(r"<!--.*?-->\n*", "", text, flags=re.DOTALL), encoding="utf-8")


def generate(spec: Spec, folder: Path = HERE) -> Path:
    """Write the plain sources and the network of one spec; returns the ``.net.xml``."""
    plain = folder / "plain"
    target = folder / "held_out" if spec.held_out else folder
    for directory in (plain, target):
        directory.mkdir(parents=True, exist_ok=True)
    output = target / f"{spec.name}.net.xml"
    netconvert(build(spec).write(plain / spec.name), output)
    return output


def main() -> None:
    parser = argparse.ArgumentParser(description="Generate the shipped freeway networks with netconvert.")
    parser.add_argument("names", nargs="*", help="networks to generate (default: all)")
    parser.add_argument("--out", type=Path, default=HERE, help="folder to write to (default: this one)")
    args = parser.parse_args()
    known = {spec.name: spec for spec in SPECS}
    if unknown := [name for name in args.names if name not in known]:
        parser.error(f"no network {', '.join(unknown)}; choose from {', '.join(known)}")
    for name in args.names or known:
        print(generate(known[name], args.out))


if __name__ == "__main__":
    main()
