"""Vehicles in given places as a SUMO scenario that ``phase-sumo run`` drives."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

BOXES = {  # phase.type -> vClass, length and width in m
    "car": ("passenger", 4.8, 1.9),
    "rigid_truck": ("truck", 9.5, 2.5),
    "articulated_truck": ("trailer", 16.5, 2.55),
}


@dataclass(frozen=True)
class SceneVehicle:
    """A vehicle where it is, and the context that PHASE drives it with.

    Attributes:
        id: unique in the scene.
        kind: ``phase.type``.
        vclass, length, width: of its box, in m.
        lane: index on the first edge of its route.
        position, offset: of the front bumper along the lane and to the left of its centre, in m.
        speed: m/s.
        route: edges from where it is to its destination.
        alpha, target_speed: action range, and m/s.
    """

    id: str
    kind: str
    vclass: str
    length: float
    width: float
    lane: int
    position: float
    offset: float
    speed: float
    route: tuple[str, ...]
    alpha: float
    target_speed: float


def write_scene(folder: Path, name: str, net: Path, vehicles: Sequence[SceneVehicle], seconds: float) -> Path:
    """Write ``NAME.net.xml``, ``NAME.rou.xml`` and ``NAME.sumocfg``; all vehicles depart at 0 s as they are.

    Their target speeds take no heed of leaders (``phase.time_gap`` 0) and they have no guard, so that policy
    and contexts alone decide.

    Args:
        net: network file, copied.
        seconds: how long the scenario lasts.

    Returns:
        The ``.sumocfg``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    copy = folder / f"{name}.net.xml{'.gz' if net.suffix == '.gz' else ''}"
    if not copy.exists() or not copy.samefile(net):
        shutil.copyfile(net, copy)
    rows = [row for vehicle in vehicles for row in _vehicle(vehicle)]
    (folder / f"{name}.rou.xml").write_text(
        "<routes>\n" + "\n".join(rows) + "\n</routes>\n", encoding="utf-8"
    )
    cfg = folder / f"{name}.sumocfg"
    cfg.write_text(
        "<configuration>\n"
        f'    <input><net-file value={quoteattr(copy.name)}/><route-files value="{name}.rou.xml"/></input>\n'
        f'    <time><begin value="0"/><end value="{seconds:g}"/><step-length value="0.1"/></time>\n'
        '    <processing><collision.action value="warn"/><time-to-teleport value="-1"/></processing>\n'
        "</configuration>\n",
        encoding="utf-8",
    )
    return cfg


def _vehicle(v: SceneVehicle) -> list[str]:
    own = quoteattr(f"type_{v.id}")
    params = {"phase.type": v.kind, "phase.alpha": f"{v.alpha:.4f}"}
    params |= {"phase.target_speed": f"{v.target_speed:.3f}", "phase.time_gap": "0", "phase.guard": "off"}
    return [
        f'    <vType id={own} vClass={quoteattr(v.vclass)} length="{v.length:.2f}" '
        f'width="{v.width:.2f}" maxSpeed="40">',
        '        <param key="has.phase.device" value="true"/>',
        *(f'        <param key="{key}" value="{value}"/>' for key, value in params.items()),
        "    </vType>",
        f'    <vehicle id={quoteattr(v.id)} type={own} depart="0" departLane="{v.lane}" '
        f'departPos="{v.position:.3f}" departPosLat="{v.offset:.3f}" departSpeed="{v.speed:.3f}" '
        'insertionChecks="none">',
        f"        <route edges={quoteattr(' '.join(v.route))}/>",
        "    </vehicle>",
    ]
