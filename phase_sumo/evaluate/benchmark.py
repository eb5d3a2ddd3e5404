"""The public benchmark: fixed worlds on the held-out networks in all four traffic regimes.

The worlds lie in ``benchmark.npz``, since what a seed makes of them depends on the processor's arithmetic and
on every later change of the generator. ``benchmark.json`` holds the SHA-256 of the maps, as they are
simulated, and of the worlds; every run checks it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phase_sumo.config import Actions, ScenarioConfig, SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.fixed_worlds import Driver, Start, drive
from phase_sumo.evaluate.statistics import bootstrap_mean
from phase_sumo.evaluate.synthetic import RATES
from phase_sumo.sim import scenario
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.dimensions import KINDS
from phase_sumo.sim.environment import BRAKING_JERK
from phase_sumo.sim.pairs import PairTable
from phase_sumo.sim.road_map import RoadMap, merge
from phase_sumo.sim.vehicles import HISTORY, Task, VehicleShape, VehicleState

WORLDS = Path(__file__).with_name("benchmark.npz")
DIGEST = Path(__file__).with_name("benchmark.json")
SCENARIOS = ScenarioConfig(agent_scale=0.5)  # half the paper's agent counts, those after the switch
SLOTS = 128
WORLDS_PER_TUPLE = 4
STATE = ("x", "y", "yaw", "speed", "steer", "hitch")  # the others start at 0, the histories at these
PARTS = {VehicleShape: "shape", Task: "task"}


@dataclass(frozen=True)
class Benchmark:
    """The worlds and what they are.

    Attributes:
        start: [W, N].
        regime: [W] index into `config.REGIMES`.
        road_map: of all maps.
    """

    start: Start
    regime: Tensor
    road_map: RoadMap

    def of_regime(self, name: str) -> Start:
        """The worlds of one traffic regime."""
        index = [regime.name for regime in SCENARIOS.regimes].index(name)
        return self.start.map(lambda values: values[self.regime == index])


def sample_worlds(maps: Sequence[MapBundle], seed: int) -> tuple[Start, Tensor]:
    """Worlds for every map and regime: how ``benchmark.npz`` was made, once."""
    regimes = SCENARIOS.regimes
    tuples = [(m, r) for r in range(len(regimes)) for m in range(len(maps))]
    pairs = PairTable.of([(maps[m].graph, maps[m].pools[r]) for m, r in tuples], "cpu")
    table = scenario.RegimeTable.of([regimes[r] for _, r in tuples], SCENARIOS.agent_scale, SLOTS, "cpu")
    index = torch.arange(len(tuples)).repeat_interleave(WORLDS_PER_TUPLE)
    fresh = scenario.sample(
        pairs,
        table,
        index,
        SLOTS,
        True,
        SCENARIOS,
        SimConfig(),
        BRAKING_JERK,
        torch.Generator().manual_seed(seed),
    )
    map_index, regime = torch.tensor(tuples)[index].unbind(-1)
    return Start(
        fresh.shape, fresh.state, fresh.task, fresh.active, map_index, torch.arange(len(index))
    ), regime


def save_worlds(start: Start, regime: Tensor, path: Path = WORLDS) -> None:
    """Write the agents that there are, one row each."""
    world, slot = start.active.nonzero(as_tuple=True)
    columns = {name: getattr(start.state, name)[world, slot] for name in STATE}
    for part in (start.shape, start.task):
        for f in fields(part):
            columns[f"{PARTS[type(part)]}.{f.name}"] = getattr(part, f.name)[world, slot]
    arrays = {name: column.numpy() for name, column in columns.items()}
    of_worlds = {"world.map": start.map_index, "world.regime": regime}
    arrays |= {name: values.numpy().astype(np.int8) for name, values in of_worlds.items()}
    np.savez_compressed(path, **arrays, world=world.numpy().astype(np.int16))


def load_benchmark(maps: Sequence[MapBundle], worlds: Path = WORLDS, digest: Path = DIGEST) -> Benchmark:
    """The benchmark on its maps, in the order of their names.

    Raises:
        PhaseError: maps or worlds are not those that the SHA-256 stands for.
    """
    maps = sorted(maps, key=lambda bundle: bundle.name)
    with np.load(worlds, allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    expected = json.loads(digest.read_text(encoding="utf-8"))["sha256"]
    found = sha256(maps, arrays)
    if found != expected:
        raise PhaseError(
            f"benchmark: SHA-256 of its maps and worlds is {found[:16]}…, expected {expected[:16]}…: results "
            f"would compare with no others; restore networks/held_out and {worlds.name}, or use the version "
            "of phase_sumo that they belong to"
        )
    start, regime = _unpack(arrays)
    return Benchmark(start, regime, merge([bundle.road_map for bundle in maps]))


def sha256(maps: Sequence[MapBundle], worlds: dict[str, np.ndarray]) -> str:
    """Of every number that a simulation starts from: road maps, shapes, states and tasks (float32)."""
    digest = hashlib.sha256()
    for bundle in maps:
        digest.update(bundle.name.encode())
        _update(digest, bundle.road_map.arrays())
    _update(digest, worlds)
    return digest.hexdigest()


def _update(digest: Any, arrays: dict[str, np.ndarray]) -> None:
    for name in sorted(arrays):
        values = arrays[name]
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(np.ascontiguousarray(values).tobytes())


def _unpack(arrays: dict[str, np.ndarray]) -> tuple[Start, Tensor]:
    """Rows of agents -> slots of worlds; agents keep their order."""
    world = arrays["world"].astype(np.int64)
    count = np.bincount(world)
    slot = np.arange(len(world)) - np.repeat(np.cumsum(count) - count, count)
    size = len(arrays["world.map"]), int(count.max())

    def spread(name: str) -> Tensor:
        full = np.zeros(size, arrays[name].dtype)
        full[world, slot] = arrays[name]
        return torch.from_numpy(full)

    columns = {name: spread(name) for name in arrays if not name.startswith("world")}
    steer, still = columns["steer"], torch.zeros(size)
    state = VehicleState(
        **{name: columns[name] for name in STATE},
        accel=still,
        accel_history=torch.zeros(*size, HISTORY),
        steer_history=steer.unsqueeze(-1).repeat(1, 1, HISTORY),
    )
    shape, task = (
        part(**{f.name: columns[f"{name}.{f.name}"] for f in fields(part)}) for part, name in PARTS.items()
    )
    active = torch.zeros(size, dtype=torch.bool)
    active[world, slot] = True
    # slots without an agent need a body, or the model divides by its wheelbase
    empty = ~active
    shape.length[empty], shape.wheelbase[empty] = 4.9, 2.94
    map_index, regime = (torch.from_numpy(arrays[f"world.{n}"]).long() for n in ("map", "regime"))
    return Start(shape, state, task, active, map_index, torch.arange(size[0])), regime


def run_benchmark(
    benchmark: Benchmark,
    driver: Driver,
    actions: Actions,
    seed: int = 0,
    sampled: bool = False,
    together: int = 24,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Drive every world once and say what became of its agents.

    Args:
        driver: of all agents.
        actions: lattice that it chooses from.
        together: worlds side by side; the result does not depend on it.

    Returns:
        JSON types: ``scenarios``, ``agents``, and for each of `RATES` mean and standard deviation over the
        scenarios with the bootstrap interval (95 %) of the mean; the same per traffic regime and vehicle
        type under ``by_regime`` and ``by_type``.
    """
    parts = []
    for part in _batches(benchmark.start, together):
        parts.append(_outcomes(part, benchmark.road_map, driver, actions, seed, sampled))
        if progress is not None:
            progress(sum(map(len, parts)) / len(benchmark.regime))
    outcomes, start = torch.cat(parts), benchmark.start
    result = rates(outcomes, start.active)
    result["by_regime"] = {
        regime.name: rates(outcomes, start.active & (benchmark.regime == index).unsqueeze(-1))
        for index, regime in enumerate(SCENARIOS.regimes)
    }
    kind = start.shape.truck.int() + start.shape.articulated
    result["by_type"] = {
        name: rates(outcomes, start.active & (kind == index)) for index, name in enumerate(KINDS)
    }
    return result


