"""From the description of a freeway to plain XML.

The reference line is the LEFT border of the carriageway (``spreadType="right"``), so lanes added on the
right never move the others; ramps run on their own centre line and meet the outermost lane tangentially.
"""

from __future__ import annotations

from dataclasses import replace

from tools.networks.alignment import Alignment, Line, Opposite, RampShape, Road, blend, line
from tools.networks.plain_xml import PlainNetwork
from tools.networks.spec import Collector, Spec

PLAIN_JUNCTION = 4.0  # m


def build(spec: Spec) -> PlainNetwork:
    """Both carriageways with their ramps as a plain network."""
    net = PlainNetwork(spec.lane_width, spec.left_hand)
    road = Alignment(spec.pieces, (0.0, 0.0, spec.yaw), spec.spiral)
    first = Carriageway(net, spec, road)
    first.add()
    if spec.collector is not None:
        first.add_collector(spec.collector)
    if spec.opposite:
        other = replace(spec, sections=spec.opposite)
        Carriageway(net, other, Opposite(road, spec.length, spec.median), "back_").add()
    return net


class Carriageway:
    """Adds one direction of ``spec`` to a network; ids start with ``prefix``."""

    def __init__(self, net: PlainNetwork, spec: Spec, road: Road, prefix: str = "") -> None:
        self.net, self.spec, self.road, self.prefix = net, spec, road, prefix
        self.sections = spec.sections
        self.starts = [sum(s.length for s in self.sections[:i]) for i in range(len(self.sections) + 1)]

    def add(self) -> None:
        for i, s in enumerate(self.starts):
            zipper = i > 0 and self.sections[i - 1].zipper > 0
            self.net.node(self._node(i), self.road.at(s)[:2], "zipper" if zipper else "priority")
        for i in range(len(self.sections)):
            self._add_section(i)

    def _node(self, i: int) -> str:
        return f"{self.prefix}n{i}"

    def _name(self, kind: str, i: int) -> str:
        return f"{self.prefix}{kind}{i}"

    def _off_ramp(self, i: int) -> list[int]:
        section = self.sections[i]
        return section.ramp_columns(section.off_ramp, section.off_shape or self.spec.ramp)

    def _on_ramp(self, i: int) -> list[int]:
        section = self.sections[i]
        return section.ramp_columns(section.on_ramp, section.on_shape or self.spec.ramp)

    def _add_section(self, i: int) -> None:
        section, collector = self.sections[i], self.spec.collector
        begin = self.starts[i] + 0.5 * self._room(i)
        end = self.starts[i + 1] - 0.5 * self._room(i + 1)
        self.net.edge(
            self._name("main", i),
            (self._node(i), self._node(i + 1)),
            section.lanes,
            self.spec.speed,
            line(self.road, begin, end, -section.added_left * self.spec.lane_width),
            tags=self._tags(i),
        )
        if i + 1 < len(self.sections):
            self._connect_through(i)
        if section.on_ramp and not (collector and collector.joins == i):
            self._add_on_ramp(i)
        if section.off_ramp and not (collector and collector.leaves == i):
            self._add_off_ramp(i)

    def _room(self, i: int) -> float:
        """m that the edges leave free at node i: netconvert makes no junction where no lane changes."""
        if not 0 < i < len(self.sections):
            return 0.0
        before, after = self.sections[i - 1], self.sections[i]
        return before.zipper or (PLAIN_JUNCTION if before.columns == after.columns else 0.0)

    def _connect_through(self, i: int) -> None:
        section, following, lines = self.sections[i], self.sections[i + 1], []
        columns = self._through(i)
        if section.zipper:
            lines = [self._merging(self.starts[i + 1], section.zipper, *pair) for pair in columns]
        pairs = [(section.lane(a), following.lane(b)) for a, b in columns]
        self.net.connect(self._name("main", i), self._name("main", i + 1), pairs, lines)

    def _merging(self, s: float, length: float, column: int, target: int) -> Line:
        """The centre line from one column to another, over ``length`` m around ``s``."""
        begin, end = s - 0.5 * length, s + 0.5 * length

        def offset(at: float) -> float:
            return (column + 0.5 + (target - column) * blend((at - begin) / length)) * self.spec.lane_width

        return line(self.road, begin, end, offset, 4.0)

    def _through(self, i: int) -> list[tuple[int, int]]:
        """Columns of section i that go on, and where to."""
        section, following = self.sections[i], self.sections[i + 1]
        leaving = self._off_ramp(i)[1 if section.option else 0 :]
        free = [c for c in following.columns if c not in self._on_ramp(i + 1)]
        pairs = [(c, c) for c in section.columns if c not in leaving and c in free]
        return [*pairs, (section.columns[-1], free[-1])] if section.zipper else pairs

    def _tags(self, i: int) -> dict[int, str]:
        """Attributes of single lanes of section i."""
        section, tags = self.sections[i], {}
        if section.on_ramp and i + 1 < len(self.sections):
            on = {c for c, _ in self._through(i)} | set(self._off_ramp(i))
            tags |= {section.lane(c): 'acceleration="1"' for c in section.columns if c not in on}
        for k in range(section.no_trucks):
            tags[section.lanes - 1 - k] = 'disallow="truck trailer"'
        if section.solid:
            tags[section.lanes - section.solid] = 'changeRight="emergency"'
            tags[section.lanes - section.solid - 1] = 'changeLeft="emergency"'
        return tags

    def _offset(self, columns: list[int]) -> float:
        """m from the reference line to the middle of ``columns``."""
        return (columns[0] + 0.5 * len(columns)) * self.spec.lane_width

    def _add_on_ramp(self, i: int) -> None:
        section, columns = self.sections[i], self._on_ramp(i)
        shape = section.on_shape or self.spec.ramp
        course = shape.line(self.road, self.starts[i], self._offset(columns), leaving=False)
        self._add_ramp("on", i, i, course, section.on_ramp, shape.speed)
        pairs = [(k, section.lane(c)) for k, c in enumerate(reversed(columns))]
        self.net.connect(self._name("onramp", i), self._name("main", i), pairs)

    def _add_off_ramp(self, i: int) -> None:
        section, columns = self.sections[i], self._off_ramp(i)
        shape = section.off_shape or self.spec.ramp
        course = shape.line(self.road, self.starts[i + 1], self._offset(columns), leaving=True)
        self._add_ramp("off", i, i + 1, course, section.off_ramp, shape.speed)
        pairs = [(section.lane(c), k) for k, c in enumerate(reversed(columns))]
        self.net.connect(self._name("main", i), self._name("offramp", i), pairs)

    def _add_ramp(self, kind: str, i: int, node: int, course: Line, lanes: int, speed: float) -> None:
        far = self._name(kind, i)
        self.net.node(far, course[0] if kind == "on" else course[-1])
        ends = (far, self._node(node)) if kind == "on" else (self._node(node), far)
        self.net.edge(self._name(f"{kind}ramp", i), ends, lanes, speed, course, ramp=True)

    def add_collector(self, road: Collector) -> None:
        """Slip road out, a weaving section with ramps of its own, slip road in."""
        net, width = self.net, self.spec.lane_width
        begin, end = self.starts[road.leaves + 1], self.starts[road.joins]
        first, last = begin + road.taper, end - road.taper
        leaves, joins = self._off_ramp(road.leaves), self._on_ramp(road.joins)
        outermost = max(section.columns[-1] for section in self.sections[road.leaves + 1 : road.joins])
        beside = (outermost + 1.5) * width + road.gap

        def out(s: float) -> float:
            start = self._offset(leaves)
            return start + (beside - start) * blend((s - begin) / road.taper)

        def back(s: float) -> float:
            return beside + (self._offset(joins) - beside) * blend((s - last) / road.taper)

        slip_out, slip_in = line(self.road, begin, first, out, 8.0), line(self.road, last, end, back, 8.0)
        weave = line(self.road, first, last, beside - 0.5 * width)
        net.node("c0", slip_out[-1])
        net.node("c1", slip_in[0])
        exit_node, entry_node = self._node(road.leaves + 1), self._node(road.joins)
        net.edge("collector0", (exit_node, "c0"), 1, road.speed, slip_out, ramp=True)
        net.edge("collector1", ("c0", "c1"), 2, road.speed, weave, ramp=True, centred=False)
        net.edge("collector2", ("c1", entry_node), 1, road.speed, slip_in, ramp=True)
        exit_lane = self.sections[road.leaves].lane(leaves[0])
        net.connect(self._name("main", road.leaves), "collector0", [(exit_lane, 0)])
        net.connect("collector0", "collector1", [(0, 1)])
        net.connect("collector1", "collector2", [(1, 0)])
        entry_lane = self.sections[road.joins].lane(joins[0])
        net.connect("collector2", self._name("main", road.joins), [(0, entry_lane)])
        self._add_collector_ramps(road.ramp, first, last, beside + width)

    def _add_collector_ramps(self, shape: RampShape, first: float, last: float, offset: float) -> None:
        joining = shape.line(self.road, first, offset, leaving=False)
        leaving = shape.line(self.road, last, offset, leaving=True)
        self.net.node("collector_begin", joining[0])
        self.net.node("collector_end", leaving[-1])
        self.net.edge("collector_on", ("collector_begin", "c0"), 1, shape.speed, joining, ramp=True)
        self.net.edge("collector_off", ("c1", "collector_end"), 1, shape.speed, leaving, ramp=True)
        self.net.connect("collector_on", "collector1", [(0, 0)])
        self.net.connect("collector1", "collector_off", [(0, 0)])
