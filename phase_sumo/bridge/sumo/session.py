"""One SUMO simulation: start, step, close."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time as clock
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import traci

from phase_sumo.errors import PhaseError

_taken = threading.Lock()  # held while this process has a simulation: by whichever thread


class Simulation:
    """A running simulation, whoever started it.

    Attributes:
        api: the ``libsumo`` or ``traci`` module, or one of traci's connections.
        step_length: s.
        refused, failed: what the api raises when SUMO refuses a call, and when it cannot go on.
    """

    def __init__(self, api: Any, reason: Callable[[Exception], str] = str) -> None:
        """``reason`` tells in SUMO's words why a step failed."""
        self.api = api
        self.step_length = float(api.simulation.getDeltaT())
        self.refused: type[Exception] = getattr(api, "TraCIException", traci.TraCIException)
        self.failed: type[Exception] = getattr(api, "FatalTraCIError", traci.FatalTraCIError)
        self._reason = reason
        # they bring vehicles that SUMO does not expect, up to the end that it was given
        self._calibrated = bool(api.calibrator.getIDList()) and float(api.simulation.getEndTime()) >= 0

    @property
    def used_up(self) -> bool:
        """No vehicle or person is there, or still to come."""
        return not self._calibrated and self.api.simulation.getMinExpectedNumber() == 0

    @property
    def time(self) -> float:
        """Seconds since the scenario's midnight."""
        return float(self.api.simulation.getTime())

    def step(self) -> None:
        """Advance by one step of SUMO."""
        time = self.time
        try:
            self.api.simulationStep()
        except (self.refused, self.failed) as error:
            raise PhaseError(f"SUMO stopped at {time:g} s: {self._reason(error)}") from None


def bare(api: Any, domain: str, name: str) -> Callable[..., Any]:
    """A function of the api for loops over vehicles: libsumo's own, without the Python around it."""
    native = getattr(api, "_libsumo", None)
    return getattr(native, f"{domain}_{name}", None) or getattr(getattr(api, domain), name)


class Session:
    """Starts a simulation; use it as a context manager so that SUMO closes its outputs in every case.

    libsumo holds one simulation per process and would silently replace it, so a second one is refused:
    run several scenarios in processes of their own.
    """

    def __init__(self, args: list[str], work_dir: Path, gui: bool = False, over_traci: bool = False) -> None:
        """``over_traci`` runs SUMO in a process of its own instead of through libsumo, as a window does."""
        self._args = args
        self._gui = gui
        self._over_traci = over_traci or gui  # libsumo has windows on Linux only, and may hang closing them
        self._log = work_dir / "sumo_errors.txt"
        self._api: Any

    def __enter__(self) -> Simulation:
        if self._gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            raise PhaseError(
                "no display for SUMO's window (DISPLAY is not set): run it on a desktop, over ssh -X, under "
                "xvfb-run -a, or without --gui"
            )
        if not _taken.acquire(blocking=False):
            raise PhaseError(
                "a SUMO simulation is already running in this process; run this one in another process"
            )
        try:
            return self._start()
        except BaseException:
            _taken.release()
            raise

    def _start(self) -> Simulation:
        args = list(self._args)
        if "--error-log" not in args:
            args += ["--error-log", str(self._log.resolve())]
        if self._gui:
            args += ["--start", "true", "--quit-on-end", "true"]
        binary = "sumo-gui" if self._gui else "sumo"
        self._api = traci
        try:
            if self._over_traci:
                _start_sumo(binary, args)
            else:
                import libsumo

                if libsumo.isLoaded():  # SUMO would replace it without a word
                    raise PhaseError(
                        "libsumo runs a simulation that was started elsewhere in this process; close it "
                        "first, or let PhaseFleet drive in it"
                    )
                self._api = libsumo
                libsumo.start([binary, *args])
            return Simulation(self._api, self._reason)
        except PhaseError:
            raise
        except Exception as error:
            raise PhaseError(f"SUMO did not start: {self._reason(error)}") from None
        except BaseException:  # Ctrl-C while SUMO reads its network: its outputs are open already
            with suppress(Exception):
                self._api.close()
            raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._api.close()
        except Exception:
            if error is None:
                raise
        finally:
            _taken.release()
        if self._log.is_file() and self._log.stat().st_size == 0:
            self._log.unlink()

    def _reason(self, error: Exception) -> str:
        """Why SUMO failed, in its own words: in its log once all is closed."""
        with suppress(Exception):
            self._api.close()
        if self._over_traci:
            self._wait_for_log()
        else:
            _clean_up(self._api)
        text = self._log.read_text(encoding="utf-8", errors="replace") if self._log.is_file() else ""
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("Error")]
        return " ".join(errors or lines[-2:] or str(error).split())

    def _wait_for_log(self) -> None:
        """SUMO's process may still be ending."""
        for _ in range(20):
            if self._log.is_file() and self._log.stat().st_size:
                return
            clock.sleep(0.05)


def _start_sumo(binary: str, args: list[str]) -> None:
    import sumolib

    # the program itself: its Python wrapper would leave it running when killed
    program = sumolib.checkBinary(binary)
    with redirect_stdout(sys.stderr):  # traci tells about its tries
        traci.start([program, *args])


def _clean_up(libsumo: Any) -> None:
    """What a simulation that failed leaves in libsumo goes with a step of one without vehicles.

    Poses that were told and never stepped to are kept, and may crash the next simulation; the error log may
    not be written out.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".net.xml") as net:
        net.write('<net version="1.20"/>')
        net.flush()
        libsumo.start(["sumo", "-n", net.name, "--no-step-log", "true", "--no-warnings", "true"])
        libsumo.simulationStep()
        libsumo.close()
