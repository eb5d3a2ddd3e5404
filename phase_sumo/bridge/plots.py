"""Plots of the comparison: speed, space and time, headways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from phase_sumo.bridge.demand import label
from phase_sumo.bridge.pictures import PHASE, SUMO
from phase_sumo.evaluate.corridor import Corridor, along, speed_profile
from phase_sumo.evaluate.traffic import following, time_headways
from phase_sumo.evaluate.trajectories import Trajectories

matplotlib.use("Agg")
Runs = Mapping[str, Sequence[Trajectories]]
OTHERS = ("#2a9d74", "#8e5cc2", "#b8860b", "#5f6b7a")
SLOW_TO_FAST = LinearSegmentedColormap.from_list(
    "slow to fast", ["#7a1022", "#e4572e", "#e0a800", "#2a9d74", "#1d4e89"]
)
INK, GRID = "#2b2f36", "#e3e6ea"
LONGEST_DIAGRAM = 600.0  # s shown in a time-space diagram


def colours(models: Sequence[str]) -> dict[str, str]:
    """PHASE orange, the first SUMO model blue, then green, violet ..."""
    result = {m: PHASE for m in models if m == "phase"}
    others = [m for m in models if m != "phase"]
    return result | dict(zip(others, (SUMO, *OTHERS), strict=False))


def speed_histogram(runs: Runs) -> Figure:
    """Share of the vehicle time per km/h."""
    figure, axes = _figure(6.3, 3.6)
    top = max((float(t.speed.max()) for ts in runs.values() for t in ts if len(t.speed)), default=30.0)
    edges = np.arange(0.0, 3.6 * top + 5.0, 4.0)
    for model, colour in colours(list(runs)).items():
        count = sum(np.histogram(3.6 * t.speed, edges)[0] for t in runs[model])
        _steps(axes, edges, count, label(model), colour)
    _finish(axes, "speed in km/h", "share of vehicle time")
    return figure


def headway_histogram(runs: Runs) -> Figure:
    """Distribution of the time headway."""
    figure, axes = _figure(6.3, 3.6)
    edges = np.arange(0.0, 8.01, 0.25)
    for model, colour in colours(list(runs)).items():
        count = sum(np.histogram(time_headways(t, following(t)), edges)[0] for t in runs[model])
        _steps(axes, edges, count, label(model), colour)
    _finish(axes, "time headway in s", "share of followers")
    return figure


def speed_over_position(runs: Runs, corridor: Corridor) -> Figure:
    """Mean speed along the busiest way through the network."""
    figure, axes = _figure(12.8, 3.2)
    for model, colour in colours(list(runs)).items():
        profiles = [speed_profile(t, corridor) for t in runs[model]]
        if not profiles:
            continue
        means = np.stack([p[1] for p in profiles])
        known = np.isfinite(means).any(0)
        mean = np.full(means.shape[1], np.nan)
        mean[known] = np.nanmean(means[:, known], axis=0)
        axes.plot(profiles[0][0], 3.6 * mean, color=colour, lw=2.2, label=label(model))
    axes.set_ylim(bottom=0.0)
    _finish(axes, "distance along the busiest way in m", "mean speed in km/h")
    return figure


def time_space(runs: Runs, corridor: Corridor) -> Figure:
    """One dot per vehicle and sample along the busiest way, coloured by speed; one panel per model."""
    models = list(runs)
    figure = Figure(figsize=(12.8, 4.4), dpi=120, layout="constrained")
    panels = figure.subplots(1, len(models), sharex=True, sharey=True, squeeze=False)[0]
    top = max(
        (float(np.percentile(t.speed, 98)) for ts in runs.values() for t in ts[:1] if len(t.speed)),
        default=30,
    )
    lines = None
    for axes, model in zip(panels, models, strict=True):
        _style(axes)
        axes.grid(visible=False)
        if runs[model]:
            ends, speed = _strokes(runs[model][0], corridor)
            lines = LineCollection(list(ends), array=speed, cmap=SLOW_TO_FAST, linewidths=0.8)
            lines.set_clim(0.0, 3.6 * top)
            lines.set_rasterized(True)
            axes.add_collection(lines)
            axes.autoscale_view()
        axes.set_title(label(model), fontsize=11, color=INK, loc="left", fontweight="bold")
        axes.set_xlabel("time in s")
        axes.margins(0.01)
    panels[0].set_ylabel("distance along the busiest way in m")
    if lines is not None:
        bar = figure.colorbar(lines, ax=list(panels), pad=0.01, aspect=30)
        bar.set_label("speed in km/h")
    return figure


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


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    axes = figure.subplots()
    _style(axes)
    return figure, axes


def _style(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#aab0b8")
    axes.tick_params(colors=INK, labelsize=9)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)


def _steps(axes: Axes, edges: np.ndarray, count, name: str, colour: str) -> None:
    total = np.sum(count)
    share = np.asarray(count) / total if total else np.zeros(len(edges) - 1)
    axes.stairs(share, edges, color=colour, lw=2.0, label=name)
    axes.stairs(share, edges, color=colour, alpha=0.12, fill=True)


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=9)
