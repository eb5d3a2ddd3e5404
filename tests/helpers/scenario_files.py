"""Small SUMO scenarios as files."""

from __future__ import annotations

from pathlib import Path

from tests.helpers.places import NETWORKS

RAMP_NET = NETWORKS / "f04_onramp3.net.xml"  # main0 main1 main2, onramp1 joins at main1
TYPES = """
    <vType id="car" vClass="passenger" length="4.8" width="1.9"/>
    <vType id="semi" vClass="trailer" length="20" width="2.55" maxSpeed="25"/>
"""
FLOW = '<flow id="f" type="car" from="main0" to="main2" begin="{begin}" end="{end}" period="2"/>'


def write_scenario(
    folder: Path,
    routes: str = FLOW.format(begin=0, end=20),
    *,
    net: Path = RAMP_NET,
    step: float = 0.1,
    additional: str = "",
    options: str = "",
) -> Path:
    """A ``.sumocfg`` with its demand beside it; ``options`` are further elements of it."""
    (folder / "demand.rou.xml").write_text(f"<routes>{TYPES}{routes}</routes>")
    more = ""
    if additional:
        (folder / "more.add.xml").write_text(f"<additional>{additional}</additional>")
        more = '<additional-files value="more.add.xml"/>'
    cfg = folder / "test.sumocfg"
    cfg.write_text(
        f'<configuration><net-file value="{net}"/><route-files value="demand.rou.xml"/>{more}'
        f'<step-length value="{step}"/>{options}</configuration>'
    )
    return cfg
