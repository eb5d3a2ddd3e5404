"""Two processes make the update that one process with all their worlds would make."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch.multiprocessing.spawn import spawn

from phase_sumo.config import TrainConfig
from phase_sumo.errors import PhaseError
from phase_sumo.policy.build import build_network
from phase_sumo.sim.bundle import load_bundle, save_bundle
from phase_sumo.sim.environment import Environment
from phase_sumo.train import distributed
from phase_sumo.train.loop import Trainer
from phase_sumo.train.ppo import ValueScale, filter_samples, learn, make_samples
from phase_sumo.train.presets import preset
from phase_sumo.train.rollout import Buffer, Rollout, collect
from phase_sumo.train.run_folder import RunFolder

# one minibatch, so that the shuffling of the processes does not matter; what clipping scales it would hide
CONFIG = dataclasses.replace(
    preset("smoke"), worlds=5, slots=12, minibatch=10_000, gradient_norm=1e6, bf16=False, rollout=4
)


def network(config: TrainConfig):
    torch.manual_seed(3)
    return build_network(config.network, config.actions)


def experience(bundle: Path) -> Rollout:
    """What all worlds went through, drawn by the networks themselves."""
    config = CONFIG
    env = Environment(
        [load_bundle(bundle)],
        config.worlds,
        config.slots,
        config,
    )
    generator = torch.Generator().manual_seed(0)
    net, buffer = network(config).eval(), Buffer(env, config.rollout)
    return collect(env, net, buffer, config.rollout, config.gamma, (0.5, 2.0), generator, False)


def of_worlds(rollout: Rollout, worlds: slice) -> Rollout:
    """The part of a rollout that some of the worlds went through."""
    mine = torch.zeros_like(rollout.active[0])
    mine[worlds] = True
    rows = mine.expand_as(rollout.active)[rollout.active]
    columns = {n: getattr(rollout, n)[:, worlds] for n in ("active", "finished", "reward", "value")}
    return Rollout(
        rollout.observation.map(lambda t: t[rows]),
        rollout.action[rows],
        rollout.log_prob[rows],
        **columns,
        last_value=rollout.last_value[worlds],
        counts=rollout.counts,
    )


def update(rollout: Rollout) -> dict[str, Any]:
    """Gradient of one update, its statistics, and those of the returns."""
    net, scale = network(CONFIG), ValueScale()
    samples = make_samples(rollout, CONFIG, scale)
    kept = filter_samples(samples, CONFIG.learn_share, CONFIG.minibatch)
    optimiser = torch.optim.SGD(net.parameters(), lr=0.0)
    stats = learn(net, optimiser, samples, kept, CONFIG, torch.Generator().manual_seed(distributed.rank()))
    gradients = [p.grad.flatten() for p in net.parameters() if p.grad is not None]
    return {"gradient": torch.cat(gradients), "stats": stats, "scale": vars(scale), "samples": len(kept)}


def resumed(folder: Path) -> torch.Tensor:
    """Weights of a policy that these processes trained for two updates, resumed after the first."""
    maps, run = [load_bundle(folder / "map.npz")], RunFolder(folder / "run")
    Trainer(dataclasses.replace(CONFIG, total_steps=1), maps, [], run).run()
    dist.barrier()  # the first process has written it
    trainer = Trainer(dataclasses.replace(CONFIG, total_steps=300), maps, [], run, resume=True)
    before = trainer.steps
    trainer.run()
    assert before < 300 <= trainer.steps
    return torch.cat([p.detach().flatten() for p in trainer.network.parameters()])


def one_of_two(rank: int, folder: Path, rollout: Rollout) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meet'}", rank=rank, world_size=2)
    # shares of different sizes
    result = update(of_worlds(rollout, slice(0, 1) if rank == 0 else slice(1, None)))
    torch.save(result | {"weights": resumed(folder)}, folder / f"{rank}.pt")
    assert distributed.anywhere(rank == 1) and not distributed.anywhere(False)
    state = distributed.gather({"rank": torch.tensor(rank)})
    assert [int(s["rank"]) for s in state] == [0, 1] and int(distributed.own(state)["rank"]) == rank
    with pytest.raises(PhaseError, match="by 1 processes, not 2"):
        distributed.own({"rank": 0})
    with pytest.raises(PhaseError, match="1 worlds are too few for 2 processes"):
        distributed.share(1)
    dist.destroy_process_group()


def test_two_processes_train_as_one_with_all_worlds_would(straight_map, tmp_path):
    save_bundle(tmp_path / "map.npz", straight_map)
    rollout = experience(tmp_path / "map.npz")
    together = update(rollout)
    assert together["samples"] > 40 and together["gradient"].norm() > 0.01
    spawn(one_of_two, (tmp_path, rollout), nprocs=2)
    apart = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1)]
    assert sum(result["samples"] for result in apart) == together["samples"]
    assert all(result["samples"] > 0 for result in apart)
    for result in apart:
        torch.testing.assert_close(result["gradient"], together["gradient"], atol=1e-6, rtol=1e-5)
        assert result["stats"] == pytest.approx(together["stats"], rel=1e-4, abs=1e-6)
        assert result["scale"] == pytest.approx(together["scale"], rel=1e-5)
    assert torch.equal(apart[0]["weights"], apart[1]["weights"])
    with pytest.raises(PhaseError, match="by 2 processes, not 1"):
        Trainer(CONFIG, [straight_map], [], RunFolder(tmp_path / "run"), resume=True)


def test_shares_of_the_worlds_are_all_of_them(straight_map):
    def tuples(share: tuple[int, int]) -> list[int]:
        config = preset("smoke")
        env = Environment(
            [straight_map],
            7,
            8,
            config,
            share=share,
        )
        return env.tuple_index.tolist()

    assert sorted(tuples((0, 2)) + tuples((1, 2))) == sorted(tuples((0, 1)))


@pytest.mark.slow
def test_torchrun_trains_and_resumes_with_as_many_processes(straight_map, tmp_path):
    save_bundle(tmp_path / "maps" / "straight.npz", straight_map)
    arguments = ["train", "--networks", str(tmp_path / "maps"), "--run", str(tmp_path / "run")]
    program = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]

    def train(*options: str) -> subprocess.CompletedProcess[str]:
        command = [*program, "-m", "--", "phase_sumo", *arguments, *options]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)

    result = train("--preset", "smoke", "--steps", "1")
    assert result.returncode == 0, result.stderr
    assert result.stdout.count(", policy in ") == 1
    result = train("--resume", "--steps", "9000", "--json", str(tmp_path / "t.json"))
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "t.json").read_text())["agent_steps"] >= 9000
