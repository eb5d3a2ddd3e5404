"""How a scenario is driven: one set of options for `run_scenario`, `compare`, the search and `PhaseFleet`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from phase_sumo.bridge.fleet.drivers import Driver
from phase_sumo.bridge.fleet.parameters import Choice
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.bridge.sumo.conventions import DRIVEN_CLASSES
from phase_sumo.errors import PhaseError, nearest
from phase_sumo.sim.lanes import LaneNetwork


@dataclass(frozen=True, kw_only=True)
class DriveOptions:
    """Who drives which vehicles where, until when, with which options of SUMO.

    Attributes:
        policy: a loaded policy or its file; None loads the shipped one.
        share: of the vehicles that PHASE may drive, 0..1; the same seed and id always decide alike, and a
            larger share adds vehicles to those of a smaller one. None is 1, or 0 with ``explicit`` ids.
        types: vTypes that the share is taken of; empty for all that PHASE can drive.
        explicit: ids of vehicles that PHASE drives in any case.
        deterministic: meet the share by counting vehicles instead of drawing.
        alpha: longitudinal action range of every vehicle, or bounds to draw it from (see `Choice`).
        time_gap: s to the leader that target speeds leave, 0 for the policy alone; None takes each vType's
            tau.
        guard: keep PHASE vehicles from what is unsafe, see `phase_sumo.sim.guard`.
        phase: False leaves every vehicle to SUMO, whatever is said of it.
        model: SUMO car-following model (``"idm"``, ``"krauss"`` ...) for all vehicles that SUMO drives; None
            leaves what the scenario says.
        roads: ``"freeway"`` observes and drives motorways and ramps only, ``"all"`` every road.
        seed: SUMO's and ours; None is the scenario's.
        end: stop at this time in s instead of the scenario's end.
        sumo_options: further SUMO options, e.g. ``("--fcd-output", "fcd.xml")``.
    """

    policy: Driver | str | Path | None = None
    share: float | None = None
    types: Sequence[str] = ()
    explicit: Sequence[str] = ()
    deterministic: bool = False
    alpha: float | tuple[float, float] | None = None
    time_gap: float | None = None
    guard: bool = True
    phase: bool = True
    model: str | None = None
    roads: Literal["freeway", "all"] = "freeway"
    seed: int | None = None
    end: float | None = None
    sumo_options: Sequence[str] = ()

    def choice(self, seed: int) -> Choice:
        """Which vehicles, and how; ``seed`` is the one in force.

        Raises:
            PhaseError: a value is out of its bounds.
        """
        return Choice(
            share=self.share,
            types=tuple(self.types or ()),
            alpha=self.alpha,
            seed=seed,
            explicit=tuple(self.explicit),
            deterministic=self.deterministic,
            time_gap=self.time_gap,
            guard=self.guard,
        )

    def network(self, path: str | Path) -> LaneNetwork:
        """The roads of a network that are observed, see `read_network`."""
        return read_network(path, self.roads, DRIVEN_CLASSES)

    def changed(self, values: Mapping[str, Any]) -> DriveOptions:
        """The same with other values.

        Raises:
            PhaseError: there is no option of that name.
        """
        known = [field.name for field in fields(self)]
        for name in values:
            if name not in known:
                raise PhaseError(
                    f"there is no option {name!r}{nearest(name, known)}; there are {', '.join(known)}"
                )
        return replace(self, **values)
