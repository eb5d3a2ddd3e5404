"""Draws results/context.png: one scene driven under four contexts of one vehicle, all else equal.

python -m tools.results.context [POLICY]
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import SimConfig
from phase_sumo.evaluate.fixed_worlds import Start, drive, policy_driver
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.report.map_picture import draw_road, turned
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.dimensions import Kind, mean_shape
from phase_sumo.sim.vehicles import HISTORY, Task, VehicleShape, VehicleState, boxes
from tools.places import NETWORKS, RESULTS

matplotlib.use("Agg")

NETWORK = NETWORKS / "f01_straight3.net.xml"
SHOWN = (0.0, 2.0, 4.0, 6.0)  # s at which vehicles are drawn
BEGIN = 60.0  # m along the road at which the ego starts
GOAL_TIME = 6.5  # s of target speed to the goals
INK, GRID = "#2b2f36", "#e3e6ea"
EGO = ("#e4572e", "#2e6fbb", "#2a9d74", "#8e5cc2")
DASHES = ("solid", "solid", (0, (4, 2)), "solid")
TRUCK, OTHER = "#e0952b", "#9aa3ad"


@dataclass(frozen=True)
class Vehicle:
    """Where a vehicle is, relative to the ego's front, and its context.

    Attributes:
        lane: 0 is the rightmost.
        ahead: m from front bumper to front bumper.
        speed, target: m/s.
        goal_lane: lane of its goal.
    """

    lane: int
    ahead: float
    speed: float
    target: float
    goal_lane: int
    alpha: float = 0.6
    kind: Kind = "car"


CONTEXTS = {
    "α = 1, target 34 m/s, goal in the left lane": Vehicle(1, 0.0, 25.0, 34.0, 2, 1.0),
    "α = 0.2, target 20 m/s, goal in its own lane": Vehicle(1, 0.0, 25.0, 20.0, 1, 0.2),
    "α = 1, target 34 m/s, goal in the right lane": Vehicle(1, 0.0, 25.0, 34.0, 0, 1.0),
    "tractor-trailer, α = 1, target 34 m/s, goal in the left lane": Vehicle(
        1, 0.0, 25.0, 34.0, 2, 1.0, "articulated_truck"
    ),
}
OTHERS = (
    Vehicle(1, 45.0, 20.0, 20.0, 1, kind="articulated_truck"),  # the one to overtake
    Vehicle(2, -48.0, 29.0, 30.0, 2),  # the one that comes from behind
    Vehicle(0, -56.0, 25.0, 26.0, 0),
)


def start(bundle: MapBundle) -> Start:
    """A world per context."""
    graph = bundle.graph
    lanes = sorted(set(graph.node_lane.tolist()), key=lambda k: _across(bundle, k))

    def pose(lane: int, along: float) -> tuple[float, float, float]:
        nodes = np.flatnonzero(graph.node_lane == lanes[lane])
        node = nodes[min(round(along), len(nodes) - 1)]
        return (*graph.node_xy[node].tolist(), float(graph.node_yaw[node]))

    worlds = [(ego, *OTHERS) for ego in CONTEXTS.values()]
    sizes = [[mean_shape(v.kind) for v in world] for world in worlds]
    bodies = VehicleShape(
        **{name: torch.tensor([[size[name] for size in row] for row in sizes]) for name in sizes[0][0]}
    )
    place = _columns([[pose(v.lane, BEGIN + v.ahead) for v in world] for world in worlds])
    goal = _columns(
        [[pose(v.goal_lane, BEGIN + v.ahead + GOAL_TIME * v.target) for v in world] for world in worlds]
    )
    x, y, yaw = place
    still = torch.zeros_like(x)
    state = VehicleState(
        x=x - bodies.front_overhang * torch.cos(yaw),
        y=y - bodies.front_overhang * torch.sin(yaw),
        yaw=yaw,
        speed=torch.tensor([[v.speed for v in world] for world in worlds]),
        accel=still,
        steer=still,
        hitch=still,
        accel_history=torch.zeros(*x.shape, HISTORY),
        steer_history=torch.zeros(*x.shape, HISTORY),
    )
    target, alpha = _columns([[(v.target, v.alpha) for v in world] for world in worlds])
    gx, gy, gyaw = goal
    task, index = Task(gx, gy, gyaw, target, alpha), torch.arange(len(worlds))
    return Start(bodies, state, task, torch.ones_like(bodies.truck), 0 * index, index)


def _columns(rows: list[list[tuple[float, ...]]]) -> list[torch.Tensor]:
    return list(torch.tensor(rows).unbind(-1))


def _across(bundle: MapBundle, lane: int) -> float:
    """m to the left of a lane, seen along the road."""
    node = int(np.flatnonzero(bundle.graph.node_lane == lane)[0])
    yaw = float(bundle.graph.node_yaw[node])
    return float(turned(bundle.graph.node_xy[node].astype(float), yaw)[1])


def roll_out(
    bundle: MapBundle, policy_file: str | None
) -> tuple[Start, list[VehicleState], list[torch.Tensor]]:
    """States of all worlds, a step apart, and who is there."""
    policy, begin = load_policy(policy_file), start(bundle)
    states, there = [begin.state], [begin.active]
    sim = SimConfig()
    for step in drive(begin, bundle.road_map, policy_driver(policy), sim, policy.actions):
        states.append(step.after)
        there.append(step.active & ~step.finished)
    return begin, states, there


def draw(bundle: MapBundle, begin: Start, states: list[VehicleState], there: list[torch.Tensor]) -> Figure:
    yaw, dt = float(begin.state.yaw[0, 0]), SimConfig().dt
    figure = Figure(figsize=(13.0, 7.0), dpi=130)
    grid = figure.add_gridspec(
        len(CONTEXTS) + 1, 3, height_ratios=[1] * len(CONTEXTS) + [2.7], hspace=0.42, wspace=0.24,
        left=0.055, right=0.985, top=0.965, bottom=0.07,
    )  # fmt: skip
    origin = turned(np.array([float(begin.state.x[0, 0]), float(begin.state.y[0, 0])]), yaw)
    for world, name in enumerate(CONTEXTS):
        axes = figure.add_subplot(grid[world, :])
        _strip(axes, bundle, begin, states, there, world, yaw, origin)
        axes.set_title(name, fontsize=10, color=EGO[world], loc="left", fontweight="bold", pad=3)
    panels = [figure.add_subplot(grid[len(CONTEXTS), k]) for k in range(3)]
    for world in range(len(CONTEXTS)):
        lasts = [k for k, t in enumerate(there) if bool(t[world, :3].all())]
        time = dt * np.array(lasts)
        fronts = [_front(begin.shape, states[k], world, yaw) for k in lasts]
        for axes, values in zip(
            panels,
            (
                [float(states[k].speed[world, 0]) for k in lasts],
                [f[0] - f[1] for f in fronts],
                [f[2] - f[0] for f in fronts],
            ),
            strict=True,
        ):
            axes.plot(time, values, color=EGO[world], lw=2.2, ls=DASHES[world])
    for axes, label in zip(
        panels,
        (
            "speed, m/s",
            "ahead of the truck, m",
            "left car ahead of it, m",
        ),
        strict=True,
    ):
        axes.set_xlabel("time, s", color=INK)
        axes.set_ylabel(label, color=INK, fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color=GRID, lw=0.8)
        axes.tick_params(colors=INK, labelsize=9)
        axes.set_xlim(0, 7)
    for axes in panels[1:]:
        axes.axhline(0.0, color=INK, lw=1.0)
    return figure


def _front(shape: VehicleShape, state: VehicleState, world: int, yaw: float) -> np.ndarray:
    """[N] m along the road of the front bumpers."""
    xy = torch.stack((state.x, state.y), -1)[world].numpy().astype(float)
    return turned(xy, yaw)[:, 0] + shape.front_overhang[world].numpy()


def _strip(
    axes: Axes,
    bundle: MapBundle,
    begin: Start,
    states: list[VehicleState],
    there: list[torch.Tensor],
    world: int,
    yaw: float,
    origin: np.ndarray,
) -> None:
    """The road from above with everybody at the times `SHOWN`, and the ego's way."""
    axes.axis("off")
    draw_road(axes, bundle, yaw)
    axes.set(xlim=(origin[0] - 62, origin[0] + 222), ylim=(origin[1] - 6.2, origin[1] + 7.4), aspect="equal")
    way = [
        turned(np.array([float(s.x[world, 0]), float(s.y[world, 0])]), yaw)
        for s, t in zip(states, there, strict=True)
        if bool(t[world, 0])
    ]
    axes.plot(*np.array(way).T, color=EGO[world], lw=1.4, zorder=4)
    for number, at in enumerate(SHOWN):
        k = round(at / SimConfig().dt)
        if k >= len(states):
            continue
        box = boxes(begin.shape, states[k])[:, :, world].numpy()
        for slot in range(box.shape[-1]):
            if not bool(there[k][world, slot]):
                continue
            colour = EGO[world] if slot == 0 else TRUCK if slot == 1 else OTHER
            for part in (0, 1):
                if box[4, part, slot] > 0:
                    corner = _corners(box[:, part, slot], yaw)
                    axes.add_collection(
                        PolyCollection(
                            [corner], facecolors=colour, edgecolors=INK, linewidths=0.6,
                            alpha=0.35 + 0.65 * number / (len(SHOWN) - 1), zorder=5 + number,
                        )
                    )  # fmt: skip
            x, y = turned(box[:2, 0, slot].astype(float), yaw)
            axes.text(x, y + 1.2, f"{at:.0f} s", fontsize=6, ha="center", color=INK, zorder=12)


def _corners(box: np.ndarray, yaw: float) -> np.ndarray:
    x, y, cos, sin, half_length, half_width = box.astype(float)
    along = half_length * np.array([-1, 1, 1, -1])
    aside = half_width * np.array([-1, -1, 1, 1])
    return turned(np.stack((x + along * cos - aside * sin, y + along * sin + aside * cos), -1), yaw)


def main() -> None:
    bundle = build_bundle(read_network(NETWORK))
    begin, states, there = roll_out(bundle, sys.argv[1] if len(sys.argv) > 1 else None)
    draw(bundle, begin, states, there).savefig(RESULTS / "context.png")


if __name__ == "__main__":
    main()
