"""Networks that are harder to drive than a freeway should be: tight loops, winding ramps, roads with kinks.

    python -m tools.networks.hard        # into networks/hard

Real interchanges have loops of 25 to 35 m radius and ramps of less, and many a user's network is drawn as
straight edges that meet at an angle. The result is the same on every run.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from tools.networks.alignment import RampShape
from tools.networks.build import build
from tools.networks.draw import Draw
from tools.networks.plain_xml import netconvert, run_netconvert
from tools.networks.specs import RECIPES
from tools.places import NETWORKS

Points = list[tuple[float, float]]
TIGHTER = 0.56  # of the loops' radii
LOOPS = ("f14_collector2", "f22_loops2")
KINKS = {"f23_kinks2": (2, 1), "f24_kinks3": (3, 2), "f25_kinks1": (1, 3)}  # lanes and seed
WITH_JUNCTION_LANES = "f24_kinks3"
EDGES = 6
RAMPS = {"f26_ramp1": (1, 4), "f27_ramps1": (1, 10), "f28_ramp2": (2, 6)}  # lanes and seed
JOINING = "f27_ramps1"  # two ramps that become one


class TightDraw(Draw):
    """Draws the same network with smaller loops."""

    def loop(self) -> RampShape:
        shape = super().loop()
        return replace(
            shape,
            radius=TIGHTER * shape.radius,
            length=float(round(60 + TIGHTER * (shape.length - 60))),
            spiral=18.0,
            speed=round(0.75 * shape.speed, 2),
        )


def tight_loops(name: str, folder: Path) -> Path:
    """A cloverleaf of the training networks, with tighter loops."""
    number, _, kind = name.partition("_")
    output = folder / f"{number}_tight_{kind}.net.xml"
    with tempfile.TemporaryDirectory() as plain:
        netconvert(build(RECIPES[name](TightDraw(name))).write(Path(plain) / name), output)
    return output


def kinks(name: str, folder: Path) -> Path:
    """Straight edges of 70 to 140 m that meet at 15 to 45 degrees, mostly to alternate sides."""
    lanes, seed = KINKS[name]
    rng = np.random.default_rng(seed)
    x = y = heading = 0.0
    side, points = 1, [(0.0, 0.0)]
    for _ in range(EDGES):
        length = rng.uniform(70, 140)
        x, y = x + length * np.cos(heading), y + length * np.sin(heading)
        points.append((x, y))
        heading += side * np.radians(rng.uniform(15, 45))
        side = -side if rng.random() < 0.75 else side
    nodes = "".join(f'<node id="n{i}" x="{x:.2f}" y="{y:.2f}"/>' for i, (x, y) in enumerate(points))
    edges = "".join(
        f'<edge id="e{i}" from="n{i}" to="n{i + 1}" numLanes="{lanes}" speed="30" type="highway.motorway"/>'
        for i in range(EDGES)
    )
    options = {"no-internal-links": str(name != WITH_JUNCTION_LANES).lower()}
    return _write(folder / f"{name}.net.xml", nodes, edges, options)


def winding(rng: np.random.Generator, x: float, y: float, heading: float, length: float) -> Points:
    """A ramp as maps hold it: arcs of 13 to 60 m radius and straights, drawn with corners 5 to 12 m apart."""
    points, side, driven = [(x, y)], 1, 0.0
    while driven < length:
        radius = np.exp(rng.uniform(np.log(13), np.log(60)))
        parts = ((radius * np.radians(rng.uniform(40, 150)), side / radius), (rng.uniform(15, 60), 0.0))
        for metres, curvature in parts:
            pieces = int(np.ceil(metres / rng.uniform(5, 12)))
            for _ in range(pieces):
                heading += 0.5 * curvature * metres / pieces
                x, y = x + metres / pieces * np.cos(heading), y + metres / pieces * np.sin(heading)
                heading += 0.5 * curvature * metres / pieces
                points.append((x, y))
            driven += metres
        side = -side if rng.random() < 0.8 else side
    return points


def ramps(name: str, folder: Path) -> Path:
    """Winding ramps; those of `JOINING` become one half-way."""
    lanes, seed = RAMPS[name]
    rng = np.random.default_rng(seed)
    stem = winding(rng, 0.0, 0.0, 0.0, 250.0)
    shapes = {"stem": stem}
    begins = (-0.3, 0.3) if name == JOINING else (0.0,)
    for i, heading in enumerate(begins):
        shapes[f"branch{i}"] = [(x, y) for x, y in winding(rng, 0.0, 0.0, np.pi + heading, 250.0)][::-1]
    nodes = [("middle", stem[0]), ("end", stem[-1])]
    nodes += [(f"begin{i}", shapes[f"branch{i}"][0]) for i in range(len(begins))]
    ways = {"stem": ("middle", "end")} | {f"branch{i}": (f"begin{i}", "middle") for i in range(len(begins))}
    return _write(
        folder / f"{name}.net.xml",
        "".join(f'<node id="{i}" x="{x:.2f}" y="{y:.2f}"/>' for i, (x, y) in nodes),
        "".join(
            f'<edge id="{edge}" from="{a}" to="{b}" numLanes="{lanes}" speed="18" width="3.66"'
            f' type="highway.motorway_link" shape="{" ".join(f"{x:.2f},{y:.2f}" for x, y in shapes[edge])}"/>'
            for edge, (a, b) in ways.items()
        ),
        {},
    )


def _write(output: Path, nodes: str, edges: str, options: dict[str, str]) -> Path:
    with tempfile.TemporaryDirectory() as plain:
        paths = {kind: Path(plain) / f"{kind}.xml" for kind in ("nodes", "edges")}
        paths["nodes"].write_text(f"<nodes>{nodes}</nodes>", encoding="utf-8")
        paths["edges"].write_text(f"<edges>{edges}</edges>", encoding="utf-8")
        files = {f"{kind[:-1]}-files": path for kind, path in paths.items()}
        run_netconvert(files | options, output)
    return output


def generate(folder: Path) -> list[Path]:
    """All of them."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        *(tight_loops(name, folder) for name in LOOPS),
        *(kinks(name, folder) for name in KINKS),
        *(ramps(name, folder) for name in RAMPS),
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Generate the hard training networks with netconvert.")
    parser.add_argument("--out", type=Path, default=NETWORKS / "hard", help="folder to write to")
    print(*generate(parser.parse_args().out), sep="\n")
