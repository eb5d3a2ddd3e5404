"""The networks: 22 for training and 6 that never enter it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tools.networks.draw import Draw
from tools.networks.spec import Collector, Section, Spec

Recipe = Callable[[Draw], Spec]
STRAIGHT = ((1.0, 0.0),)
RECIPES: dict[str, Recipe] = {}


def recipe(name: str, about: str) -> Callable[[Recipe], Recipe]:
    """Registers a function that draws the network ``name``."""

    def register(draw: Recipe) -> Recipe:
        RECIPES[name] = lambda d: replace(draw(d), about=about)
        return draw

    return register


@recipe("f01_straight3", "straight")
def straight3(d: Draw) -> Spec:
    return d.spec(Section(d.length(520, 560), 3), pieces=STRAIGHT)


@recipe("f02_straight5", "straight")
def straight5(d: Draw) -> Spec:
    return d.spec(Section(d.length(520, 560), 5), pieces=STRAIGHT)


@recipe("f03_curve4", "curve between two straights")
def curve4(d: Draw) -> Spec:
    pieces = ((d.length(80, 120), 0), (d.length(300, 360), d.radius(450, 700)), (200, 0))
    return d.spec(Section(d.length(540, 580), 4), pieces=pieces)


@recipe("f05_offramp3", "off-ramp with a deceleration lane, gentle curve")
def offramp3(d: Draw) -> Spec:
    leaving = Section(d.length(160, 220), 4, off_ramp=1, off_shape=d.ramp())
    pieces = ((d.length(150, 250), 0), (1, d.radius(1500, 3000)))
    return d.spec(Section(d.length(180, 220), 3), leaving, Section(d.length(140, 170), 3), pieces=pieces)


@recipe("f06_weave3", "weaving lane between an on-ramp and an off-ramp")
def weave3(d: Draw) -> Spec:
    weave = Section(d.length(260, 320), 4, on_ramp=1, off_ramp=1, on_shape=d.ramp(), off_shape=d.ramp())
    return d.spec(Section(d.length(110, 140), 3), weave, Section(d.length(110, 140), 3))


@recipe("f07_drop4", "lane drop on the right in a gentle curve")
def drop4(d: Draw) -> Spec:
    pieces = ((d.length(150, 200), 0), (1, d.radius(1200, 2500)))
    return d.spec(Section(d.length(340, 380), 4), Section(d.length(180, 210), 3), pieces=pieces)


@recipe("f08_add2", "lane added on the right in a curve")
def add2(d: Draw) -> Spec:
    pieces = ((d.length(120, 200), 0), (1, d.radius(600, 1000)))
    return d.spec(Section(d.length(330, 360), 2), Section(d.length(190, 220), 3), pieces=pieces)


@recipe("f09_tworamp3", "on-ramp of two lanes, of which one goes on")
def tworamp3(d: Draw) -> Spec:
    joined = Section(d.length(200, 260), 5, on_ramp=2, on_shape=d.ramp())
    return d.spec(Section(d.length(120, 150), 3), joined, Section(d.length(160, 200), 4))


@recipe("f10_curve2", "long curve")
def curve2(d: Draw) -> Spec:
    return d.spec(
        Section(d.length(520, 560), 2), pieces=((d.length(60, 100), 0), (1, d.radius(380, 550))), spiral=90.0
    )


@recipe("f11_straight6", "straight")
def straight6(d: Draw) -> Spec:
    return d.spec(Section(d.length(500, 540), 6), pieces=STRAIGHT)


@recipe("f12_scurve2", "S-curve, the tightest of all")
def scurve2(d: Draw) -> Spec:
    bend, back = d.turn(230, 330), d.turn(230, 330)
    pieces = ((d.length(60, 90), 0), (d.length(150, 180), bend), (60, 0), (d.length(150, 180), -back))
    return d.spec(Section(d.length(540, 580), 2), pieces=(*pieces, (1, 0)), spiral=60.0)


@recipe("f13_zipper3", "zipper merge from three to two lanes")
def zipper3(d: Draw) -> Spec:
    return d.spec(Section(d.length(230, 260), 3, zipper=64.0), Section(d.length(280, 320), 2))


@recipe("f14_collector2", "collector-distributor road with two loop ramps of its own")
def collector2(d: Draw) -> Spec:
    collector = Collector(0, 2, d.length(5, 8), d.length(85, 100), 22.35, d.loop())
    return d.spec(
        Section(d.length(110, 130), 3, off_ramp=1),
        Section(d.length(320, 350), 2),
        Section(d.length(130, 150), 3, on_ramp=1),
        Section(d.length(60, 80), 2),
        collector=collector,
    )


@recipe("f15_notrucks4", "leftmost lane closed to trucks, gentle curve")
def notrucks4(d: Draw) -> Spec:
    pieces = ((d.length(200, 300), 0), (1, d.radius(1200, 2500)))
    return d.spec(Section(d.length(520, 560), 4, no_trucks=1), pieces=pieces)


@recipe("f16_carpool5", "solid line beside the leftmost lane, with an opening")
def carpool5(d: Draw) -> Spec:
    closed, opening = d.length(150, 180), d.length(200, 240)
    sections = (Section(closed, 5, solid=1), Section(opening, 5), Section(closed, 5, solid=1))
    return d.spec(*sections)


@recipe("f17_onramps2", "two on-ramps one after the other")
def onramps2(d: Draw) -> Spec:
    first = Section(d.length(150, 180), 3, on_ramp=1, on_shape=d.ramp())
    second = Section(d.length(150, 180), 3, on_ramp=1, on_shape=d.ramp())
    return d.spec(
        Section(d.length(80, 100), 2),
        first,
        Section(d.length(70, 90), 2),
        second,
        Section(d.length(90, 120), 2),
    )


@recipe("f18_exit4", "off-ramp of two lanes, of which one also goes straight on")
def exit4(d: Draw) -> Spec:
    leaving = Section(d.length(220, 280), 5, off_ramp=2, off_shape=d.ramp(), option=True)
    return d.spec(Section(d.length(130, 170), 4), leaving, Section(d.length(140, 180), 4))


@recipe("f19_leftexit2", "exit on the left")
def leftexit2(d: Draw) -> Spec:
    leaving = Section(d.length(180, 240), 3, off_ramp=1, off_shape=d.ramp(left=True), added_left=1)
    return d.spec(Section(d.length(150, 190), 2), leaving, Section(d.length(150, 180), 2))


@recipe("f20_lefthand2", "`f17_onramps2` mirrored, traffic on the left")
def lefthand2(d: Draw) -> Spec:
    """The mirror image of another network."""
    return replace(onramps2(Draw("f17_onramps2")), name=d.name, left_hand=True)


@recipe("f21_bothways2", "both carriageways of a curve, with an off-ramp and an on-ramp")
def bothways2(d: Draw) -> Spec:
    there = (
        Section(d.length(140, 180), 2),
        Section(d.length(150, 190), 3, off_ramp=1, off_shape=d.ramp()),
        Section(d.length(180, 220), 2),
    )
    total = sum(section.length for section in there)
    before, joined = d.length(140, 180), d.length(190, 230)
    back = (
        Section(before, 2),
        Section(joined, 3, on_ramp=1, on_shape=d.ramp()),
        Section(total - before - joined, 2),
    )
    return d.spec(*there, opposite=back, median=d.length(6, 18), pieces=((150, 0), (1, d.radius(900, 1800))))


@recipe("f22_loops2", "cloverleaf: weaving lane between two loop ramps")
def loops2(d: Draw) -> Spec:
    weave = Section(d.length(190, 240), 3, on_ramp=1, off_ramp=1, on_shape=d.loop(), off_shape=d.loop())
    return d.spec(Section(d.length(150, 180), 2), weave, Section(d.length(150, 180), 2))


@recipe("h03_weave4", "weaving lane in a curve")
def weave4(d: Draw) -> Spec:
    weave = Section(d.length(220, 280), 5, on_ramp=1, off_ramp=1, on_shape=d.ramp(), off_shape=d.ramp())
    pieces = ((d.length(100, 160), 0), (1, d.radius(700, 1100)))
    return d.spec(Section(d.length(130, 160), 4), weave, Section(d.length(130, 160), 4), pieces=pieces)


@recipe("h04_collector3", "collector-distributor road with two ramps of its own")
def collector3(d: Draw) -> Spec:
    collector = Collector(0, 2, d.length(4, 7), d.length(85, 100), 20.12, d.ramp())
    return d.spec(
        Section(d.length(120, 140), 4, off_ramp=1),
        Section(d.length(330, 360), 3),
        Section(d.length(120, 140), 4, on_ramp=1),
        Section(d.length(60, 80), 3),
        collector=collector,
    )


@recipe("h05_scurve_exit3", "S-curve, off-ramp of two lanes, of which one also goes straight on")
def scurve_exit3(d: Draw) -> Spec:
    bend = d.turn(600, 900)
    leaving = Section(d.length(180, 220), 4, off_ramp=2, off_shape=d.ramp(), option=True)
    return d.spec(
        Section(d.length(170, 200), 3),
        leaving,
        Section(d.length(150, 180), 3),
        pieces=((40, 0), (180, -bend), (40, 0), (1, bend)),
    )


@recipe("h06_onramp_zipper2", "on-ramp that ends in a zipper merge")
def onramp_zipper2(d: Draw) -> Spec:
    joined = Section(d.length(130, 160), 3, on_ramp=1, on_shape=d.ramp(), zipper=64.0)
    return d.spec(
        Section(d.length(150, 180), 2), joined, Section(d.length(210, 250), 2), pieces=((250, 0), (1, -1500))
    )


# nothing in these is drawn: tests measure vehicles on the first, published figures use the other two
FIXED = (
    Spec(
        "f04_onramp3",
        (Section(150, 3), Section(250, 4, on_ramp=1), Section(160, 3)),
        about="on-ramp with an acceleration lane",
    ),
    Spec(
        "h01_curve_onramp2",
        (Section(160, 2), Section(230, 3, on_ramp=1), Section(160, 2)),
        ((100, 0), (450, 700)),
        yaw=-0.7,
        held_out=True,
        about="on-ramp in a curve",
    ),
    Spec(
        "h02_exit_drop4",
        (Section(120, 4), Section(200, 5, off_ramp=1), Section(120, 4), Section(130, 3)),
        ((250, 0), (320, -800)),
        yaw=0.2,
        held_out=True,
        about="off-ramp, then a lane drop, in a curve",
    ),
)
SPECS = tuple(sorted((*FIXED, *(draw(Draw(name)) for name, draw in RECIPES.items())), key=lambda s: s.name))
