"""The public benchmark: fixed inputs, and rates that can be checked by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import ActionConfig
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate import benchmark
from phase_sumo.evaluate.fixed_worlds import prior_driver
from phase_sumo.sim.bundle import MapBundle
from tests.helpers.places import HELD_OUT


@pytest.fixture(scope="module")
def maps() -> list[MapBundle]:
    return [build_bundle(read_network(path)) for path in sorted(HELD_OUT.glob("*.net.xml"))]


@pytest.fixture(scope="module")
def public(maps) -> benchmark.Benchmark:
    return benchmark.load_benchmark(maps[::-1])  # in whatever order


def test_its_maps_and_worlds_are_those_of_the_repository_in_all_regimes(public):
    counts = torch.bincount(public.regime)
    assert counts.tolist() == [24] * 4
    agents = [int(public.start.active[public.regime == r].sum()) for r in range(4)]
    assert agents == sorted(agents, reverse=True) and sum(agents) == 5085
    for count, number in zip(public.start.active.sum(-1).tolist(), public.regime.tolist(), strict=True):
        least = benchmark.SCENARIOS.regimes[number].agents_late[0] * benchmark.SCENARIOS.agent_scale
        assert count >= 0.9 * least
    # every agent begins on its road, apart from the others, with a goal ahead
    state, task, there = public.start.state, public.start.task, public.start.active
    ahead = (task.goal_x - state.x) * torch.cos(state.yaw) + (task.goal_y - state.y) * torch.sin(state.yaw)
    assert bool((ahead[there] > 10.0).all())


@pytest.mark.parametrize("name", ["speed", "task.alpha", "shape.length", "world.regime"])
def test_one_changed_number_is_one_clear_error(maps, tmp_path, name):
    with np.load(benchmark.WORLDS) as data:
        arrays = dict(data)
    arrays[name] = arrays[name].copy()
    arrays[name][0] = np.nextafter(arrays[name][0], np.float32(9.0)) if "." not in name[:6] else 1
    np.savez(tmp_path / "worlds.npz", **arrays)
    with pytest.raises(PhaseError, match=r"SHA-256 .* expected .* restore networks/held_out"):
        benchmark.load_benchmark(maps, tmp_path / "worlds.npz")


def test_another_map_is_refused(maps, straight_map):
    with pytest.raises(PhaseError, match="SHA-256"):
        benchmark.load_benchmark([*maps[:-1], straight_map])


def test_what_is_stored_is_what_was_sampled(maps, tmp_path):
    start, regime = benchmark.sample_worlds(maps, 1)
    benchmark.save_worlds(start, regime, tmp_path / "w.npz")
    with np.load(tmp_path / "w.npz") as data:
        again, regimes = benchmark._unpack(dict(data))
    assert torch.equal(regime, regimes) and torch.equal(start.map_index, again.map_index)
    for mine, theirs in ((start.state, again.state), (start.shape, again.shape), (start.task, again.task)):
        for name, values in vars(mine).items():
            assert torch.equal(values[start.active], getattr(theirs, name)[again.active]), name


def test_the_result_does_not_depend_on_how_many_worlds_run_together(public):
    rows = torch.tensor([0, 30, 60, 90])  # one of each regime
    few = benchmark.Benchmark(public.start.map(lambda v: v[rows]), public.regime[rows], public.road_map)
    driver = prior_driver(ActionConfig())
    results = [benchmark.run_benchmark(few, driver, ActionConfig(), together=n) for n in (1, 3)]
    assert results[0] == results[1]
    assert results[0]["scenarios"] == 4
    assert sum(group["agents"] for group in results[0]["by_regime"].values()) == results[0]["agents"]


def test_rates_weigh_every_world_alike():
    counted = torch.tensor([[True, True, True, True], [True, False, False, False], [False] * 4])
    outcomes = torch.zeros(3, 4, 5, dtype=torch.bool)
    outcomes[0, :2, 0] = True  # goal: half of the first world, all of the second
    outcomes[1, :, 0] = True
    result = benchmark.rates(outcomes, counted)
    assert (result["scenarios"], result["agents"]) == (2, 5)
    goal = result["goal_rate"]
    assert goal["mean"] == 0.75 and goal["std"] == pytest.approx(0.5 / 2**0.5)
    assert (goal["low"], goal["high"]) == (0.5, 1.0)
