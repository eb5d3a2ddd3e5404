"""A long run with many PHASE vehicles: flat memory, every vehicle accounted for, same seed, same bytes.

python -m tests.soak --seconds 3600 --vehicles 500            # the hand-written driver
python -m tests.soak --seconds 3600 --vehicles 500 --shipped  # the shipped policy
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import sumolib

from phase_sumo.bridge.run import run_scenario
from tests.helpers.scenario_files import write_scenario
from tests.helpers.standin import Standin

SPEED = 25.0  # m/s, about what the flow drives
FLOW = 2.0  # vehicles/s on four lanes
GROWTH = 1.1  # of the resident memory from half-way to the end, at most


def scenario(folder: Path, vehicles: int, seconds: float) -> Path:
    """A straight motorway so long that it holds the vehicles, with a flow to its end."""
    length = SPEED * vehicles / FLOW
    (folder / "n.nod.xml").write_text(
        f'<nodes><node id="a" x="0" y="0"/><node id="b" x="{length}" y="0"/></nodes>'
    )
    (folder / "n.edg.xml").write_text(
        '<edges><edge id="road" from="a" to="b" numLanes="4" speed="29" type="highway.motorway"/></edges>'
    )
    net, binary = folder / "n.net.xml", sumolib.checkBinary("netconvert")
    args = ["-n", folder / "n.nod.xml", "-e", folder / "n.edg.xml", "-o", net, "--no-turnarounds", "true"]
    subprocess.run([binary, *args], check=True, capture_output=True)
    flows = "".join(
        f'<flow id="{kind}" type="{kind}" from="road" to="road" begin="0" end="{seconds}" '
        f'period="exp({share * FLOW})" departLane="free" departSpeed="avg"/>'
        for kind, share in (("car", 0.9), ("semi", 0.1))
    )
    return write_scenario(folder, flows, net=net, options=f'<end value="{seconds}"/>')


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def run(folder: str, vehicles: int, seconds: float, shipped: bool) -> dict[str, Any]:
    """One run, in this process; memory is sampled as it goes."""
    memory: list[tuple[float, float]] = []
    out = Path(folder) / "out"
    result = run_scenario(
        scenario(Path(folder), vehicles, seconds),
        policy=None if shipped else Standin(),
        seed=1,
        output_dir=out,
        record=False,
        progress=lambda share, text: memory.append((share, resident_mb())),
    )
    half = [mb for share, mb in memory if share >= 0.5]
    digest = hashlib.sha256(b"".join((out / name).read_bytes() for name in ("events.csv", "trips.csv")))
    return {
        "vehicles": result["vehicles"],
        "phase_vehicles": result["phase_vehicles"],
        "running_at_the_end": result["accounts"]["running"],
        "balance": result["accounts_balance"],
        "real_time_factor": result["real_time_factor"],
        "mb_half_way": half[0],
        "mb_at_the_end": half[-1],
        "sha256": digest.hexdigest(),
    }


def soak(vehicles: int, seconds: float, shipped: bool = False) -> list[dict[str, Any]]:
    """The same run twice, each in a process of its own."""
    rows = []
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for _ in range(2):
            with tempfile.TemporaryDirectory() as folder:
                rows.append(pool.apply(run, (folder, vehicles, seconds, shipped)))
    return rows


def check(rows: list[dict[str, Any]]) -> None:
    first, second = rows
    assert first["sha256"] == second["sha256"], "the same seed gave other bytes"
    for row in rows:
        assert row["balance"], "a vehicle is missing"
        assert row["mb_at_the_end"] < GROWTH * row["mb_half_way"], "memory grows"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=500, help="at a time")
    parser.add_argument("--seconds", type=float, default=3600.0, help="simulated")
    parser.add_argument("--shipped", action="store_true", help="the shipped policy drives")
    args = parser.parse_args()
    rows = soak(args.vehicles, args.seconds, args.shipped)
    print(json.dumps(rows, indent=1))
    check(rows)


if __name__ == "__main__":
    main()
