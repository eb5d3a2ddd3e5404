"""Memory grows no faster than the number of worlds."""

from __future__ import annotations

import gc
import resource
import subprocess
import sys

import pytest
import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.config import ScenarioConfig, TaskConfig
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.environment import Environment
from tests.helpers.rollouts import token
from tests.helpers.straight_road import straight_network

MOST = 1.2  # times linear growth
SLOTS = 48


def environment(bundle: MapBundle, worlds: int) -> Environment:
    scenarios = ScenarioConfig(agent_scale=0.25)
    return Environment([bundle], worlds, SLOTS, TaskConfig(scenarios=scenarios), training=True)


def coast(env: Environment, steps: int) -> None:
    for _ in range(steps):
        env.step(torch.full(env.worlds.active.shape, token(0.0, 0.0)))


def held_bytes() -> int:
    """Of all tensors alive, shared storage counted once."""
    gc.collect()
    tensors = [o for o in gc.get_objects() if type(o) is torch.Tensor]
    return sum({t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}.values())


def test_what_an_environment_holds_grows_with_the_worlds_only(straight_map):
    before, held = held_bytes(), []
    for worlds in (8, 32, 128):
        env = environment(straight_map, worlds)
        coast(env, 3)
        held.append(held_bytes() - before)
        del env
    assert held[1] / held[0] < MOST * 4 and held[2] / held[1] < MOST * 4, held
    per_agent = (held[2] - held[1]) / (96 * SLOTS)
    assert per_agent < 10_000, per_agent  # bytes: observation, noise, state and the spare scenario


@pytest.mark.slow
def test_the_peak_grows_with_the_worlds_only():
    """Of a whole process, with the step's temporary tensors; the pairs of slots are the largest of them.

    Twice the worlds are added the second time; what the process weighs without any drops out.
    """
    command = [sys.executable, "-m", "tests.properties.test_scale"]
    peaks = [
        int(subprocess.run([*command, str(worlds)], capture_output=True, text=True, check=True).stdout)
        for worlds in (256, 512, 1024)
    ]
    first, second = peaks[1] - peaks[0], peaks[2] - peaks[1]
    assert first > 20e6, peaks
    assert second / first < MOST * 2, peaks


def print_peak(worlds: int) -> None:
    """Peak resident bytes of this process after some steps."""
    torch.set_num_threads(1)
    coast(environment(build_bundle(straight_network()), worlds), 5)
    print(1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


if __name__ == "__main__":
    print_peak(int(sys.argv[1]))
