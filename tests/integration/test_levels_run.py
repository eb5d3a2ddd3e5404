"""Roads on two levels and roads far away, in SUMO: small networks made by netconvert."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from phase_sumo.bridge.fleet.event_log import read_events
from phase_sumo.bridge.maps.import_map import netconvert
from phase_sumo.bridge.run import run_scenario
from tests.helpers.standin import Standin


def scenario(folder: Path, nodes: dict[str, tuple[float, float]], edges: dict[str, tuple[str, str]]) -> Path:
    """A flow on every edge, which has two lanes."""
    folder.mkdir(exist_ok=True)
    places = "".join(f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in nodes.items())
    roads = "".join(
        f'<edge id="{name}" from="{a}" to="{b}" numLanes="2" width="4" speed="25" type="highway.motorway"/>'
        for name, (a, b) in edges.items()
    )
    (folder / "n.nod.xml").write_text(f"<nodes>{places}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{roads}</edges>")
    files = ["--node-files", str(folder / "n.nod.xml"), "--edge-files", str(folder / "n.edg.xml")]
    options = [*files, "--offset.disable-normalization", "true", "--output-file", str(folder / "n.net.xml")]
    netconvert(folder / "n.nod.xml", options)
    flows = "".join(
        f'<route id="{name}" edges="{name}"/><flow id="{name}" route="{name}" begin="0" end="25" '
        'period="1.3" departLane="random" departSpeed="max"/>'
        for name in edges
    )
    (folder / "n.rou.xml").write_text(f"<routes>{flows}</routes>")
    cfg = folder / "n.sumocfg"
    cfg.write_text(
        '<configuration><net-file value="n.net.xml"/><route-files value="n.rou.xml"/>'
        '<step-length value="0.1"/></configuration>'
    )
    return cfg


@pytest.mark.parametrize("degrees", [15, 90])
def test_nobody_touches_or_reaches_a_road_on_another_level(tmp_path, degrees):
    across = 350.0 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    nodes = {"a": (-350.0, 0.0), "b": (350.0, 0.0), "c": tuple(-across), "d": tuple(across)}
    cfg = scenario(tmp_path, nodes, {"lower": ("a", "b"), "upper": ("c", "d")})  # type: ignore[arg-type]
    for phase in (False, True):
        out = tmp_path / f"out{phase}"
        result = run_scenario(cfg, policy=Standin(), phase=phase, seed=1, output_dir=out, record=False)
        assert result["vehicles"] > 30
        assert result["collisions"] == 0
        edges = [e for e in read_events(out / "events.csv") if e.kind == "road edge"]
        assert not [e for e in edges if np.hypot(e.x, e.y) < 250.0]  # where they depart it may cut a corner
        assert result["accounts"]["arrived"] == result["vehicles"]


def test_a_run_is_the_same_far_from_the_origin(tmp_path):
    results = []
    for name, (x, y) in (("near", (0.0, 0.0)), ("far", (5_000_000.0, -400_000.0))):
        nodes = {"a": (x, y), "b": (x + 500.0, y + 100.0)}
        out = tmp_path / f"{name}.out"
        cfg = scenario(tmp_path / name, nodes, {"road": ("a", "b")})
        results.append(run_scenario(cfg, policy=Standin(), seed=1, output_dir=out, record=False))
        events = (out / "events.csv").read_text().splitlines()
        assert "adoption" in events[1]
        place = [float(v) for v in events[1].split(",")[6:8]]
        assert np.hypot(place[0] - x, place[1] - y) < 20.0  # in SUMO's coordinates
    near, far = results
    assert near["accounts"] == far["accounts"] and near["off_road"] == far["off_road"]
    assert near["mean_travel_time"] == pytest.approx(far["mean_travel_time"], abs=0.1)
    assert near["phase_vehicle_km"] == pytest.approx(far["phase_vehicle_km"], rel=1e-3)
