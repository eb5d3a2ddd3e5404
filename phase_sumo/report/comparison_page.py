"""One self-contained HTML page about a comparison."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from phase_sumo import __version__
from phase_sumo.atomic_files import write_whole
from phase_sumo.bridge.check import Check
from phase_sumo.bridge.fleet.guarded import warning
from phase_sumo.evaluate import measures, surrogate_safety, traffic
from phase_sumo.evaluate.measures import MEASURES, Measure
from phase_sumo.evaluate.traffic import Corridor
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.report import playback, plots, road_pictures
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.studies.driver_models import is_phase, label
from phase_sumo.studies.run_analysis import PHASE_MEASURES, Analysis

MOST_COLLISIONS = 300  # lines of the list


def write_report(
    path: Path,
    comparison: dict[str, Any],
    runs: Mapping[str, Sequence[Analysis]],
    first: Mapping[str, Trajectories],
    network: LaneNetwork,
    corridor: Corridor,
) -> None:
    """Render the page; the file appears complete or not at all.

    Args:
        comparison: what `compare` returns.
        runs: by model, in the order of the seeds.
        first: trajectories of the first seed by model.
        network: drawn under the vehicles.
        corridor: the axis of the space-time diagrams.
    """
    models = comparison["models"]
    shown = [t for t in first.values() if len(t.time)]
    view = road_pictures.best_view(network, shown[-1])
    moment = road_pictures.best_time(shown, view)
    film = playback.pack(
        first,
        network,
        view,
        moment,
        [c for c in comparison["collisions"] if c["seed"] == comparison["seeds"][0]],
    )
    environment = _environment()
    page = environment.get_template("report.html.j2").render(
        version=__version__,
        comparison=comparison,
        label=label,
        is_phase=is_phase,
        colours=plots.colours(models),
        phase_colour=road_pictures.PHASE,
        sumo_colour=road_pictures.SUMO,
        changed=[m for m in models if comparison["reference"] not in (None, m)],
        table=_table(MEASURES, comparison, models),
        phase_table=_table(PHASE_MEASURES, comparison, [m for m in models if is_phase(m)]),
        often=_often(comparison, [m for m in models if is_phase(m)]),
        snapshots=[
            (label(m), _image(road_pictures.draw_snapshot(network, t, view, moment)), _caption(t, moment))
            for m, t in first.items()
        ],
        check=Check(**comparison["check"]).rows() if "check" in comparison else {},
        moment=moment,
        distributions=[
            (curve.title, Markup(plots.distribution(runs, name))) for name, curve in measures.CURVES.items()
        ],
        fundamental=Markup(plots.fundamental_diagram(runs)),
        profile=Markup(plots.speed_over_position(runs)),
        time_space=Markup(plots.time_space(first, corridor)),
        corridor_km=f"{corridor.length / 1000.0:.2f}",
        collisions=comparison["collisions"][:MOST_COLLISIONS],
        film=film,
        film_json=_script_json(film),
        film_megabytes=sum(len(run["data"]) for run in film["runs"].values()) / 1e6,
        most_samples=playback.MOST_SAMPLES,
        traffic=traffic,
        surrogate_safety=surrogate_safety,
        style=Markup(_source(environment, "report.css")),
        script=Markup(_source(environment, "playback.js")),
    )
    write_whole(path, page.encode())


def _table(table: Mapping[str, Measure], comparison: dict[str, Any], models: Sequence[str]):
    """(group, rows) pairs; a row is label, unit and per model the value, its interval and the difference."""
    groups: dict[str, list] = {}
    for name, measure in table.items():
        cells = [_cell(comparison["summary"][m].get(name), measure) for m in models]
        if any(cell["mean"] != "–" for cell in cells):
            groups.setdefault(measure.group, []).append((measure.label, measure.unit, cells))
    return list(groups.items())


def _often(comparison: dict[str, Any], models: Sequence[str]) -> list[tuple[str, str]]:
    """Models whose vehicles the guard kept from what they wanted often, and a line about each."""
    share = {m: comparison["summary"][m].get("guard_share_of_decisions") for m in models}
    return [(label(m), text) for m in models for text in warning(share[m]["mean"] if share[m] else 0.0)]


def _cell(value: dict[str, Any] | None, measure: Measure) -> dict[str, Any]:
    """Texts of a value and its difference; ``beyond`` when the difference's interval does not hold zero."""
    mean, interval = _estimate(value, measure.digits)
    difference = value["difference"] if value else None
    change, change_interval = _estimate(difference, measure.digits, sign=True)
    beyond = bool(difference) and (difference["low"] > 0 or difference["high"] < 0)
    return {
        "mean": mean,
        "interval": interval,
        "change": change,
        "change_interval": change_interval,
        "beyond": beyond,
    }


def _estimate(value: dict[str, Any] | None, digits: int, sign: bool = False) -> tuple[str, str]:
    """Mean and interval, with a digit more in the interval of a whole number."""
    if value is None or not math.isfinite(value["mean"]):
        return "–", ""
    mean = _number(value["mean"], digits, sign)
    if not math.isfinite(value["low"]):
        return mean, ""
    low, high = (_number(value[end], max(digits, 1), sign) for end in ("low", "high"))
    return mean, f"[{low}, {high}]"


def _number(value: float, digits: int, sign: bool = False) -> str:
    text = f"{value:{'+' if sign else ''}.{digits}f}"
    if float(text) == 0.0:
        text = text.lstrip("+-")
    return text.replace("-", "−")


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


def _script_json(value: Any) -> Markup:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    return Markup(text.replace("<", "\\u003c"))


def _source(environment: Environment, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("phase_sumo.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
