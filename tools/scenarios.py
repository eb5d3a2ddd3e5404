"""Generate the shipped scenarios: a network, its demand and the configuration that runs them.

    python -m tools.scenarios

``merge`` is the scenario of the demo: a three-lane freeway of 2.5 km in a gentle curve, an on-ramp with an
acceleration lane at 0.8 km and an off-ramp with a deceleration lane at 1.8 km. About 300 cars and
articulated trucks enter within six and a half minutes. The files are the same on every run.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tools.networks.build import build
from tools.networks.plain_xml import netconvert
from tools.networks.spec import Section, Spec
from tools.places import SCENARIOS

MERGE = Spec(
    "merge",
    (
        Section(800, 3),
        Section(250, 4, on_ramp=1),
        Section(500, 3),
        Section(250, 4, off_ramp=1),
        Section(700, 3),
    ),
    pieces=((500, 0), (700, 1500), (400, 0), (600, -2000), (300, 0)),
    speed=29.06,
    ramp_speed=18.0,
    ramp_length=240.0,
    ramp_radius=200.0,
)
ROUTES = {
    "through": "main0 main1 main2 main3 main4",
    "leave": "main0 main1 main2 main3 offramp3",
    "join": "onramp1 main1 main2 main3 main4",
}
# SUMO's model is IDM; a command line option replaces it. A truck's box is tractor and trailer together.
TYPES = """\
    <vType id="car" vClass="passenger" carFollowModel="IDM" length="4.8" width="1.9" maxSpeed="40"
           accel="2.0" decel="3.0" tau="1.2" minGap="2.5" speedFactor="normc(1.0,0.08,0.8,1.2)"
           color="0.25,0.5,0.85"/>
    <vType id="truck" vClass="trailer" carFollowModel="IDM" length="16.5" width="2.55" maxSpeed="25"
           accel="0.9" decel="2.5" tau="1.6" minGap="3" speedFactor="normc(0.85,0.04,0.75,0.95)"
           color="0.9,0.55,0.15"/>
    <vType id="long_truck" vClass="trailer" carFollowModel="IDM" length="22" width="2.6" maxSpeed="25"
           accel="0.8" decel="2.5" tau="1.7" minGap="3" speedFactor="normc(0.84,0.04,0.74,0.94)"
           color="0.8,0.3,0.2"/>
"""


@dataclass(frozen=True)
class Demand:
    """Vehicles of all types per hour on one route.

    Attributes:
        route: name in `ROUTES`.
        flow: vehicles/h, arrivals drawn from a Poisson process.
        speed: m/s, SUMO's departSpeed.
        lane: SUMO's departLane.
    """

    route: str
    flow: float
    speed: str
    lane: str


DEMANDS = (
    Demand("through", 1950.0, "desired", "best"),
    Demand("leave", 340.0, "desired", "best"),
    Demand("join", 430.0, "desired", "first"),
)
SHARES = {"car": 0.88, "truck": 0.07, "long_truck": 0.05}
DEMAND_END = 400.0  # s
END = 600.0  # s, everyone has arrived
SEED = 1


def routes() -> str:
    """Vehicle types, routes and one flow per route and type."""
    rows = [f'    <route id="{name}" edges="{edges}"/>' for name, edges in ROUTES.items()]
    for demand in DEMANDS:
        rows += [
            f'    <flow id="{demand.route}_{kind}" type="{kind}" route="{demand.route}" begin="0" '
            f'end="{DEMAND_END:g}" period="exp({share * demand.flow / 3600.0:.5f})" '
            f'departLane="{demand.lane}" departSpeed="{demand.speed}"/>'
            for kind, share in SHARES.items()
        ]
    return "<routes>\n" + TYPES + "\n".join(rows) + "\n</routes>\n"


def configuration(name: str) -> str:
    return f"""<configuration>
    <input>
        <net-file value="{name}.net.xml"/>
        <route-files value="{name}.rou.xml"/>
    </input>
    <time>
        <begin value="0"/>
        <end value="{END:g}"/>
        <step-length value="0.1"/>
    </time>
    <processing>
        <collision.action value="warn"/>
        <collision.check-junctions value="true"/>
        <time-to-teleport value="-1"/>
    </processing>
    <random_number>
        <seed value="{SEED}"/>
    </random_number>
    <report>
        <no-step-log value="true"/>
    </report>
</configuration>
"""


def generate(folder: Path = SCENARIOS) -> Path:
    """Write the scenario ``merge`` into ``folder/merge``; returns its ``.sumocfg``."""
    target = folder / MERGE.name
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as plain:
        paths = build(MERGE).write(Path(plain) / MERGE.name)
        netconvert(paths, target / f"{MERGE.name}.net.xml")
    (target / f"{MERGE.name}.rou.xml").write_text(routes(), encoding="utf-8")
    config = target / f"{MERGE.name}.sumocfg"
    config.write_text(configuration(MERGE.name), encoding="utf-8")
    return config


def main() -> None:
    parser = argparse.ArgumentParser(description="Generate the shipped scenarios.")
    parser.add_argument(
        "--out", type=Path, default=SCENARIOS, help="folder to write to (default: the shipped ones)"
    )
    print(generate(parser.parse_args().out))


if __name__ == "__main__":
    main()
