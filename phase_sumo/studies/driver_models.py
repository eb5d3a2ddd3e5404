"""The driver models that a comparison names: PHASE, shares of it, and SUMO's car-following models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from phase_sumo.bridge.sumo.demand import MODELS, sumo_model
from phase_sumo.errors import PhaseError


@dataclass(frozen=True)
class Model:
    """Who drives.

    Attributes:
        name: as the user spells it: ``"phase"``, ``"phase:0.3"``, ``"idm"``.
        share: of the vehicles that PHASE drives where it can; None for what `Choice` takes then.
        sumo: car-following model of the vehicles that SUMO drives, None for what the scenario says.
    """

    name: str
    share: float | None
    sumo: str | None

    @property
    def phase(self) -> bool:
        return is_phase(self.name)

    @property
    def folder(self) -> str:
        """The name without characters that file systems dislike."""
        return self.name.replace(":", "_")


def parse_models(names: Sequence[str], share: float | None = None) -> list[Model]:
    """``phase`` (with the given share), ``phase:0.3`` (30 % PHASE) and SUMO's models, each once.

    SUMO drives the rest of a PHASE run with the first SUMO model named, so that runs differ in the PHASE
    vehicles only.

    Raises:
        PhaseError: a name is not known or a share is not in (0, 1].
    """
    names = list(dict.fromkeys(n.lower() for n in names))
    if not names:
        raise PhaseError("no models to compare; name some of phase, phase:0.3, idm, krauss, eidm")
    for name in names:
        if not is_phase(name):
            sumo_model(name)
    background = next((n for n in names if not is_phase(n)), None)
    return [
        Model(name, _share(name, share), background) if is_phase(name) else Model(name, 0.0, name)
        for name in names
    ]


def is_phase(name: str) -> bool:
    """Whether PHASE drives vehicles under a model of this name."""
    return name.partition(":")[0] == "phase"


def label(name: str) -> str:
    """A model's name for people: ``PHASE``, ``PHASE 30 %``, ``IDM``."""
    if is_phase(name):
        _, colon, share = name.partition(":")
        return f"PHASE {100.0 * float(share):g} %" if colon else "PHASE"
    return MODELS.get(name, name)


def _share(name: str, default: float | None) -> float | None:
    _, colon, text = name.partition(":")
    if not colon:
        return default
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0.0 < share <= 1.0:
        raise PhaseError(f"model {name!r}: the share under PHASE is not above 0 and up to 1; write phase:0.3")
    return share
