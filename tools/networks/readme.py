"""The generated parts of README.md."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from tools.networks.alignment import Alignment, RampShape
from tools.networks.spec import Section, Spec
from tools.places import NETWORKS

README = NETWORKS / "README.md"


def fill(part: str, text: str, readme: Path = README) -> None:
    """Replace what stands between ``<!-- part -->`` and ``<!-- end of part -->``."""
    begin, end = f"<!-- {part} -->", f"<!-- end of {part} -->"
    before, rest = readme.read_text(encoding="utf-8").split(begin)
    after = rest.split(end)[1]
    readme.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table; every column but the first is centred."""
    head = list(head)
    lines = [head, ["---", *[":-:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def network_table(specs: Iterable[Spec]) -> str:
    head = (
        "network",
        "what it is",
        "lanes",
        "length, m",
        "tightest curve, m",
        "ramps (length, radius in m)",
        "lane width, m",
        "limit, m/s",
    )
    return table(head, (_row(spec) for spec in specs))


def _row(spec: Spec) -> list[str]:
    sections = (*spec.sections, *spec.opposite)
    lanes = sorted({section.lanes for section in sections})
    return [
        f"`{spec.name}`",
        spec.about,
        f"{lanes[0]}–{lanes[-1]}" if len(lanes) > 1 else f"{lanes[0]}",
        f"{spec.length:.0f}",
        _tightest(spec),
        "<br>".join(_ramps(spec, sections)) or "–",
        f"{spec.lane_width:.2f}",
        f"{spec.speed:.1f}",
    ]


def _tightest(spec: Spec) -> str:
    road = Alignment(spec.pieces, (0.0, 0.0, spec.yaw), spec.spiral)
    sharpest = max(abs(road.curvature(float(s))) for s in range(round(spec.length)))
    return f"{1.0 / sharpest:.0f}" if sharpest > 1e-5 else "–"


def _ramps(spec: Spec, sections: Iterable[Section]) -> list[str]:
    if spec.collector is not None:  # its slip roads take the place of the freeway's own ramps
        return [_ramp(kind, 1, spec.collector.ramp) for kind in ("on", "off")]
    rows = []
    for section in sections:
        for kind, lanes, shape in (
            ("on", section.on_ramp, section.on_shape),
            ("off", section.off_ramp, section.off_shape),
        ):
            if lanes:
                rows.append(_ramp(kind, lanes, shape or spec.ramp))
    return rows


def _ramp(kind: str, lanes: int, shape: RampShape) -> str:
    name = f"{kind}, {lanes} lanes" if lanes > 1 else kind
    return f"{name}: {shape.length:.0f}, {shape.radius:.0f}"