def _batches(start: Start, size: int) -> Iterator[Start]:
    for first in range(0, len(start.number), size):
        yield start.map(lambda values, first=first: values[first : first + size])


def _outcomes(
    start: Start, road_map: RoadMap, driver: Driver, actions: Actions, seed: int, sampled: bool
) -> Tensor:
    """[W, N, rates] bool, what became of every agent in the order of `RATES`."""
    result = torch.zeros(*start.active.shape, len(RATES), dtype=torch.bool)
    for step in drive(start, road_map, driver, SimConfig(), actions, seed, sampled):
        o = step.outcome
        now = torch.stack((o.goal, o.collision, o.at_fault, o.road_edge, o.goal & ~o.at_fault), -1)
        result = torch.where(step.finished.unsqueeze(-1), now, result)
    return result


def rates(outcomes: Tensor, counted: Tensor) -> dict[str, Any]:
    """Rates of the agents ``counted`` [W, N]; worlds without any are left out."""
    agents = counted.sum(-1)
    some = agents > 0
    share = (outcomes & counted.unsqueeze(-1)).sum(1)[some].double() / agents[some].unsqueeze(-1)
    result: dict[str, Any] = {"scenarios": int(some.sum()), "agents": int(agents.sum())}
    for name, values in zip(RATES, share.T.numpy(), strict=True):
        interval = bootstrap_mean(values)
        result[name] = {
            "mean": interval.mean,
            "std": float(values.std(ddof=1)) if len(values) > 1 else 0.0,
            "low": interval.low,
            "high": interval.high,
        }
    return result
