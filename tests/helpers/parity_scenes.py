"""Vehicles placed by hand on a small network."""

from __future__ import annotations

from pathlib import Path

from tests.helpers.places import NETWORKS

ROADS = {
    "f12_scurve2": "main0",
    "f04_onramp3": "main0 main1 main2",
    "f20_lefthand2": "main1 main2 main3 main4",
}
TYPES = """
    <vType id="car" vClass="passenger" length="4.8" width="1.9"/>
    <vType id="fast" vClass="passenger" length="4.4" width="1.8" maxSpeed="31">
        <param key="phase.target_speed" value="38"/></vType>
    <vType id="astray" vClass="passenger" length="4.8" width="1.9">
        <param key="phase.alpha" value="0.3"/></vType>
    <vType id="rigid" vClass="truck" length="10.0" width="2.5" maxSpeed="25"/>
    <vType id="semi" vClass="trailer" length="18.0" width="2.55" maxSpeed="25"/>
    <vType id="native" vClass="passenger" length="5.2" width="1.8">
        <param key="has.phase.device" value="false"/></vType>
"""
Vehicle = tuple[str, str, int, float, float]  # id, type, lane, front bumper in m, speed in m/s
# near enough that all see each other and some overtake; one would exceed the limit and its vType's maximum
SCENE: tuple[Vehicle, ...] = (
    ("semi0", "semi", 0, 60.0, 20.0),
    ("rigid0", "rigid", 1, 40.0, 21.0),
    ("car0", "car", 0, 100.0, 17.0),
    ("car1", "car", 1, 90.0, 25.0),
    ("car2", "car", 0, 22.0, 24.0),
    ("car3", "fast", 1, 12.0, 28.0),
    ("native0", "native", 0, 130.0, 18.0),
    ("native1", "native", 1, 128.0, 24.0),
)
# rear-end collisions with a car, a rigid truck and a trailer, and a car that leaves the road
RECKLESS_SCENE: tuple[Vehicle, ...] = (
    ("rear0", "fast", 0, 15.0, 30.0),
    ("semi0", "semi", 0, 70.0, 18.0),
    ("rear1", "fast", 1, 20.0, 30.0),
    ("rigid0", "rigid", 1, 60.0, 18.0),
    ("rear2", "fast", 0, 90.0, 30.0),
    ("car0", "car", 0, 110.0, 20.0),
    ("astray0", "astray", 1, 120.0, 24.0),
)


def write_scenario(
    folder: Path, road: str, scene: tuple[Vehicle, ...], step: float = 0.1, options: str = ""
) -> Path:
    """A ``.sumocfg`` with all vehicles departing at once; ``options`` are further elements of it."""
    vehicles = "".join(
        f'<vehicle id="{name}" type="{kind}" depart="0" departLane="{lane}" departPos="{at}" '
        f'departSpeed="{speed}" insertionChecks="none"><route edges="{ROADS[road]}"/></vehicle>'
        for name, kind, lane, at, speed in scene
    )
    (folder / "demand.rou.xml").write_text(f"<routes>{TYPES}{vehicles}</routes>")
    cfg = folder / "test.sumocfg"
    cfg.write_text(
        f'<configuration><net-file value="{NETWORKS / f"{road}.net.xml"}"/>'
        f'<route-files value="demand.rou.xml"/><step-length value="{step}"/>{options}</configuration>'
    )
    return cfg
