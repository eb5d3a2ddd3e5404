"""The training loop: rollout, learn, log, evaluate, checkpoint."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch

import phase_sumo
from phase_sumo.config import TrainConfig, to_dict
from phase_sumo.errors import Diverged, PhaseError
from phase_sumo.policy.build import build_network
from phase_sumo.policy.checkpoint import Policy
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.compiler import cpp_compiler
from phase_sumo.sim.curriculum import curriculum_progress
from phase_sumo.sim.environment import Environment
from phase_sumo.train import distributed
from phase_sumo.train.health import is_finite, peak_memory
from phase_sumo.train.held_out import held_out_rates, is_due
from phase_sumo.train.ppo import ValueScale, filter_samples, learn, make_samples
from phase_sumo.train.rollout import Buffer, collect
from phase_sumo.train.run_folder import RunFolder
from phase_sumo.train.tensorboard import TensorBoardLog


class Trainer:
    """Self-play training of one policy.

    Args:
        maps: to train on; ``held_out``: never trained on, evaluated now and then (may be empty).
        folder: where everything is kept.
        resume: continue the run in ``folder``, exactly where its checkpoint was written.
        start: begin a new run with the weights of this policy instead of random ones.
    """

    def __init__(
        self,
        config: TrainConfig,
        maps: list[MapBundle],
        held_out: list[MapBundle],
        folder: RunFolder,
        resume: bool = False,
        start: Policy | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config, self.held_out, self.folder = config, held_out, folder
        self._writes = distributed.rank() == 0
        if self._writes:
            folder.claim(resume)
        self.names = [m.name for m in maps]
        torch.manual_seed(config.seed)
        self.network = build_network(config.network, config.actions).to(device)
        self.optimiser = torch.optim.Adam(
            self.network.parameters(), lr=config.learning_rate, eps=1e-5, fused=True
        )
        self.generator = torch.Generator(device=device).manual_seed(distributed.own_seed(config.seed + 1))
        self.env = Environment(
            maps,
            config.worlds,
            config.slots,
            config,
            seed=distributed.own_seed(config.seed),
            device=device,
            compiled=config.compiled and cpp_compiler() is not None,
            share=distributed.share(config.worlds),
        )
        self.buffer = Buffer(self.env, config.rollout)
        self.scale = ValueScale()
        self.steps, self.wall = 0, 0.0
        facts = {"phase_sumo": phase_sumo.__version__, "torch": torch.__version__, "networks": self.names}
        if resume:
            self._restore(folder)
            if self._writes:
                folder.configure(config, facts)  # a resumed run may have been given other steps
        else:
            if start is not None:
                self._begin_with(start)
            checkpoint = self._checkpoint()
            if self._writes:
                folder.start(config, facts, checkpoint)
        self.curve = folder.curve(self.steps) if self._writes else None
        self.last = self.curve.last if self.curve else {}

    def run(
        self,
        report: Callable[[dict[str, float]], None] | None = None,
        stopping: Callable[[], bool] = lambda: False,
    ) -> Policy:
        """Train until ``total_steps`` agent steps or ``stopping()``; a checkpoint is left either way."""
        saved = self.steps
        with ExitStack() as stack:
            stack.callback(self.folder.release)
            board = None
            if self._writes:
                board = stack.enter_context(TensorBoardLog(self.folder.path, self.steps))
            while self.steps < self.config.total_steps and not distributed.anywhere(stopping()):
                began = time.perf_counter()
                row = self._update()
                self.wall += time.perf_counter() - began
                row = {"steps": self.steps, "wall_seconds": self.wall, **row}
                if self._writes and self._held_out_due(row["agent_steps"]):
                    row |= held_out_rates(self.policy(), self.held_out, self.config)
                self.last = row | peak_memory(self.generator.device)
                if self.curve is not None and board is not None:
                    self.curve.add(self.last)
                    board.add(self.last)
                if report is not None:
                    report(self.last)
                if self.steps - saved >= self.config.checkpoint_every:
                    self.save()
                    saved = self.steps
        self.save()
        return self.policy()

    def policy(self) -> Policy:
        """The policy as it is now."""
        config = self.config
        info = {
            "version": phase_sumo.__version__,
            "agent_steps": self.steps,
            "networks": self.names,
            "value_scale": vars(self.scale),
            "train": to_dict(config),
        }
        # held apart from the weights in training
        network = build_network(config.network, config.actions)
        network.load_state_dict(self.network.state_dict())
        return Policy(network.eval(), config.sim, config.actions, config.network, info)

    def save(self) -> None:
        """Write checkpoint and policy, after the curve up to them."""
        checkpoint = self._checkpoint()
        if self.curve is not None:
            self.curve.sync()
            self.folder.save(checkpoint, self.policy())

    def _checkpoint(self) -> dict[str, Any]:
        return {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "env": distributed.gather(self.env.state_dict()),
            "generator": distributed.gather(self.generator.get_state()),
            "scale": vars(self.scale),
            "steps": self.steps,
            "wall": self.wall,
        }

    def _held_out_due(self, latest: int) -> bool:
        return bool(self.held_out) and is_due(self.steps, latest, self.config.held_out_every)

    def _begin_with(self, policy: Policy) -> None:
        mine, theirs = (self.config.network, self.config.actions), (policy.network_config, policy.actions)
        if mine != theirs:
            raise PhaseError(
                f"the policy to start from has {theirs}, this run {mine}; "
                "train with the same network and actions"
            )
        self.network.load_state_dict(policy.network.state_dict())
        vars(self.scale).update(policy.info["value_scale"])

    def _restore(self, folder: RunFolder) -> None:
        if folder.networks() != self.names:
            raise PhaseError(
                f"{folder.path} trains on {' '.join(folder.networks())}, not {' '.join(self.names)}; "
                "pass the same --networks, or begin a new run with --start-from its policy"
            )
        folder.load(self._adopt)

    def _adopt(self, stored: dict[str, Any]) -> None:
        self.network.load_state_dict(stored["network"])
        self.optimiser.load_state_dict(stored["optimiser"])
        self.env.load_state_dict(distributed.own(stored["env"]))
        self.generator.set_state(distributed.own(stored["generator"]))
        vars(self.scale).update(stored["scale"])
        self.steps, self.wall = stored["steps"], stored["wall"]

    def _update(self) -> dict[str, Any]:
        """One rollout and one epoch of learning; returns the row of the curve."""
        config = self.config
        rho = curriculum_progress(self.steps, config.total_steps, *config.curriculum)
        self.env.rho = rho
        for group in self.optimiser.param_groups:
            share = min(self.steps / max(config.total_steps, 1), 1.0)
            group["lr"] = config.learning_rate * config.final_learning_rate**share
        start = time.process_time()
        rollout = collect(
            self.env,
            self.network.eval(),
            self.buffer,
            config.rollout,
            config.gamma,
            self.scale.get(),
            self.generator,
            config.bf16,
        )
        collected = time.process_time()
        samples = make_samples(rollout, config, self.scale)
        kept = filter_samples(samples, config.learn_share, config.minibatch)
        losses = learn(self.network.train(), self.optimiser, samples, kept, config, self.generator)
        if not is_finite(losses, self.network):
            raise Diverged(
                f"{self.folder.path}: training diverged at {self.steps} agent steps, {losses}; the last "
                "checkpoint is intact: lower learning_rate in config.json there and continue with --resume"
            )
        self.steps += rollout.counts.steps
        return {
            "agent_steps": rollout.counts.steps,
            "rho": rho,
            "learning_rate": self.optimiser.param_groups[0]["lr"],
            **rollout.counts.rates(),
            "finished": rollout.counts.finished,
            "rollout_cpu_us": 1e6 * (collected - start) / max(rollout.counts.steps, 1),
            "learn_cpu_us": 1e6 * (time.process_time() - collected) / max(rollout.counts.steps, 1),
            **losses,
            **{f"reward_{name}": value for name, value in rollout.counts.terms.items()},
        }
