"""SUMO networks small enough to write down, as XML text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

Point = Sequence[float]


def attributes(**values: object) -> str:
    return "".join(f" {name}={quoteattr(str(value))}" for name, value in values.items() if value is not None)


@dataclass
class SmallNet:
    """Collects edges and connections; ``text`` is the network file."""

    root: dict[str, str] = field(default_factory=dict)
    rows: list[str] = field(default_factory=list)

    def edge(
        self,
        name: str,
        lanes: Sequence[Sequence[Point]],
        extra: Mapping[int, Mapping[str, object]] | None = None,
        speed: float = 30.0,
        width: float | None = 3.6,
        **values: object,
    ) -> SmallNet:
        """An edge with one point list per lane; ``extra`` holds attributes of single lanes by index."""
        ends = {} if "function" in values else {"from": f"{name}.start", "to": f"{name}.end"}
        rows = []
        for index, points in enumerate(lanes):
            run = sum(((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2) ** 0.5 for a, b in pairwise(points))
            own: dict[str, object] = {
                "id": f"{name}_{index}",
                "index": index,
                "speed": speed,
                "length": max(run, 0.1),
                "width": width,
                "shape": " ".join(",".join(f"{v:.3f}" for v in point) for point in points),
            }
            rows.append(f"<lane{attributes(**own | dict((extra or {}).get(index, {})))}/>")
        self.rows.append(f"<edge{attributes(id=name, **ends, **values)}>{''.join(rows)}</edge>")
        return self

    def connect(self, source: str, target: str, *lanes: tuple[int, int], via: str | None = None) -> SmallNet:
        for a, b in lanes:
            ends = {"from": source, "to": target}
            self.rows.append(f"<connection{attributes(**ends, fromLane=a, toLane=b, via=via)}/>")
        return self

    @property
    def text(self) -> str:
        return f"<net{attributes(**self.root)}>" + "\n".join(self.rows) + "</net>"

    def write(self, path: Path) -> Path:
        path.write_text(self.text, encoding="utf-8")
        return path


def lanes_from(x0: float, x1: float, *heights: float) -> Sequence[Sequence[Point]]:
    """Straight lanes to the east at the given y."""
    return [[(x0, y), (x1, y)] for y in heights]
