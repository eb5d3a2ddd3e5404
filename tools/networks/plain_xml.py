"""netconvert's plain XML: collecting it, writing it and turning it into a network."""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import sumolib

from tools.networks.alignment import Line

LANE_WIDTH = 3.66  # m, the US standard
CLASSES = (
    "private emergency authority army vip passenger hov taxi bus coach delivery truck trailer motorcycle"
)
LANES = f'width="{LANE_WIDTH}" oneway="1" allow="{CLASSES}"'
TYPES = f"""<types>
    <type id="highway.motorway" priority="14" numLanes="3" speed="29.00" {LANES}/>
    <type id="highway.motorway_link" priority="9" numLanes="1" speed="17.00" {LANES}/>
</types>
"""


class PlainNetwork:
    """Collects nodes, edges and connections.

    Args:
        lane_width: m, of every lane.
        left_hand: traffic drives on the left: everything is mirrored at the x axis.
    """

    def __init__(self, lane_width: float = LANE_WIDTH, left_hand: bool = False) -> None:
        self.lane_width, self.left_hand = lane_width, left_hand
        self.nodes: list[str] = []
        self.edges: list[str] = []
        self.connections: list[str] = []

    def node(self, name: str, at: tuple[float, float], kind: str = "priority") -> None:
        x, y = self._placed(at)
        self.nodes.append(f'    <node id={quoteattr(name)} x="{x:.2f}" y="{y:.2f}" type="{kind}"/>')

    def edge(
        self,
        name: str,
        ends: tuple[str, str],
        lanes: int,
        speed: float,
        line: Line,
        ramp: bool = False,
        centred: bool | None = None,
        tags: Mapping[int, str] | None = None,
    ) -> None:
        """Add an edge.

        Args:
            speed: m/s.
            line: the left border of the lanes or, if ``centred`` (by default of ramps), their centre.
            tags: further attributes by lane number, counted from the outer lane.
        """
        kind = "highway.motorway_link" if ramp else "highway.motorway"
        spread = "center" if (ramp if centred is None else centred) else "right"
        shape = self._shape(line)
        width = "" if self.lane_width == LANE_WIDTH else f' width="{self.lane_width:.2f}"'
        lane_tags = "".join(f'<lane index="{i}" {text}/>' for i, text in sorted((tags or {}).items()))
        self.edges.append(
            f'    <edge id={quoteattr(name)} from={quoteattr(ends[0])} to={quoteattr(ends[1])} type="{kind}" '
            f'numLanes="{lanes}"{width} speed="{speed:.2f}" spreadType="{spread}" shape="{shape}">'
            f"{lane_tags}</edge>"
        )

    def connect(
        self, source: str, target: str, lanes: list[tuple[int, int]], lines: Sequence[Line] = ()
    ) -> None:
        """Connect (from, to) lane numbers, on the centre lines ``lines`` or else straight."""
        for k, (a, b) in enumerate(lanes):
            shape = f' shape="{self._shape(lines[k])}"' if lines else ""
            self.connections.append(
                f"    <connection from={quoteattr(source)} to={quoteattr(target)} "
                f'fromLane="{a}" toLane="{b}"{shape}/>'
            )

    def write(self, stem: Path) -> dict[str, Path]:
        """Write ``<stem>.nod.xml``, ``.edg.xml`` and ``.con.xml``; returns them by those kinds."""
        paths = {kind: stem.with_name(f"{stem.name}.{kind}.xml") for kind in ("nod", "edg", "con")}
        for kind, root, rows in (
            ("nod", "nodes", self.nodes),
            ("edg", "edges", self.edges),
            ("con", "connections", self.connections),
        ):
            paths[kind].write_text(f"<{root}>\n" + "\n".join(rows) + f"\n</{root}>\n", encoding="utf-8")
        return paths

    def _shape(self, line: Line) -> str:
        return " ".join(f"{x:.2f},{y:.2f}" for x, y in map(self._placed, line))

    def _placed(self, at: tuple[float, float]) -> tuple[float, float]:
        return (at[0], -at[1]) if self.left_hand else at


def netconvert(paths: dict[str, Path], output: Path, left_hand: bool = False) -> None:
    """Run netconvert and strip the comment that holds time, options and local paths.

    Args:
        paths: plain XML by kind, see `PlainNetwork.write`.
        output: the ``.net.xml``.
        left_hand: traffic drives on the left.
    """
    with tempfile.TemporaryDirectory() as folder:
        types = Path(folder) / "types.typ.xml"
        types.write_text(TYPES, encoding="utf-8")
        options = {
            "node-files": paths["nod"],
            "edge-files": paths["edg"],
            "connection-files": paths["con"],
            "type-files": types,
            "no-turnarounds": "true",
            "junctions.limit-turn-speed": "-1",
            "junctions.corner-detail": "0",
            "offset.disable-normalization": "true",
            "xml-validation": "never",
        }
        if left_hand:
            options["lefthand"] = "true"
        run_netconvert(options, output)


def run_netconvert(options: Mapping[str, str | Path], output: Path) -> None:
    """Write a network to ``output``, without the comment that holds time, options and local paths."""
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw.net.xml"
        command = [sumolib.checkBinary("netconvert"), f"--output-file={raw}"]
        command += [f"--{key}={value}" for key, value in options.items()]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        text = raw.read_text(encoding="utf-8")
    output.write_text(re.sub(r"<!--.*?-->\n*", "", text, flags=re.DOTALL), encoding="utf-8")
