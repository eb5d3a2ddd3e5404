"""The description of a freeway; `build` turns it into plain XML.

A lane's column is its place to the right of the reference line, the LEFT border of the carriageway: lane 0 of
a carriageway with three lanes is column 2, and a lane added on the left is column -1.
"""

from __future__ import annotations

from dataclasses import dataclass

from tools.networks.alignment import RampShape
from tools.networks.plain_xml import LANE_WIDTH

MAIN_SPEED = 29.0  # m/s


@dataclass(frozen=True)
class Section:
    """A mainline stretch with a constant number of lanes.

    Attributes:
        length: m.
        lanes: lane count.
        on_ramp, off_ramp: lanes of a ramp that joins at the section's start or leaves at its end.
        on_shape, off_shape: those ramps' geometry; by default the network's.
        option: the innermost lane of the off-ramp also goes on along the freeway.
        added_left: how many of the lanes lie left of the reference line.
        zipper: m over which the last column merges into its neighbour at the section's end, lane by lane.
        no_trucks: how many lanes from the left trucks may not use.
        solid: the line after this many lanes from the left may not be crossed.
    """

    length: float
    lanes: int
    on_ramp: int = 0
    off_ramp: int = 0
    on_shape: RampShape | None = None
    off_shape: RampShape | None = None
    option: bool = False
    added_left: int = 0
    zipper: float = 0.0
    no_trucks: int = 0
    solid: int = 0

    @property
    def columns(self) -> list[int]:
        return list(range(-self.added_left, self.lanes - self.added_left))

    def lane(self, column: int) -> int:
        """SUMO's lane number."""
        return self.lanes - 1 - self.added_left - column

    def ramp_columns(self, count: int, shape: RampShape) -> list[int]:
        """The columns that a ramp of ``count`` lanes continues, from left to right."""
        return self.columns[:count] if shape.left else self.columns[self.lanes - count :]


@dataclass(frozen=True)
class Collector:
    """A collector-distributor road beside the freeway, with a ramp that joins it and one that leaves it.

    It runs from the off-ramp at the end of section ``leaves`` to the on-ramp at the start of ``joins``.

    Attributes:
        gap: m between its lane and the outermost main lane.
        taper: m in which it swings out, and in again.
        speed: m/s.
        ramp: geometry of its own ramps.
    """

    leaves: int
    joins: int
    gap: float
    taper: float
    speed: float
    ramp: RampShape


@dataclass(frozen=True)
class Spec:
    """One network; ``held_out`` ones never enter training.

    Attributes:
        name: of the file.
        sections: of the mainline, one after the other.
        pieces, spiral, yaw: its alignment, see `Alignment`; yaw in rad at its start.
        speed: m/s.
        ramp_speed, ramp_length, ramp_radius: of ramps without a shape of their own, in m/s and m.
        lane_width: m.
        median: m between the carriageways, where there are two.
        opposite: sections of the other carriageway.
        collector: a road beside the first carriageway.
        left_hand: mirrored, for traffic on the left.
        about: what it is, in a few words.
    """

    name: str
    sections: tuple[Section, ...]
    pieces: tuple[tuple[float, float], ...] = ((1.0, 0.0),)
    yaw: float = 0.0
    speed: float = MAIN_SPEED
    ramp_speed: float = 17.0
    ramp_length: float = 180.0
    ramp_radius: float = 180.0
    held_out: bool = False
    spiral: float = 0.0
    lane_width: float = LANE_WIDTH
    median: float = 12.0
    opposite: tuple[Section, ...] = ()
    collector: Collector | None = None
    left_hand: bool = False
    about: str = ""

    @property
    def ramp(self) -> RampShape:
        return RampShape(self.ramp_length, self.ramp_radius, self.ramp_speed)

    @property
    def length(self) -> float:
        return sum(section.length for section in self.sections)
