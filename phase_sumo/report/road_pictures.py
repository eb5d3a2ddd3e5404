"""The road from above with vehicles drawn to scale, trailers bent."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D

from phase_sumo.bridge.maps.road_lines import drivable_surface, lane_boundaries
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.road_map import RoadKind

matplotlib.use("Agg")
PHASE = "#e4572e"
SUMO = "#2e6fbb"
ASPHALT, KERB, MARKING = "#d5d9df", "#59616d", "#ffffff"
VIEW_LENGTH, VIEW_WIDTH = 230.0, 44.0  # m


@dataclass(frozen=True)
class View:
    """A window on the road: centre in m, and the direction in rad that is drawn to the right."""

    x: float
    y: float
    yaw: float


def best_view(network: LaneNetwork, t: Trajectories) -> View:
    """Before the end of the busiest lane that ends within the road, where lanes merge; else the busiest."""
    count: dict[str, int] = {}
    for lane, samples in zip(*np.unique(t.lane[t.lane >= 0], return_counts=True), strict=True):
        edge = t.lane_edges[lane]
        count[edge] = count.get(edge, 0) + int(samples)
    lanes = [lane for lane in network.lanes if not lane.connector]
    ending = [lane for lane in lanes if lane.dead_end and count.get(lane.edge, 0) > 0]
    lane = max(ending or lanes, key=lambda c: (count.get(c.edge, 0), c.id))
    s = np.r_[0.0, np.cumsum(np.hypot(*np.diff(lane.points, axis=0).T))]
    at = max(s[-1] - 60.0, 0.5 * s[-1]) if ending else 0.5 * s[-1]
    x, y = (float(np.interp(at, s, lane.points[:, k])) for k in (0, 1))
    ahead = [float(np.interp(min(at + 20.0, s[-1]), s, lane.points[:, k])) for k in (0, 1)]
    behind = [float(np.interp(max(at - 20.0, 0.0), s, lane.points[:, k])) for k in (0, 1)]
    return View(x, y, float(np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0])))


def best_time(runs: list[Trajectories], view: View) -> float:
    """A moment with many vehicles, trailers before cars, in the view of every run."""
    last = min(float(t.time[-1]) for t in runs if len(t.time))
    first = min(float(t.time[0]) for t in runs if len(t.time))
    times = np.arange(first + (last - first) / 3.0, last, 2.0)
    score = np.zeros(len(times))
    for t in runs:
        inside = _inside(t, view)
        weight = 1.0 + 8.0 * (t.shape[t.vehicle, 4] > 0)
        slot = np.rint((t.time - times[0]) / 2.0).astype(int) if len(times) else np.zeros(0, int)
        use = (
            inside
            & (slot >= 0)
            & (slot < len(times))
            & (np.abs(t.time - times[0] - 2.0 * slot) < 0.5 * t.period)
        )
        score += np.bincount(slot[use], weight[use], minlength=len(times))
    return float(times[score.argmax()]) if len(times) else first


def draw_snapshot(network: LaneNetwork, t: Trajectories, view: View, time: float) -> Figure:
    """The frame nearest to ``time`` s; PHASE vehicles orange, SUMO's blue."""
    figure = Figure(figsize=(13.0, 13.0 * VIEW_WIDTH / VIEW_LENGTH), dpi=110)
    axes = figure.add_axes((0, 0, 1, 1))
    turn = Affine2D().translate(-view.x, -view.y).rotate(-view.yaw)
    draw_road(axes, network, turn)
    times = np.unique(t.time)
    now = times[np.abs(times - time).argmin()] if len(times) else time
    draw_vehicles(axes, t.select(t.time == now), turn)
    half = 0.5 * VIEW_LENGTH
    axes.plot([half - 28, half - 8], [-0.43 * VIEW_WIDTH] * 2, color="#30343b", lw=2.5, solid_capstyle="butt")
    axes.text(half - 18, -0.42 * VIEW_WIDTH, "20 m", ha="center", va="bottom", fontsize=9, color="#30343b")
    axes.set(xlim=(-half, half), ylim=(-0.5 * VIEW_WIDTH, 0.5 * VIEW_WIDTH), aspect="equal")
    axes.axis("off")
    return figure


def draw_road(axes: Axes, network: LaneNetwork, turn: Affine2D) -> None:
    """Surface, kerbs and lane markings."""
    outlines = []
    for part in shapely.get_parts(drivable_surface(network)):
        rings = [np.asarray(ring.coords) for ring in (part.exterior, *part.interiors)]
        outlines.append(Outline.make_compound_path(*(Outline(turn.transform(r), closed=True) for r in rings)))
    axes.add_collection(
        PathCollection(outlines, facecolors=ASPHALT, edgecolors=KERB, linewidths=1.2, zorder=1)
    )
    for kind, style in ((RoadKind.LANE_BOUNDARY, (0, (7, 6))), (RoadKind.SOLID_BOUNDARY, "solid")):
        lines = [turn.transform(line.points) for line in lane_boundaries(network) if line.kind == kind]
        axes.add_collection(
            LineCollection(lines, colors=MARKING, linewidths=1.6, linestyles=[style], zorder=2)
        )


def draw_vehicles(axes: Axes, frame: Trajectories, turn: Affine2D) -> None:
    """Tractor and trailer boxes, a darker windscreen at the front."""
    for controlled, colour in ((False, SUMO), (True, PHASE)):
        f = frame.select(frame.controlled == controlled)
        shape = f.shape[f.vehicle]
        body = _boxes(f.x, f.y, f.yaw, -shape[:, 3], shape[:, 0] - shape[:, 3], shape[:, 1])
        nose = shape[:, 0] - shape[:, 3]
        glass = _boxes(
            f.x, f.y, f.yaw, nose - 0.30 * shape[:, 0], nose - 0.14 * shape[:, 0], 0.82 * shape[:, 1]
        )
        bent = shape[:, 4] > 0
        s, yaw = shape[bent], (f.yaw - f.hitch)[bent]
        trailer = _boxes(f.x[bent], f.y[bent], yaw, s[:, 7] - s[:, 4], s[:, 7], s[:, 5])
        dark = to_rgba(colour)
        edge = tuple(0.45 * c for c in dark[:3])
        light = tuple(0.55 + 0.45 * c for c in dark[:3])
        for polygons, face, order in ((body, colour, 4), (glass, "#1d2127", 5), (trailer, light, 6)):
            moved = [turn.transform(p) for p in polygons]
            axes.add_collection(
                PolyCollection(moved, facecolors=face, edgecolors=edge, linewidths=0.7, zorder=order)
            )


def _boxes(x, y, yaw, rear, front, width) -> np.ndarray:
    """[n, 4, 2] corners of boxes from ``rear`` to ``front`` m along the yaw."""
    along = np.stack((rear, front, front, rear), -1)
    aside = 0.5 * np.stack((-width, -width, width, width), -1)
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    return np.stack((x[:, None] + along * cos - aside * sin, y[:, None] + along * sin + aside * cos), -1)


def _inside(t: Trajectories, view: View) -> np.ndarray:
    dx, dy = t.x - view.x, t.y - view.y
    ahead = dx * np.cos(view.yaw) + dy * np.sin(view.yaw)
    aside = dy * np.cos(view.yaw) - dx * np.sin(view.yaw)
    return (np.abs(ahead) < 0.5 * VIEW_LENGTH) & (np.abs(aside) < 0.5 * VIEW_WIDTH)
