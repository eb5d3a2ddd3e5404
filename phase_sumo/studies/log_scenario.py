"""A recorded window as a SUMO scenario.

Its road becomes plain nodes, edges and connections, put together by netconvert; its vehicles a demand, each
with its own type, place, speed and route.
"""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from phase_sumo.bridge.maps.import_map import netconvert
from phase_sumo.logs.lane_matching import LanePlaces
from phase_sumo.logs.recording import PERIOD, Window
from phase_sumo.sim.dimensions import ARTICULATED_FROM, Kind
from phase_sumo.sim.lanes import LaneNetwork

SPEED_LIMIT = 45.0  # m/s on every lane: what a driver wants is the vehicle's, by its speed factor


@dataclass(frozen=True)
class SumoRoad:
    """A network as SUMO has it.

    Attributes:
        path: the ``.net.xml``.
        edge, number: [L] SUMO's edge of each lane of the `LaneNetwork`, and the lane's number in it.
        length: [L] m of each lane.
        following: edge -> edges that follow.
    """

    path: Path
    edge: tuple[str, ...]
    number: tuple[int, ...]
    length: tuple[float, ...]
    following: dict[str, list[str]]

    def route(self, start: str, goal: str) -> list[str]:
        """Edges from ``start`` by way of ``goal``, if it can be reached, on to the road's end.

        Beyond the goal it goes on by the edge that most edges lead on from.
        """
        way = self._shortest(start, goal) or [start]
        while onward := [e for e in self.following.get(way[-1], []) if e not in way]:
            way.append(max(onward, key=lambda e: (len(self.following.get(e, [])), self.edge.count(e))))
        return way

    def _shortest(self, start: str, goal: str) -> list[str]:
        came: dict[str, str] = {start: ""}
        queue = deque([start])
        while queue and goal not in came:
            here = queue.popleft()
            for onward in self.following.get(here, []):
                if onward not in came:
                    came[onward] = here
                    queue.append(onward)
        way, at = [], goal if goal in came else ""
        while at:
            way.append(at)
            at = came[at]
        return way[::-1]


def write_road(network: LaneNetwork, folder: Path) -> SumoRoad:
    """Write ``road.net.xml``; lane centre lines stay where they are but for a junction's metres at an end.

    Raises:
        PhaseError: netconvert refuses it.
    """
    groups = _edges(network)
    edge = [""] * len(network.lanes)
    number = [0] * len(network.lanes)
    for k, lanes in enumerate(groups):
        for j, i in enumerate(lanes):
            edge[i], number[i] = f"e{k}", j
    start, end = _nodes(network, edge)
    at: dict[int, list[np.ndarray]] = defaultdict(list)
    for i, lane in enumerate(network.lanes):
        at[start[edge[i]]].append(lane.points[0])
        at[end[edge[i]]].append(lane.points[-1])
    nodes = [
        f'<node id="n{n}" x="{x:.3f}" y="{y:.3f}" type="priority"/>'
        for n, (x, y) in ((n, np.mean(points, 0)) for n, points in at.items())
    ]
    edges = [_edge(network, f"e{k}", lanes, start, end) for k, lanes in enumerate(groups)]
    links = [
        f'<connection from="{edge[a]}" to="{edge[b]}" fromLane="{number[a]}" toLane="{number[b]}"/>'
        for a, b in network.successors
    ]
    files = {"node": ("nodes", nodes), "edge": ("edges", edges), "connection": ("connections", links)}
    options = []
    for kind, (root, rows) in files.items():
        path = folder / f"road.{kind[:3]}.xml"
        path.write_text(f"<{root}>\n" + "\n".join(rows) + f"\n</{root}>\n", encoding="utf-8")
        options += [f"--{kind}-files", str(path)]
    output = folder / "road.net.xml"
    options += ["--offset.disable-normalization", "--no-turnarounds", "--no-warnings", "--precision", "3"]
    options += ["--junctions.limit-turn-speed", "-1", "--geometry.avoid-overlap", "false"]
    options += ["--lefthand"] if network.left_hand else []
    netconvert(output, [*options, "--output-file", str(output)])
    following: dict[str, list[str]] = defaultdict(list)
    for a, b in network.successors:
        if edge[b] not in following[edge[a]]:
            following[edge[a]].append(edge[b])
    length = tuple(float(np.hypot(*np.diff(lane.points, axis=0).T).sum()) for lane in network.lanes)
    return SumoRoad(output, tuple(edge), tuple(number), length, dict(following))


