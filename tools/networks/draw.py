"""Road dimensions, drawn in the ranges of US freeways with one seed per network."""

from __future__ import annotations

import numpy as np

from tools.networks.alignment import RampShape
from tools.networks.plain_xml import LANE_WIDTH
from tools.networks.spec import Section, Spec

SEED = 1000  # of fifteen, the one whose networks resemble real ones most
MPH = 0.44704  # m/s
SPEEDS = (55, 60, 65, 70)  # mph
NARROW = 3.35, 3.6  # m, lane widths of the others
STANDARD_SHARE = 0.7  # of the networks have lanes of 3.66 m
BENT_SHARE = 0.7  # of the ramps bend once more, the others run on nearly straight


class Draw:
    """One generator per network: a network does not change when another one is added.

    Args:
        name: of the network; its number is added to the seed.
    """

    def __init__(self, name: str) -> None:
        self.name, self.held_out = name, name.startswith("h")
        self.rng = np.random.default_rng(SEED + int(name[1:3]) + (50 if self.held_out else 0))

    def spec(self, *sections: Section, **changes) -> Spec:
        """A network of these sections, with lane width, speed and direction drawn."""
        drawn = {
            "lane_width": self.lane_width(),
            "speed": self.speed(),
            "pieces": self.gentle(),
            "yaw": round(float(self.rng.uniform(-np.pi, np.pi)), 3),
            "spiral": self.length(50, 90),
        }
        return Spec(self.name, sections, held_out=self.held_out, **(drawn | changes))

    def length(self, low: float, high: float) -> float:
        """m, whole."""
        return float(round(self.rng.uniform(low, high)))

    def radius(self, low: float, high: float) -> float:
        """m, left or right; as many curves per curvature, so sharp ones are rarer than gentle ones."""
        return float(self.rng.choice((-1.0, 1.0))) * self.turn(low, high)

    def turn(self, low: float, high: float) -> float:
        """m, the size of a radius."""
        return float(round(1.0 / self.rng.uniform(1.0 / high, 1.0 / low)))

    def lane_width(self) -> float:
        narrow = round(float(self.rng.uniform(*NARROW)), 2)
        return LANE_WIDTH if self.rng.random() < STANDARD_SHARE else narrow

    def speed(self) -> float:
        return round(float(self.rng.choice(SPEEDS)) * MPH, 2)

    def gentle(self) -> tuple[tuple[float, float], ...]:
        """Alignment of a road that is not meant to be curved: few real ones are straight throughout."""
        return (self.length(100, 300), 0.0), (1.0, self.radius(2200, 40000))

    def ramp(self, left: bool = False) -> RampShape:
        """A ramp that leaves at a small angle and bends once more, by 110 degrees at most."""
        length = float(round(self.rng.triangular(90, 150, 480)))
        sharpest = max(50.0, 0.35 * length)
        bent = float(round(np.exp(self.rng.uniform(np.log(sharpest), np.log(400.0)))))
        return RampShape(
            length=length,
            radius=bent if self.rng.random() < BENT_SHARE else 3000.0,
            speed=round(float(self.rng.uniform(15.6, 20.1)), 2),
            angle=round(float(self.rng.uniform(0.07, 0.11)), 3),
            left=left,
            spiral=20.0,
        )

    def loop(self) -> RampShape:
        """A ramp that turns by 130 to 180 degrees, as in a cloverleaf."""
        radius = self.turn(44, 62)
        return RampShape(
            length=float(round(60 + self.rng.uniform(2.2, 3.1) * radius)),
            radius=radius,
            speed=round(float(self.rng.uniform(11.2, 13.4)), 2),
            angle=0.12,
            loop=True,
            spiral=30.0,
        )
