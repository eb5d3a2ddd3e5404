"""Collects experience: every active agent of every world for a fixed number of steps."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from phase_sumo.policy.network import ActorCritic
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.observation import Observation
from phase_sumo.train import distributed


@dataclass
class Samples:
    """Flat samples of the active agents, S in all, ready to learn from.

    Attributes:
        observation: leading axis S.
        action: [S] tokens.
        log_prob: [S] log pi_old(action).
        advantage, value_target: [S], values in normalised units.
        weight: [S] loss weight, mean 1 over the samples.
    """

    observation: Observation
    action: Tensor
    log_prob: Tensor
    advantage: Tensor
    value_target: Tensor
    weight: Tensor

    def __len__(self) -> int:
        return self.action.shape[0]

    def select(self, index: Tensor) -> Samples:
        return Samples(
            self.observation.map(lambda t: t[index]),
            *(t[index] for t in (self.action, self.log_prob, self.advantage, self.value_target, self.weight)),
        )


@dataclass
class Counts:
    """Finished agents and what became of them, and means of the reward terms, over one rollout."""

    finished: float = 0.0
    goal: float = 0.0
    collision: float = 0.0
    at_fault: float = 0.0
    road_edge: float = 0.0
    success: float = 0.0
    steps: int = 0
    terms: dict[str, float] = field(default_factory=dict)

    def everywhere(self) -> Counts:
        """Those of all processes together; the terms' means are averaged."""
        shares = [self.finished, self.goal, self.collision, self.at_fault, self.road_edge, self.success]
        *shares, steps = distributed.totals([*shares, self.steps])
        terms = distributed.totals([term / distributed.size() for term in self.terms.values()])
        return Counts(*shares, steps=int(steps), terms=dict(zip(self.terms, terms, strict=True)))

    def rates(self) -> dict[str, float]:
        """Shares of the finished agents."""
        total = max(self.finished, 1.0)
        names = ("goal", "collision", "at_fault", "road_edge", "success")
        return {f"{name}_rate": getattr(self, name) / total for name in names}


@dataclass
class Rollout:
    """T steps of experience in world layout.

    Attributes:
        observations, actions, log_probs: per step, rows of the active agents.
        active, finished, reward, value: [T, W, N]; reward includes the bootstrap of time-outs.
        last_value: [W, N] value after the last step.
        counts: what became of the agents.
    """

    observations: list[Observation]
    actions: list[Tensor]
    log_probs: list[Tensor]
    active: Tensor
    finished: Tensor
    reward: Tensor
    value: Tensor
    last_value: Tensor
    counts: Counts


@torch.no_grad()
def collect(
    env: Environment,
    network: ActorCritic,
    steps: int,
    gamma: float,
    value_scale: tuple[float, float],
    generator: torch.Generator,
    bf16: bool,
) -> Rollout:
    """Drive ``env`` for ``steps`` steps with actions sampled from ``network``.

    Args:
        value_scale: mean and standard deviation that turn the network's value into returns.
    """
    mean, std = value_scale
    observations, actions, log_probs = [], [], []
    columns: dict[str, list[Tensor]] = {name: [] for name in ("active", "finished", "reward", "value")}
    counts = Counts()
    terms: dict[str, Tensor] = {}
    for _ in range(steps):
        active = env.worlds.active
        seen = env.observation.rows(active)
        logits, value = evaluate(network, seen, bf16)
        log_prob = logits.log_softmax(-1)
        token = torch.multinomial(log_prob.exp(), 1, generator=generator).squeeze(-1)
        action = torch.zeros(active.shape, dtype=torch.long, device=active.device)
        action[active] = token
        step = env.step(action)
        value = scatter(value * std + mean, active)
        # a time-out is no failure: what the agent expected then stands for what would have come
        reward = step.reward + gamma * value * step.truncated
        observations.append(seen)
        actions.append(token)
        log_probs.append(log_prob.gather(-1, token.unsqueeze(-1)).squeeze(-1))
        columns["active"].append(active)
        columns["finished"].append(step.finished)
        columns["reward"].append(reward)
        columns["value"].append(value)
        _count(counts, step, terms)
    counts.terms = {name: float(total) / steps for name, total in terms.items()}
    active = env.worlds.active
    last = evaluate(network, env.observation.rows(active), bf16)[1] * std + mean
    stacked = {name: torch.stack(parts) for name, parts in columns.items()}
    return Rollout(
        observations,
        actions,
        log_probs,
        **stacked,
        last_value=scatter(last, active),
        counts=counts.everywhere(),
    )


def evaluate(network: ActorCritic, observation: Observation, bf16: bool) -> tuple[Tensor, Tensor]:
    """The network with its matrix products in bf16 or not; outputs are fp32."""
    with torch.autocast(observation.ego.device.type, torch.bfloat16, enabled=bf16):
        return network(observation)


def scatter(rows: Tensor, active: Tensor) -> Tensor:
    """Rows of the active agents back to [W, N], zeros elsewhere."""
    out = torch.zeros(active.shape, dtype=rows.dtype, device=rows.device)
    out[active] = rows
    return out


def _count(counts: Counts, step, terms: dict[str, Tensor]) -> None:
    done, outcome = step.finished, step.outcome
    counts.steps += int(step.active.sum())
    counts.finished += float(done.sum())
    for name in ("goal", "collision", "at_fault", "road_edge"):
        setattr(counts, name, getattr(counts, name) + float((getattr(outcome, name) & done).sum()))
    counts.success += float((outcome.goal & ~outcome.at_fault & done).sum())
    for name, value in step.terms.items():
        terms[name] = terms.get(name, torch.zeros_like(value)) + value