def _edges(network: LaneNetwork) -> list[list[int]]:
    """Lanes that lie abreast, in SUMO's order: from the right to the left, or, driving on the left, back."""
    root = list(range(len(network.lanes)))
    first: dict[str, int] = {}
    for i, lane in enumerate(network.lanes):
        for beside in (lane.left, lane.right, first.setdefault(lane.edge, i)):
            if beside >= 0:
                _join(root, i, beside)
    groups: dict[int, list[int]] = defaultdict(list)
    for i in range(len(root)):
        groups[_find(root, i)].append(i)
    left_hand = network.left_hand
    return [
        sorted(lanes, key=lambda i: _aside(network, lanes[0], i), reverse=left_hand)
        for lanes in groups.values()
    ]


def _aside(network: LaneNetwork, reference: int, lane: int) -> float:
    """m by which the middle of a lane lies left of the reference's line."""
    line, other = network.lanes[reference].points, network.lanes[lane].points
    along = (line[-1] - line[0]) / np.hypot(*(line[-1] - line[0]))
    near = line[np.hypot(*(line - other.mean(0)).T).argmin()]
    away = other[np.hypot(*(other - near).T).argmin()] - near
    return float(along[0] * away[1] - along[1] * away[0])


def _nodes(network: LaneNetwork, edge: list[str]) -> tuple[dict[str, int], dict[str, int]]:
    """Numbers of the nodes where each edge starts and ends: linked lanes share one."""
    names = list(dict.fromkeys(edge))
    number = {name: k for k, name in enumerate(names)}
    root = list(range(2 * len(names)))
    for a, b in network.successors:
        _join(root, 2 * number[edge[a]] + 1, 2 * number[edge[b]])
    start = {name: _find(root, 2 * k) for name, k in number.items()}
    return start, {name: _find(root, 2 * k + 1) for name, k in number.items()}


def _edge(
    network: LaneNetwork, name: str, lanes: list[int], start: dict[str, int], end: dict[str, int]
) -> str:
    rows = []
    for j, i in enumerate(lanes):
        lane = network.lanes[i]
        shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in lane.points)
        rows.append(f'<lane index="{j}" speed="{SPEED_LIMIT:g}" width="{lane.width:.3f}" shape="{shape}"/>')
    return (
        f'<edge id="{name}" from="n{start[name]}" to="n{end[name]}" numLanes="{len(lanes)}" '
        f'type="highway.motorway" speed="{SPEED_LIMIT:g}">{"".join(rows)}</edge>'
    )


def _find(root: list[int], i: int) -> int:
    while root[i] != i:
        root[i] = root[root[i]]
        i = root[i]
    return i


def _join(root: list[int], i: int, j: int) -> None:
    root[_find(root, i)] = _find(root, j)


CLASSES: dict[Kind, str] = {"car": "passenger", "rigid_truck": "truck", "articulated_truck": "trailer"}
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


def start_of(window: Window, road: SumoRoad, places: LanePlaces) -> Start:
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

    They are inserted in the middle of their lanes, in the right order, a step's way behind their places, and
    moved there before they drive: the way that SUMO sees them come is their speed.
    """
    r, names, lines = window.recording, [], []
    for k, row in enumerate(window.agents.tolist()):
        name, kind, length = f"v{row}", r.kind[k], float(r.length[k])
        vclass = "bus" if kind == "rigid_truck" and length > ARTICULATED_FROM else CLASSES[kind]
        lines.append(
            f'<vType id="t{row}" vClass="{vclass}" carFollowModel={quoteattr(model)} length="{length:.2f}" '
            f'width="{r.width[k]:.2f}" maxSpeed="60" speedDev="0"/>'
        )
        names.append(name)
    behind = np.maximum(start.position - start.speed * PERIOD, 0.0)
    for k, row in enumerate(window.agents.tolist()):
        lines.append(
            f'<vehicle id="v{row}" type="t{row}" depart="0" departLane="{start.lane[k]}" '
            f'departPos="{behind[k]:.2f}" departSpeed="0" insertionChecks="none" '
            f'speedFactor="{start.desired[k] / SPEED_LIMIT:.5f}">'
            f'<route edges="{" ".join(start.edges[k])}"/></vehicle>'
        )
    path.write_text("<routes>\n" + "\n".join(lines) + "\n</routes>\n", encoding="utf-8")
    return names
