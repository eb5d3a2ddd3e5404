"""SUMO's own traffic on a network, to see whether it can be driven from every entry to every exit."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import sumolib

END, LAST_DEPARTURE = 120.0, 70.0  # s
FLOW = 700.0  # vehicles/h on every lane that enters
TYPES = """\
    <vType id="car" vClass="passenger"/>
    <vType id="semi" vClass="trailer" length="20" width="2.55" accel="0.9" decel="2.5" maxSpeed="25"/>
"""
SHARES = {"car": 0.85, "semi": 0.15}


@dataclass(frozen=True)
class TrafficResult:
    """What SUMO counted; ``wanted`` and ``arrived`` name the flows (entry, exit, type)."""

    inserted: int
    collisions: int
    teleports: int
    emergency_stops: int
    wanted: frozenset[str]
    arrived: frozenset[str]


def run_sumo(network: Path, folder: Path) -> TrafficResult:
    """Drive cars and articulated trucks for 120 s at 0.1 s; files go to ``folder``."""
    demand, statistics, trips = (folder / name for name in ("demand.rou.xml", "stats.xml", "trips.xml"))
    flows = _flows(network)
    demand.write_text("<routes>\n" + TYPES + "\n".join(flows.values()) + "\n</routes>\n", encoding="utf-8")
    options = {
        "net-file": network,
        "route-files": demand,
        "step-length": 0.1,
        "end": END,
        "statistic-output": statistics,
        "tripinfo-output": trips,
        "collision.action": "warn",
        "collision.check-junctions": "true",
    }
    command = [sumolib.checkBinary("sumo"), *(f"--{key}={value}" for key, value in options.items())]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    root = ElementTree.parse(statistics).getroot()

    def count(element: str, name: str) -> int:
        found = root.find(element)
        assert found is not None
        return int(found.get(name, "-1"))

    arrived = {row.get("id", "").rsplit(".", 1)[0] for row in ElementTree.parse(trips).getroot()}
    return TrafficResult(
        inserted=count("vehicles", "inserted"),
        collisions=count("safety", "collisions"),
        teleports=count("teleports", "total"),
        emergency_stops=count("safety", "emergencyStops"),
        wanted=frozenset(flows),
        arrived=frozenset(arrived),
    )


def _flows(network: Path) -> dict[str, str]:
    """XML of one flow per entry, exit that can be reached from it, and vehicle type, by its id."""
    net = sumolib.net.readNet(str(network))
    edges = [edge for edge in net.getEdges() if not edge.isSpecial()]
    exits = [edge for edge in edges if not edge.getOutgoing()]
    flows = {}
    for entry in (edge for edge in edges if not edge.getIncoming()):
        reached = [edge.getID() for edge in exits if net.getShortestPath(entry, edge)[0]]
        for target in reached:
            for kind, share in SHARES.items():
                name = f"{entry.getID()}.{target}.{kind}"
                period = 3600.0 * len(reached) / (share * FLOW * entry.getLaneNumber())
                flows[name] = (
                    f'    <flow id="{name}" type="{kind}" from="{entry.getID()}" to="{target}" begin="0" '
                    f'end="{LAST_DEPARTURE:g}" period="{min(period, LAST_DEPARTURE):.2f}" '
                    'departLane="best" departSpeed="desired"/>'
                )
    return flows
