"""Runs of `run_scenario` in processes of their own: libsumo holds one simulation per process."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any

from phase_sumo.bridge.run import run_scenario
from phase_sumo.errors import PhaseError
from phase_sumo.signals import SIGNALS


def run_all(
    tasks: Sequence[dict[str, Any]], jobs: int = 1, progress: Callable[[float, str], None] | None = None
) -> list[dict[str, Any]]:
    """Call ``run_scenario(**task)`` for every task, ``jobs`` at a time, and return the results in order.

    The processes are spawned, so a script that calls this needs ``if __name__ == "__main__":``.

    Raises:
        PhaseError: a run refused its input; the other runs are stopped.
        RuntimeError: a run failed otherwise; the message holds its traceback.
    """
    context = multiprocessing.get_context("spawn")
    results: list[dict[str, Any] | None] = [None] * len(tasks)
    done = [0.0] * len(tasks)
    waiting = list(range(len(tasks)))
    running: dict[Connection, tuple[int, Any]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < max(jobs, 1):
                number = waiting.pop(0)
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(theirs, tasks[number]), daemon=True)
                process.start()
                theirs.close()
                running[ours] = (number, process)
            for connection in wait(list(running)):
                assert isinstance(connection, Connection)
                number, process = running[connection]
                kind, value = _receive(connection)
                if kind == "progress":
                    done[number] = value[0]
                    if progress:
                        progress(
                            sum(done) / len(tasks), f"{tasks[number].get('label', '')} {value[1]}".strip()
                        )
                    continue
                process.join()
                connection.close()
                del running[connection]
                if kind == "refused":
                    raise PhaseError(value)
                if kind == "failed":
                    raise RuntimeError(value)
                results[number], done[number] = value, 1.0
    finally:
        for connection, (_, process) in running.items():
            process.terminate()
            process.join()
            connection.close()
    return [r for r in results if r is not None]


def _receive(connection: Connection) -> tuple[str, Any]:
    try:
        return connection.recv()
    except EOFError:
        return "failed", "a simulation process ended without a result (killed, or SUMO crashed)"


def _stop(number: int, _: FrameType | None) -> None:
    """End the run so that SUMO closes its outputs; Ctrl-C also comes through our parent: once is enough."""
    for each in SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt


def _work(connection: Connection, task: dict[str, Any]) -> None:
    import torch

    torch.set_num_threads(1)
    for each in SIGNALS:
        signal.signal(each, _stop)
    task = {k: v for k, v in task.items() if k != "label"}
    try:
        result = run_scenario(**task, progress=lambda f, text: connection.send(("progress", (f, text))))
        connection.send(("result", result))
    except PhaseError as error:
        connection.send(("refused", str(error)))
    except KeyboardInterrupt:
        connection.send(("failed", "interrupted"))
    except BaseException:
        connection.send(("failed", traceback.format_exc()))
    finally:
        connection.close()
