"""The policies of a run: one for all, and those that vehicles name in ``phase.policy``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from phase_sumo.config import Actions, SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.observation import Observation


class Driver(Protocol):
    """What drives: `phase_sumo.policy.checkpoint.Policy`, or a stand-in in tests."""

    @property
    def sim(self) -> SimConfig: ...

    @property
    def actions(self) -> Actions: ...

    def act(self, observation: Observation, generator: torch.Generator | None = None) -> Tensor:
        """Action tokens [A] of the observing agents."""
        ...


class Drivers:
    """Policies by number; the run's common one is number 0."""

    def __init__(self, common: Driver, folder: Path = Path()) -> None:
        """``folder`` is what relative file names in ``phase.policy`` start from."""
        self._drivers = [common]
        self._folder = folder
        self._number: dict[str, int] = {}

    def __getitem__(self, number: int) -> Driver:
        return self._drivers[number]

    def __iter__(self) -> Iterator[Driver]:
        return iter(self._drivers)

    @property
    def dt(self) -> float:
        """Step of all the policies in s."""
        return self._drivers[0].sim.dt

    def number(self, policy: str | None) -> int:
        """Number of a policy file, read when it is first asked for; None is the common one."""
        if policy is None:
            return 0
        if policy not in self._number:
            driver = load_policy(self._folder / policy)
            if driver.sim.dt != self.dt:
                raise PhaseError(
                    f"{policy}: drives in steps of {driver.sim.dt:g} s, the run's policy in steps of "
                    f"{self.dt:g} s; run them apart"
                )
            self._drivers.append(driver)
            self._number[policy] = len(self._drivers) - 1
        return self._number[policy]
