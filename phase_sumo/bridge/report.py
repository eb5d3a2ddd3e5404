"""One self-contained HTML page about a comparison."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from phase_sumo import __version__
from phase_sumo.bridge import pictures, plots
from phase_sumo.bridge.demand import label
from phase_sumo.evaluate.corridor import find_corridor
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.sim.lanes import LaneNetwork


def write_report(
    path: Path,
    comparison: dict[str, Any],
    runs: Mapping[str, Sequence[Trajectories]],
    network: LaneNetwork,
) -> None:
    """Render the page; the file appears complete or not at all.

    Args:
        comparison: what `compare` returns.
        runs: trajectories per model, in the order of the seeds.
        network: drawn under the snapshots.
    """
    from phase_sumo.bridge.compare import PHASE_TABLE, TABLE

    models = comparison["models"]
    reference = runs[models[-1]][0]
    corridor = find_corridor(reference)
    view = pictures.best_view(network, reference)
    time = pictures.best_time([ts[0] for ts in runs.values()], view)
    snapshots = [
        (
            label(model),
            _image(pictures.draw_snapshot(network, runs[model][0], view, time)),
            _caption(runs[model][0], time),
        )
        for model in models
    ]
    page = (
        _environment()
        .get_template("report.html.j2")
        .render(
            version=__version__,
            comparison=comparison,
            label=label,
            colours=plots.colours(models),
            phase_colour=pictures.PHASE,
            sumo_colour=pictures.SUMO,
            table=_table(TABLE, comparison, models),
            phase_table=_table(PHASE_TABLE, comparison, [m for m in models if m == "phase"]),
            snapshots=snapshots,
            snapshot_time=f"{time:.1f}",
            speed=_image(plots.speed_histogram(runs)),
            headway=_image(plots.headway_histogram(runs)),
            profile=_image(plots.speed_over_position(runs, corridor)),
            time_space=_image(plots.time_space(runs, corridor)),
            corridor_km=f"{corridor.length / 1000.0:.2f}",
        )
    )
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(page, encoding="utf-8")
    temporary.replace(path)


def _table(rows: dict[str, tuple[str, str, int]], comparison: dict[str, Any], models: Sequence[str]):
    """(label, unit, one cell per model) per measure that some model has."""
    several = len(comparison["seeds"]) > 1
    result = []
    for name, (text, unit, digits) in rows.items():
        cells = [_cell(comparison["summary"][m].get(name), digits, several) for m in models]
        if any(c != "–" for c in cells):
            result.append((text, unit, cells))
    return result


def _cell(value: dict[str, float] | None, digits: int, several: bool) -> str:
    if value is None or not math.isfinite(value["mean"]):
        return "–"
    mean = f"{value['mean']:.{digits}f}"
    return f"{mean} ± {value['std']:.{max(digits, 1)}f}" if several else mean


def _caption(t: Trajectories, time: float) -> str:
    phase = int(t.controlled[abs(t.time - time) <= 0.5 * t.period].sum())
    return (
        f"{phase} PHASE vehicles on the observed road at this moment"
        if phase
        else "all vehicles driven by SUMO"
    )


def _image(figure: Figure) -> str:
    """A figure as a data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor="white")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("phase_sumo.bridge", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
