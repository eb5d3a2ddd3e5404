"""A motorway full of vehicles from the first step on, of any size: input for measuring the bridge."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phase_sumo.bridge.maps.import_map import netconvert
from phase_sumo.sim.synthetic_road import HALF_MEDIAN, LANES, SECTION, WIDTH, axis

HEADWAY, JITTER = 45.0, 6.0  # m between fronts in a lane, and how far each may be off its even place
FASTEST = 40.0  # m/s: as far ahead of the first vehicles the road is empty, so that none arrives
TRUCKS = (0.4, 0.05, 0.0)  # share of trucks with trailers in each lane from the right: 15 % in all
SPEEDS = (23.0, 25.0, 28.0)  # m/s at the start, by lane from the right
POINTS = 21  # of a section: one every 25 m, as in maps of real motorways; moveToXY looks at all of them
NEAR_END = 10.0  # m of every section kept free, so that junctions need not be known
WAYS = {"east": -1, "west": 1}  # right-hand traffic: eastbound lies south of the axis
TYPES = """\
    <vType id="car" vClass="passenger" carFollowModel="IDM" length="4.8" width="1.9" maxSpeed="40"
           accel="2.0" decel="3.0" tau="1.2" minGap="2.5" speedFactor="normc(1.0,0.05,0.95,1.1)"/>
    <vType id="truck" vClass="trailer" carFollowModel="IDM" length="16.5" width="2.55" maxSpeed="25"
           accel="0.9" decel="2.5" tau="1.6" minGap="3" speedFactor="normc(0.87,0.02,0.85,0.9)"/>
"""
CONFIGURATION = """\
<configuration>
    <input><net-file value="full.net.xml"/><route-files value="full.rou.xml"/></input>
    <time><begin value="0"/><step-length value="0.1"/></time>
</configuration>
"""


def write_full_freeway(folder: Path, vehicles: int, seconds: float, seed: int) -> Path:
    """Write network, demand and configuration: two carriageways of three lanes, full at once.

    Args:
        seconds: that no vehicle arrives within.

    Returns:
        The ``.sumocfg``; its steps are 0.1 s long and SUMO's own model is IDM.
    """
    places = -(-vehicles // (len(WAYS) * LANES))  # of a lane
    sections = int(np.ceil((places * HEADWAY + seconds * FASTEST) / SECTION))
    _write_network(folder, sections)
    (folder / "full.rou.xml").write_text(
        _demand(vehicles, places, sections, np.random.default_rng(seed)), encoding="utf-8"
    )
    config = folder / "full.sumocfg"
    config.write_text(CONFIGURATION, encoding="utf-8")
    return config


def _write_network(folder: Path, sections: int) -> None:
    nodes, edges = [], []
    border = HALF_MEDIAN - 0.5 * WIDTH  # from the axis to the left border of a carriageway
    for name, way in WAYS.items():
        for k in range(sections + 1):
            x, y = axis(np.array([k * SECTION]), way * border)[0]
            nodes.append(f'<node id="{name}_n{k}" x="{x:.3f}" y="{y:.3f}" type="priority"/>')
        for k in range(sections):
            line = axis(np.linspace(k * SECTION, (k + 1) * SECTION, POINTS), way * border)[::-way]
            ends = (k, k + 1) if way < 0 else (k + 1, k)
            shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in line)
            edges.append(
                f'<edge id="{name}{k}" from="{name}_n{ends[0]}" to="{name}_n{ends[1]}" numLanes="{LANES}" '
                f'type="highway.motorway" speed="30" width="{WIDTH}" spreadType="right" shape="{shape}"/>'
            )
    plain = {"node": folder / "full.nod.xml", "edge": folder / "full.edg.xml"}
    plain["node"].write_text("<nodes>\n" + "\n".join(nodes) + "\n</nodes>\n", encoding="utf-8")
    plain["edge"].write_text("<edges>\n" + "\n".join(edges) + "\n</edges>\n", encoding="utf-8")
    files = [option for kind, path in plain.items() for option in (f"--{kind}-files", str(path))]
    output = folder / "full.net.xml"
    netconvert(output, [*files, "--no-turnarounds", "--no-warnings", "--output-file", str(output)])


def _demand(vehicles: int, places: int, sections: int, draw: np.random.Generator) -> str:
    """Every vehicle at its place at the start, those farthest down the road last in a lane's list."""
    routes, rows = [], []
    for name, way in WAYS.items():
        order = [f"{name}{k}" for k in range(sections)][::-way]
        routes += [f'<route id="{edge}" edges="{" ".join(order[k:])}"/>' for k, edge in enumerate(order)]
        for place in range(places):
            for lane in range(LANES):
                at = (place + 0.5) * HEADWAY + draw.uniform(-JITTER, JITTER)
                section, position = divmod(at, SECTION)
                kind = "truck" if draw.random() < TRUCKS[lane] else "car"
                rows.append(
                    f'<vehicle id="v{len(rows)}" type="{kind}" route="{order[int(section)]}" depart="0" '
                    f'departLane="{lane}" departPos="{position * (1 - NEAR_END / SECTION):.2f}" '
                    f'departSpeed="{SPEEDS[lane]:g}" insertionChecks="none"/>'
                )
    kept = rows[: vehicles // 2] + rows[len(rows) // 2 :][: vehicles - vehicles // 2]
    return "<routes>\n" + TYPES + "\n".join(routes + kept) + "\n</routes>\n"
