"""Plots of the comparison as inline SVG, with colours that follow the page's light or dark scheme."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from phase_sumo.evaluate.measures import CURVES
from phase_sumo.evaluate.traffic import Corridor, along
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.report.road_pictures import PHASE, SUMO
from phase_sumo.studies.driver_models import is_phase, label
from phase_sumo.studies.run_analysis import Analysis

matplotlib.use("Agg")
Runs = Mapping[str, Sequence[Analysis]]
SHARES = ("#f2a33a", "#b5476b", "#8c6d1f")
OTHERS = ("#2a9d74", "#8e5cc2", "#5f7a8a", "#a0522d")
SLOW_TO_FAST = LinearSegmentedColormap.from_list(
    "slow to fast", ["#b3203a", "#e4572e", "#e0a800", "#2a9d74", "#3b7fc4"]
)
INK, GRID = "#2b2f36", "#e3e6ea"  # become the page's own colours
LONGEST_DIAGRAM = 600.0  # s shown in a time-space diagram
MOST_CELLS = 4000  # dots of a fundamental diagram per model
DASHES = ("solid", (0, (6, 2)), (0, (2, 1.5)), (0, (6, 2, 1.5, 2)))
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "phase_sumo",
    "font.family": "sans-serif",
    "font.size": 10,
}


def colours(models: Sequence[str]) -> dict[str, str]:
    """PHASE orange, its shares amber ..., the first SUMO model blue, then green, violet ..."""
    shares, others = iter(SHARES), iter((SUMO, *OTHERS))
    return {m: PHASE if m == "phase" else next(shares if is_phase(m) else others, INK) for m in models}


def distribution(runs: Runs, name: str) -> str:
    """One of `CURVES`, a line per model, pooled over the seeds."""
    curve = CURVES[name]
    figure, axes = _figure(6.3, 3.5)
    shares = {}
    for model, of_model in runs.items():
        count = np.sum([run.curves[name] for run in of_model], axis=0)
        shares[model] = count[:-1] / max(count.sum(), 1.0)
    used = np.flatnonzero(np.any([s > (2e-5 if curve.log else 1e-3) for s in shares.values()], axis=0))
    low, high = (used[0], used[-1] + 1) if len(used) else (0, len(curve.edges) - 1)
    for (model, colour), dash in zip(colours(list(runs)).items(), _dashes(len(runs)), strict=True):
        share, edges = shares[model][low:high], curve.edges[low : high + 1]
        axes.stairs(share, edges, color=colour, lw=1.9, ls=dash, label=label(model), baseline=None)
        if not curve.log:
            axes.stairs(share, edges, color=colour, alpha=0.10, fill=True)
    if curve.log and any(share.any() for share in shares.values()):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    return _finish(figure, axes, curve.label, curve.share)


def fundamental_diagram(runs: Runs) -> str:
    """Flow and speed over density, a dot per cell, lines through the medians of classes; "" without cells."""
    if not any(len(run.cells.flow) for of_model in runs.values() for run in of_model):
        return ""
    figure = Figure(figsize=(12.8, 4.0), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2)
    for (model, colour), dash in zip(colours(list(runs)).items(), _dashes(len(runs)), strict=True):
        density, flow, speed = (
            np.concatenate([getattr(run.cells, name) for run in runs[model]])
            for name in ("density", "flow", "speed")
        )
        some = np.random.default_rng(0).permutation(len(density))[:MOST_CELLS]
        for axes, value in ((left, flow), (right, 3.6 * speed)):
            axes.plot(
                density[some], value[some], ".", ms=4.5, color=colour, alpha=0.4, mew=0, rasterized=True
            )
            axes.plot(*_medians(density, value), color=colour, ls=dash, lw=2.2, label=label(model))
    for axes, name in ((left, "flow in veh/h per lane"), (right, "speed in km/h")):
        _style(axes)
        axes.set(xlim=(0, None), ylim=(0, None))
        _name(axes, "density in veh/km per lane", name)
    return _svg(figure)


def _medians(x: np.ndarray, y: np.ndarray, width: float = 2.0, least: int = 8) -> tuple[list, list]:
    """Medians of y in classes of x with at least so many values."""
    number = (x / width).astype(int)
    kept = [k for k, n in zip(*np.unique(number, return_counts=True), strict=True) if n >= least]
    return [(k + 0.5) * width for k in kept], [float(np.median(y[number == k])) for k in kept]


def speed_over_position(runs: Runs) -> str:
    """Mean speed along the busiest way through the network."""
    figure, axes = _figure(12.8, 3.2)
    for (model, colour), dash in zip(colours(list(runs)).items(), _dashes(len(runs)), strict=True):
        means = np.stack([run.profile[1] for run in runs[model]])
        known = np.isfinite(means).any(0)
        mean = np.full(means.shape[1], np.nan)
        mean[known] = np.nanmean(means[:, known], axis=0)
        axes.plot(runs[model][0].profile[0], 3.6 * mean, color=colour, lw=2.2, ls=dash, label=label(model))
    axes.set_ylim(bottom=0.0)
    return _finish(figure, axes, "distance along the busiest way in m", "mean speed in km/h")


def time_space(first: Mapping[str, Trajectories], corridor: Corridor) -> str:
    """A line per vehicle along the busiest way, coloured by speed; one panel per model."""
    columns = min(len(first), 3)
    rows = -(-len(first) // columns)
    figure = Figure(figsize=(12.8, 0.6 + 3.9 * rows), dpi=110, layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    top = max((float(np.percentile(t.speed, 98)) for t in first.values() if len(t.speed)), default=30.0)
    lines = None
    for axes, (model, t) in zip(panels.flat, first.items(), strict=False):
        _style(axes)
        axes.grid(visible=False)
        ends, speed = _strokes(t, corridor)
        lines = LineCollection(list(ends), array=speed, cmap=SLOW_TO_FAST, linewidths=0.8)
        lines.set_clim(0.0, 3.6 * top)
        lines.set_rasterized(True)
        axes.add_collection(lines)
        axes.autoscale_view()
        axes.set_title(label(model), fontsize=11, color=INK, loc="left", fontweight="bold")
        axes.margins(0.01)
    for axes in panels.flat[len(first) :]:
        axes.axis("off")
    for axes in panels[-1]:
        axes.set_xlabel("time in s", color=INK)
    for axes in panels[:, 0]:
        axes.set_ylabel("distance along the busiest way in m", color=INK)
    if lines is not None:
        bar = figure.colorbar(lines, ax=list(panels.flat), pad=0.01, aspect=30)
        bar.set_label("speed in km/h", color=INK)
        bar.ax.tick_params(colors=INK, labelsize=9)
        bar.outline.set_visible(False)  # type: ignore[operator]  # a spine, typed as something else
    return _svg(figure)


def _strokes(t: Trajectories, corridor: Corridor) -> tuple[np.ndarray, np.ndarray]:
    """Line pieces (time, distance) between samples about 0.4 s apart, and their speeds in km/h."""
    distance = along(t, corridor)
    begin = float(t.time[0]) if len(t.time) else 0.0
    frame = np.unique(t.time, return_inverse=True)[1]
    keep = (
        np.isfinite(distance)
        & (frame % max(1, round(0.4 / t.period)) == 0)
        & (t.time <= begin + LONGEST_DIAGRAM)
    )
    rows = np.flatnonzero(keep)
    rows = rows[np.lexsort((t.time[rows], t.vehicle[rows]))]
    a, b = rows[:-1], rows[1:]
    joined = (t.vehicle[a] == t.vehicle[b]) & (t.time[b] - t.time[a] < 1.0 + 1.5 * t.period)
    joined &= np.abs(distance[b] - distance[a]) < 60.0 * (t.time[b] - t.time[a])
    a, b = a[joined], b[joined]
    ends = np.stack((t.time[a], distance[a], t.time[b], distance[b]), -1).reshape(-1, 2, 2)
    return ends, 3.6 * t.speed[b]


def _dashes(count: int) -> list:
    """Line styles, so that models can be told apart without colours."""
    return [DASHES[k % len(DASHES)] for k in range(count)]


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    axes = figure.subplots()
    _style(axes)
    return figure, axes


def _style(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK)
    axes.tick_params(colors=INK, which="both", labelsize=9)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)


def _name(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=9, labelcolor=INK)


def _finish(figure: Figure, axes: Axes, x: str, y: str) -> str:
    _name(axes, x, y)
    return _svg(figure)


def _svg(figure: Figure) -> str:
    """The figure as an ``<svg>`` element: no background, ink and grid in the page's variables."""
    text = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)  # HTML knows them
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    return svg.replace(INK, "var(--ink)").replace(GRID, "var(--line)")
