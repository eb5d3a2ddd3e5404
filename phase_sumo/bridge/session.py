"""One SUMO simulation in this process: start, step, close."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, TracebackType

from phase_sumo.errors import PhaseError

_running = False


class Session:
    """A running simulation; use it as a context manager so that SUMO closes its outputs in every case.

    libsumo holds one simulation per process and would silently replace it, so a second one is refused:
    run several scenarios in processes of their own.

    Attributes:
        api: the ``libsumo`` module (``traci`` with a window where libsumo has none).
        gui: SUMO shows its window.
        step_length: s.
        departed, arrived: ids of the vehicles that entered and left in the last step.
    """

    def __init__(self, args: list[str], work_dir: Path, gui: bool = False) -> None:
        self._args = args
        self.gui = gui
        self._log = work_dir / "sumo_errors.txt"
        self.api: ModuleType
        self.step_length = 1.0
        self.departed: tuple[str, ...] = ()
        self.arrived: tuple[str, ...] = ()

    def __enter__(self) -> Session:
        global _running
        if _running:
            raise PhaseError(
                "a SUMO simulation is already running in this process; run this one in another process"
            )
        self.api = _client(self.gui)
        args = list(self._args)
        if "--error-log" not in args:
            args += ["--error-log", str(self._log.resolve())]
        if self.gui:
            args += ["--start", "true", "--quit-on-end", "true"]
        try:
            self.api.start([_binary(self.gui), *args])
        except Exception as error:
            raise PhaseError(f"SUMO did not start: {self._reason() or error}") from None
        _running = True
        self.step_length = float(self.api.simulation.getDeltaT())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        global _running
        _running = False
        try:
            self.api.close()
        except Exception:
            if error is None:
                raise
        if self._log.is_file() and self._log.stat().st_size == 0:
            self._log.unlink()

    @property
    def time(self) -> float:
        """Seconds since the scenario's midnight."""
        return float(self.api.simulation.getTime())

    def step(self, moved: Callable[[], None] | None = None) -> None:
        """Advance by one step of SUMO.

        Args:
            moved: called after SUMO moved its vehicles and before it writes its outputs.
        """
        try:
            self.api.simulation.executeMove()
            # the second part of the step empties these lists
            self.departed = tuple(self.api.simulation.getDepartedIDList())
            self.arrived = tuple(self.api.simulation.getArrivedIDList())
            if moved:
                moved()
            self.api.simulationStep()
        except self.api.TraCIException as error:
            raise PhaseError(f"SUMO stopped at {self.time:g} s: {self._reason() or error}") from None

    def _reason(self) -> str:
        if not self._log.is_file():
            return ""
        lines = [line.strip() for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("Error")]
        return " ".join(errors or lines[-2:])


def _client(gui: bool) -> ModuleType:
    if gui and not sys.platform.startswith("linux"):
        import traci  # libsumo has no window there

        return traci
    import libsumo

    return libsumo


def _binary(gui: bool) -> str:
    if gui and not sys.platform.startswith("linux"):
        import sumolib

        return sumolib.checkBinary("sumo-gui")
    return "sumo-gui" if gui else "sumo"
