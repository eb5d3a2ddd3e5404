"""Throughput of each part: CPU time per unit of work, so that other load on the machine matters little."""

from __future__ import annotations

import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import torch

from phase_sumo.config import POOLS, REGIMES, ScenarioConfig, TrainConfig
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.environment import Environment, tensors
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.synthetic_road import freeway

Progress = Callable[[float, str], None]
Result = TypeVar("Result")
WARM_UP = 10  # steps
BRIDGE_WARM_UP = 30  # steps of SUMO: all vehicles are taken over, kernels of their number are made
SIZES = ((16, 64), (16, 256))  # worlds x slots
ROOM = 40.0  # m of lane per vehicle: random starts find a place for nearly all
FREEWAYS = (6, 24, 99, 399)  # km of lane: whole sections of a two-way freeway of six lanes


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text(encoding="utf-8").splitlines()
            if "model name" in line
        ]
        model = names[0] if names else model
    return {
        "processor": model,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def bench_sim(
    maps: list[MapBundle], worlds: int, slots: int, steps: int, seed: int, progress: Progress
) -> dict[str, Any]:
    """Compiled environment steps alone: kinematics, events, reward, resets, observation with noise.

    Full worlds: jammed traffic with rolling goals on those of the ``maps`` that have `ROOM` for all agents,
    or else on a synthetic freeway that has. The shipped policy drives; its own time is not counted. With it
    go the CPU time of each part, the bytes that a step must at least move, and which share of the speed of a
    plain copy that is.
    """
    policy = load_policy()
    config = TrainConfig()
    full = replace(REGIMES[0], agents=(slots, slots), agents_late=(slots, slots))
    scenarios = ScenarioConfig(regimes=(full,), rolling_worlds=1.0)
    env = Environment(
        [replace(m, pools=m.pools[:1]) for m in _roomy(maps, slots)],
        worlds,
        slots,
        replace(config, sim=policy.sim, actions=policy.actions, scenarios=scenarios),
        seed=seed,
        compiled=True,
    )
    parts = _timed_parts(env)
    generator = torch.Generator().manual_seed(seed)
    spent, agent_steps, seen = 0.0, 0, env.observation
    for t in range(WARM_UP + steps):
        if t == WARM_UP:
            parts.update(dict.fromkeys(parts, 0.0))
        active = env.worlds.controlled
        action = torch.zeros(active.shape, dtype=torch.long)
        action[active] = policy.act(seen.rows(active), generator)
        acting = int(active.sum())
        began = time.process_time()
        env.step(action)
        seen = env.observation
        if t >= WARM_UP:
            spent += time.process_time() - began
            agent_steps += acting
        progress((t + 1) / (WARM_UP + steps), "simulator")
    bytes_moved = _step_bytes(env)
    return _per_step("sim", agent_steps, spent) | {
        "worlds": worlds,
        "slots": slots,
        "active_share": agent_steps / (steps * worlds * slots),
        **{f"{part}_cpu_us": 1e6 * seconds / agent_steps for part, seconds in parts.items()},
        "bytes_per_agent_step": bytes_moved,
        "share_of_memory_bandwidth": bytes_moved * agent_steps / spent / _copy_speed(),
    }


def _roomy(maps: list[MapBundle], slots: int) -> list[MapBundle]:
    """The maps with room for ``slots`` jammed vehicles, or a freeway made for them."""
    from phase_sumo.bridge.maps.convert import build_bundle

    fitting = [m for m in maps if len(m.graph.node_lane) >= ROOM * slots]  # a node every metre
    return fitting or [build_bundle(freeway(ROOM * slots / 1000.0))]


def _timed_parts(env: Environment) -> dict[str, float]:
    """CPU seconds of the parts of all steps of ``env`` from now on; they grow as it steps."""
    spent: dict[str, float] = {"advance": 0.0, "look": 0.0, "resample": 0.0}

    def timed(part: str, work: Callable[..., Result]) -> Callable[..., Result]:
        def run(*args: Any) -> Result:
            began = time.process_time()
            result = work(*args)
            spent[part] += time.process_time() - began
            return result

        return run

    for part in spent:
        setattr(env, f"_{part}", timed(part, getattr(env, f"_{part}")))
    return spent


def _step_bytes(env: Environment) -> float:
    """Bytes per agent that a step has to read or write: state, road rows, noise, observation."""
    agents = env.worlds.active.numel()
    written = sum(t.numel() * t.element_size() for t in tensors(env.observation))
    state = 2 * sum(t.numel() * t.element_size() for t in tensors(env.worlds))
    road = 4.0 * (env.road_map.view[0].numel() + 2 * env.road_map.border[0].numel())
    noise = 4.0 * (4 * env.task.sim.neighbours + 2 * env.road_map.view.shape[2])
    return (written + state) / agents + road + noise


def _copy_speed() -> float:
    """Bytes per CPU second that a copy of 256 MB reads and writes."""
    source = torch.zeros(2**26)
    target = source.clone()
    began = time.process_time()
    for _ in range(4):
        target.copy_(source)
    return 4 * 2 * source.numel() * 4 / (time.process_time() - began)


def bench_train(maps: list[MapBundle], config: TrainConfig, updates: int, progress: Progress) -> dict:
    """Simulation, policy and learning end to end, with the default training configuration.

    Beside the rate per CPU second stands the one per second, which more threads raise.
    """
    from phase_sumo.train.loop import Trainer
    from phase_sumo.train.run_folder import RunFolder

    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as folder:
        config = replace(config, total_steps=10**9, checkpoint_every=10**9, held_out_every=10**9)
        trainer = Trainer(config, maps, [], RunFolder(folder))
        rows: list[dict[str, float]] = []

        def note(row: dict[str, float]) -> None:
            rows.append(row)
            progress(len(rows) / (updates + 1), "training")

        trainer.run(note, stopping=lambda: len(rows) == 1)
        began, clock, warm = time.process_time(), time.perf_counter(), trainer.steps
        trainer.run(note, stopping=lambda: len(rows) > updates)
        spent, passed = time.process_time() - began, time.perf_counter() - clock
    counted = rows[1:]
    steps = sum(row["agent_steps"] for row in counted)
    parts = {
        f"{part}_cpu_us": sum(row[f"{part}_cpu_us"] * row["agent_steps"] for row in counted) / steps
        for part in ("rollout", "learn")
    }
    trained = int(trainer.steps - warm)
    return _per_step("train", trained, spent) | parts | {"agent_steps_per_wall_second": trained / passed}


def bench_convert(networks: list[Path], progress: Progress) -> dict[str, Any]:
    """Conversion of networks to map bundles by part, pictures left out, and how its cost grows with length.

    Returns:
        CPU seconds per part over all ``networks``, km of lane per CPU second overall and for lane graph and
        pools alone, and the same for synthetic freeways of growing length.
    """
    from phase_sumo.bridge.maps.sumo_network import read_network

    jobs = [(path.name, lambda path=path: read_network(path)) for path in networks]
    jobs += [(f"{km:g} km of lane", lambda km=km: freeway(km)) for km in FREEWAYS]
    costs = []
    for done, (name, read) in enumerate(jobs):
        costs.append(_conversion(read))
        progress((done + 1) / len(jobs), name)
    total = {part: sum(cost[part] for cost in costs[: len(networks)]) for part in costs[0]}
    lane_km = total.pop("lane_km")
    return {
        "part": "convert",
        "lane_km": lane_km,
        "cpu_seconds": sum(total.values()),
        "lane_km_per_cpu_second": lane_km / sum(total.values()),
        "graph_and_pool_lane_km_per_cpu_second": lane_km / (total["graph"] + total["pools"]),
        "cpu_seconds_of_part": total,
        "by_length": {
            f"{cost['lane_km']:.0f} km": {
                "cpu_seconds_per_lane_km": (sum(cost.values()) - cost["lane_km"]) / cost["lane_km"],
                "graph_and_pool_lane_km_per_cpu_second": cost["lane_km"] / (cost["graph"] + cost["pools"]),
            }
            for cost in costs[len(networks) :]
        },
    }


def _conversion(read: Callable[[], LaneNetwork]) -> dict[str, float]:
    """CPU seconds of each part of converting one network, and its ``lane_km``."""
    from phase_sumo.bridge.maps.road_lines import road_lines
    from phase_sumo.sim.bundle import save_bundle
    from phase_sumo.sim.lane_graph import build_lane_graph
    from phase_sumo.sim.pool import build_pool
    from phase_sumo.sim.road_build import build_road_map

    parts: dict[str, float] = {}

    def timed(part: str, work: Callable[[], Result]) -> Result:
        began = time.process_time()
        result = work()
        parts[part] = time.process_time() - began
        return result

    network = timed("read", read)
    graph = timed("graph", lambda: build_lane_graph(network))
    pools = timed("pools", lambda: tuple(build_pool(graph, regime) for regime in POOLS))
    road_map = timed("road_map", lambda: build_road_map(road_lines(network), graph))
    bundle = MapBundle(network.name, road_map, graph, pools)
    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as folder:
        timed("save", lambda: save_bundle(Path(folder) / "map.npz", bundle))
    return parts | {"lane_km": len(graph.node_xy) / 1000.0}  # a node every metre


def bench_full_freeway(vehicles: int, steps: int, seed: int, progress: Progress) -> dict[str, Any]:
    """`bench_bridge` on a synthetic motorway that holds ``vehicles`` from the first step on."""
    from phase_sumo.studies.full_freeway import write_full_freeway

    if vehicles < 1 or steps < 2:
        raise PhaseError(f"--vehicles {vehicles} --steps {steps}: pass 1 vehicle and 2 steps at least")
    seconds = 0.1 * (BRIDGE_WARM_UP + steps)
    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as folder:
        cfg = write_full_freeway(Path(folder), vehicles, seconds, seed)
        return bench_bridge(cfg, steps, seed, progress)


def bench_bridge(cfg: Path, steps: int | None, seed: int, progress: Progress) -> dict[str, Any]:
    """A scenario through libsumo with every vehicle under PHASE, and under SUMO's IDM for the difference.

    All figures are those after `BRIDGE_WARM_UP` steps, recording of trajectories apart: its cost comes on
    top where it is on.

    Args:
        steps: of SUMO after the warm-up, 2 at least, nothing is decided after the last one; None runs the
            scenario to its end.
    """
    from phase_sumo.bridge.run import run_scenario
    from phase_sumo.bridge.sumo.options import read_scenario
    from phase_sumo.studies.stopwatch import Stopwatch

    watches: dict[str, Stopwatch] = {}
    scenario = read_scenario(cfg)
    seconds = scenario.step_length * (BRIDGE_WARM_UP + (steps or 0))
    end = None if steps is None else scenario.begin + seconds
    for number, model in enumerate(("phase", "idm")):

        def shown(done: float, text: str, number: int = number, model: str = model) -> None:
            progress((number + done) / 2, f"{model}: {text}")

        with tempfile.TemporaryDirectory(prefix="phase_sumo_") as folder, Stopwatch(BRIDGE_WARM_UP) as watch:
            run_scenario(
                cfg,
                phase=model == "phase",
                model="idm",
                seed=seed,
                end=end,
                output_dir=folder,
                progress=shown,
            )
        watches[model] = watch
    phase, idm = watches["phase"], watches["idm"]
    if not phase.vehicle_steps:
        raise PhaseError(f"{cfg}: no vehicle was driven by PHASE after {BRIDGE_WARM_UP} steps")
    record_cpu, record_wall = phase.cpu.pop("record"), phase.wall["record"]
    spent = phase.total_cpu - record_cpu
    parts = phase.cpu | {"rest": spent - sum(phase.cpu.values())}
    per_vehicle_step = 1e6 / phase.vehicle_steps
    return _per_step("bridge", phase.vehicle_steps, spent) | {
        "vehicles": phase.vehicle_steps / phase.decisions,
        "real_time_factor": phase.steps * scenario.step_length / (phase.total_wall - record_wall),
        **{f"{part}_cpu_us": per_vehicle_step * seconds for part, seconds in parts.items()},
        "record_cpu_us": per_vehicle_step * record_cpu,
        "idm_sumo_cpu_us": per_vehicle_step * idm.cpu["sumo"],
        "ratio_to_idm_sumo": spent / idm.cpu["sumo"],
    }


def _per_step(part: str, agent_steps: int, cpu_seconds: float) -> dict[str, Any]:
    return {
        "part": part,
        "agent_steps": agent_steps,
        "agent_steps_per_second": agent_steps / cpu_seconds,
        "cpu_us_per_agent_step": 1e6 * cpu_seconds / agent_steps,
    }
