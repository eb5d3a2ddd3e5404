"""Vehicles of a recorded window as SUMO's demand: each with its own type, place, speed and route."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from phase_sumo.evaluate.realism.places import Places
from phase_sumo.logs.recording import Kind, Window
from phase_sumo.studies.log_road import SPEED_LIMIT, SumoRoad

CLASSES: dict[Kind, str] = {"car": "passenger", "rigid_truck": "truck", "articulated_truck": "trailer"}
LONGEST_RIGID = 12.5  # m: SUMO's class truck bends for us from here on, a bus does not
SPEEDS = (3.0, 40.0)  # m/s that a driver may want, those that the policy is trained for
NEAR_END = 5.0  # m of a lane at either end that netconvert may cut off for a junction


@dataclass(frozen=True)
class Start:
    """Where N vehicles start, and what they want.

    Attributes:
        x, y: [N] front bumper centres in m.
        yaw: [N] rad.
        speed, desired: [N] m/s.
        lane: [N] number of the lane in the first edge of the route.
        position: [N] m along that lane.
        edges: [N] routes.
        left_hand: traffic drives on the left.
    """

    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    speed: np.ndarray
    desired: np.ndarray
    lane: np.ndarray
    position: np.ndarray
    edges: tuple[tuple[str, ...], ...]
    left_hand: bool


def start_of(window: Window, road: SumoRoad, places: Places) -> Start:
    """The agents of a window at its begin.

    Args:
        places: where the samples of the window's recording lie on the road's lanes.
    """
    r, at = window.recording, window.begin
    lane = places.lane[:, at]
    final = places.lane[np.arange(len(lane)), window.last]
    half = 0.5 * r.length
    yaw = r.yaw[:, at]
    routes = tuple(
        tuple(road.route(road.edge[a], road.edge[b]))
        for a, b in zip(lane.tolist(), final.tolist(), strict=True)
    )
    return Start(
        r.x[:, at] + half * np.cos(yaw),
        r.y[:, at] + half * np.sin(yaw),
        yaw,
        r.speed[:, at],
        desired_speeds(window),
        np.array(road.number)[lane],
        np.clip(places.position[:, at] + half, NEAR_END, np.array(road.length)[lane] - NEAR_END),
        routes,
        r.network.left_hand,
    )


def desired_speeds(window: Window) -> np.ndarray:
    """[N] m/s: what drivers of its lane like to drive (`Window.lane_speed`), or a vehicle's own first speed.

    The greater of the two, within 3..40 m/s. Logs do not tell what a driver in a queue would like to drive;
    every model gets the same.
    """
    return np.clip(np.maximum(window.lane_speed, window.recording.speed[:, window.begin]), *SPEEDS)


def write_demand(window: Window, start: Start, model: str, path: Path) -> list[str]:
    """Write a route file in which all vehicles depart at once; returns their ids.

    They are inserted in the middle of their lanes, in the right order, and moved to their places before they
    drive.
    """
    r, names, lines = window.recording, [], []
    for k, row in enumerate(window.agents.tolist()):
        name, kind, length = f"v{row}", r.kind[k], float(r.length[k])
        vclass = "bus" if kind == "rigid_truck" and length > LONGEST_RIGID else CLASSES[kind]
        lines.append(
            f'<vType id="t{row}" vClass="{vclass}" carFollowModel={quoteattr(model)} length="{length:.2f}" '
            f'width="{r.width[k]:.2f}" maxSpeed="60" speedDev="0"/>'
        )
        names.append(name)
    for k, row in enumerate(window.agents.tolist()):
        lines.append(
            f'<vehicle id="v{row}" type="t{row}" depart="0" departLane="{start.lane[k]}" '
            f'departPos="{start.position[k]:.2f}" departSpeed="0" insertionChecks="none" '
            f'speedFactor="{start.desired[k] / SPEED_LIMIT:.5f}">'
            f'<route edges="{" ".join(start.edges[k])}"/></vehicle>'
        )
    path.write_text("<routes>\n" + "\n".join(lines) + "\n</routes>\n")
    return names
