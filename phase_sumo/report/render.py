"""Pictures of a world from above, still and moving.

draw_world(environment, 0, maps[environment.map_index[0]], "world.png")
film(environment, 0, maps[environment.map_index[0]], act, "world.gif")
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from torch import Tensor

from phase_sumo.report.map_picture import draw_road, turned
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.observation import Observation
from phase_sumo.sim.vehicles import boxes

TYPES = {"car": "#2e6fbb", "rigid truck": "#2a9d8f", "tractor-trailer": "#e0952b"}
CRASH, OFF_ROAD = "#d7191c", "#8e3db8"
INK, GLASS = "#30343b", "#1d2127"
WIDTH, DPI, FILM_DPI = 13.0, 110, 80  # inches, dots per inch
HEADER = 0.42  # inches of height for title and legend
LENGTHS = 110.0, 300.0  # m of road shown: shortest, longest
MARGIN = 14.0  # m around what is shown
BAR = 20.0  # m, the scale
GLIDE = 0.08  # share of the way to the traffic that the window moves per frame


@dataclass(frozen=True)
class Frame:
    """One world at one moment, all [n] of its n active agents.

    Attributes:
        box: [6, 2, n] tractor and trailer, see `vehicles.boxes`.
        goal: [n, 2] m.
        kind: index into `TYPES`.
        collision, at_fault, road_edge: bool, it has happened to the agent.
        time: s since the scenario began.
    """

    box: np.ndarray
    goal: np.ndarray
    kind: np.ndarray
    collision: np.ndarray
    at_fault: np.ndarray
    road_edge: np.ndarray
    time: float

    @staticmethod
    def of(environment: Environment, world: int) -> Frame:
        """What is on the road now."""
        worlds = environment.worlds
        here = worlds.active[world].cpu()

        def pick(values: Tensor) -> np.ndarray:
            return values[..., world, :].cpu()[..., here].numpy()

        shape, outcome = worlds.shape, worlds.outcome
        return Frame(
            box=pick(boxes(shape, worlds.state)),
            goal=np.stack((pick(worlds.task.goal_x), pick(worlds.task.goal_y)), -1),
            kind=pick(shape.truck.int() + shape.articulated),
            collision=pick(outcome.collision),
            at_fault=pick(outcome.at_fault),
            road_edge=pick(outcome.road_edge),
            time=float(worlds.clock[world]) * environment.task.sim.dt,
        )

    @property
    def xy(self) -> np.ndarray:
        """[n, 2] centres of the tractor boxes in m."""
        return self.box[:2, 0].T


@dataclass(frozen=True)
class Window:
    """The part of the plane that is shown, turned so that traffic runs from left to right.

    Attributes:
        yaw: direction in rad that is drawn to the right.
        centre: [2] m in turned coordinates, see `turned`.
        length, width: m.
        everything: all vehicles and goals are in it.
    """

    yaw: float
    centre: np.ndarray
    length: float
    width: float
    everything: bool

    @staticmethod
    def on(frame: Frame) -> Window:
        """On all vehicles and goals, or around the middle of the traffic if they are too far apart."""
        cos, sin = frame.box[2:4, 0]
        # of doubled angles, so that both directions of a road have one axis
        yaw = 0.5 * float(np.arctan2((2 * sin * cos).sum(), (cos**2 - sin**2).sum()))
        vehicles, goals = turned(frame.xy, yaw), turned(frame.goal, yaw)
        points = np.concatenate((vehicles, goals)) if len(vehicles) else np.zeros((1, 2))
        centre = 0.5 * (points.min(0) + points.max(0))
        length = float(np.ptp(points[:, 0])) + 2 * MARGIN
        everything = length <= LENGTHS[1]
        if not everything:
            centre[0] = np.median(vehicles[:, 0])
            points = points[np.abs(points[:, 0] - centre[0]) < 0.5 * LENGTHS[1]]
            centre[1] = 0.5 * (points[:, 1].min() + points[:, 1].max())
        length = float(np.clip(length, *LENGTHS))
        width = float(np.clip(np.ptp(points[:, 1]) + 2 * MARGIN, 0.13 * length, 0.6 * length))
        return Window(yaw, centre, length, width, everything)

    def towards(self, frame: Frame) -> Window:
        """Moved a little towards the middle of the traffic."""
        if self.everything or not len(frame.xy):
            return self
        middle = np.median(turned(frame.xy, self.yaw), axis=0)
        return replace(self, centre=self.centre + GLIDE * (middle - self.centre))


def draw_world(environment: Environment, world: int, bundle: MapBundle, path: str | Path) -> None:
    """Write a PNG of one world as it is now.

    Args:
        environment: the worlds.
        world: which one.
        bundle: the map that it is on, ``maps[environment.map_index[world]]``.
        path: file to write.
    """
    frame = Frame.of(environment, world)
    window = Window.on(frame)
    figure, axes = _stage(bundle, window)
    _show(axes, frame, window, bundle.name)
    figure.savefig(path, format="png")


def film(
    environment: Environment,
    world: int,
    bundle: MapBundle,
    act: Callable[[Observation], Tensor],
    path: str | Path,
    steps: int | None = None,
) -> None:
    """Step all worlds until this one's scenario is over, and write what happened in it as a moving picture.

    Args:
        environment, world, bundle: see `draw_world`.
        act: tokens [W, N] int64 for an observation [W, N, ...].
        path: file to write, ``.gif`` or ``.png`` (animated).
        steps: no more steps than this; up to the scenario's end by default.
    """
    frames = [Frame.of(environment, world)]
    for _ in range(environment.task.sim.horizon if steps is None else steps):
        if environment.step(act(environment.observation)).over[world]:
            break
        frames.append(Frame.of(environment, world))
    animate(frames, bundle, path, environment.task.sim.dt)


def animate(frames: Sequence[Frame], bundle: MapBundle, path: str | Path, period: float) -> None:
    """Write frames, ``period`` s apart, as a moving picture whose window glides along with the traffic."""
    windows = [Window.on(frames[0])]
    for frame in frames[1:]:
        windows.append(windows[-1].towards(frame))
    figure, axes = _stage(bundle, windows[0])
    shown: list[Artist] = []

    def draw(k: int) -> list[Artist]:
        for artist in shown:
            artist.remove()
        shown[:] = _show(axes, frames[k], windows[k], bundle.name)
        return shown

    moving = FuncAnimation(figure, draw, frames=len(frames), init_func=lambda: shown)
    moving.save(str(path), writer=PillowWriter(fps=round(1 / period)), dpi=FILM_DPI)


def _stage(bundle: MapBundle, window: Window) -> tuple[Figure, Axes]:
    """A figure with the road, the scale and the legend."""
    height = WIDTH * window.width / window.length
    figure = Figure((WIDTH, height + HEADER), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, height / (height + HEADER)))
    axes.axis("off")
    draw_road(axes, bundle, window.yaw)
    axes.plot([0.02, 0.02 + BAR / window.length], [0.05, 0.05], transform=axes.transAxes, color=INK, lw=2.5)
    axes.text(0.02, 0.06, f"{BAR:.0f} m", transform=axes.transAxes, va="bottom", fontsize=9, color=INK)
    keys = _keys()
    figure.legend(
        handles=keys, loc="upper right", ncols=len(keys), frameon=False, fontsize=9, borderaxespad=0.2
    )
    return figure, axes


def _keys() -> list[Artist]:
    """Entries of the legend."""
    return [
        *(Patch(facecolor=colour, edgecolor=INK, label=name) for name, colour in TYPES.items()),
        Line2D([], [], color=INK, lw=0.8, marker="o", ms=4, mfc="none", label="to the goal"),
        Patch(facecolor="none", edgecolor=CRASH, lw=2.2, label="collided"),
        Patch(facecolor=CRASH, edgecolor=CRASH, lw=2.2, label="at fault"),
        Patch(facecolor="none", edgecolor=OFF_ROAD, lw=2.2, label="touched the road's edge"),
    ]


def _show(axes: Axes, frame: Frame, window: Window, name: str) -> list[Artist]:
    """Vehicles, goals and title of one moment; the artists that the next one replaces."""
    x, y = window.centre
    left, low = x - 0.5 * window.length, y - 0.5 * window.width
    axes.set(xlim=(left, left + window.length), ylim=(low, low + window.width))
    colours = [list(TYPES.values())[kind] for kind in frame.kind]
    own = to_rgba_array(colours).reshape(-1, 4)
    face = np.where(frame.at_fault[:, None], to_rgba(CRASH), own)
    edge, width = 0.45 * own + (0, 0, 0, 0.55), np.full(len(own), 0.7)
    for happened, colour in ((frame.road_edge, OFF_ROAD), (frame.collision, CRASH)):
        edge[happened], width[happened] = to_rgba(colour), 2.2
    tractor, trailer = frame.box[:, 0], frame.box[:, 1]
    bent = trailer[4] > 0
    xy, goal = turned(frame.xy, window.yaw), turned(frame.goal, window.yaw)
    links = LineCollection(list(np.stack((xy, goal), 1)), colors=own, linewidths=0.6, alpha=0.55, zorder=3)
    ends = axes.scatter(*goal.T, s=16, facecolors="none", edgecolors=colours, linewidths=1.1, zorder=4)
    glass = PolyCollection(_boxes(tractor, window, 0.4, 0.72, 0.84), facecolors=GLASS, zorder=6)
    bodies = [
        PolyCollection(_boxes(box, window), facecolors=fill, edgecolors=line, linewidths=lw, zorder=order)
        for box, fill, line, lw, order in (
            (tractor, face, edge, width, 5),
            (trailer[:, bent], 0.5 + 0.5 * face[bent], edge[bent], width[bent], 7),
        )
    ]
    for collection in (links, glass, *bodies):
        axes.add_collection(collection)
    text = f"{name}   {frame.time:.1f} s   {len(xy)} on the road"
    title = axes.text(0.008, 1.0, text, transform=axes.transAxes, va="bottom", fontsize=10, color=INK)
    return [links, ends, glass, *bodies, title]


def _boxes(
    box: np.ndarray, window: Window, rear: float = -1.0, front: float = 1.0, wide: float = 1.0
) -> list[np.ndarray]:
    """[4, 2] each, turned corners of boxes [6, n], or of a part between shares of their half length."""
    x, y, cos, sin, half_length, half_width = box
    along = half_length * np.array([[rear], [front], [front], [rear]])
    aside = half_width * wide * np.array([[-1.0], [-1.0], [1.0], [1.0]])
    corners = np.stack((x + along * cos - aside * sin, y + along * sin + aside * cos), -1)
    return list(turned(corners.transpose(1, 0, 2), window.yaw))
