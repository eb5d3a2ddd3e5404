"""Collects experience: every active agent of every world for a fixed number of steps."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from phase_sumo.policy.network import ActorCritic, choose
from phase_sumo.sim.environment import Environment
from phase_sumo.sim.observation import Observation
from phase_sumo.sim.worlds import Transition
from phase_sumo.train import distributed

# The network's batches in a rollout are multiples of this: a CPU prepares kernels for every new size.
ROWS = 256


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
        """The samples with the numbers ``index``, copied."""
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

    @staticmethod
    def of(totals: dict[str, Tensor], terms: dict[str, Tensor], steps: int) -> Counts:
        """From sums over a rollout of ``steps`` steps, which wait for the device here and not every step."""
        numbers = torch.stack([total.double() for total in totals.values()]).tolist()
        means = (torch.stack([term.double() for term in terms.values()]) / steps).tolist()
        counts = Counts(**dict(zip(totals, numbers, strict=True)), terms=dict(zip(terms, means, strict=True)))
        counts.steps = int(counts.steps)
        return counts

    def rates(self) -> dict[str, float]:
        """Shares of the finished agents."""
        total = max(self.finished, 1.0)
        names = ("goal", "collision", "at_fault", "road_edge", "success")
        return {f"{name}_rate": getattr(self, name) / total for name in names}


class Buffer:
    """Memory for the samples of one rollout after another.

    Attributes:
        observation, action, log_prob: leading axis the capacity: every slot at every step and after the last.
    """

    def __init__(self, env: Environment, steps: int) -> None:
        active = env.worlds.active
        capacity, seen = (steps + 1) * active.numel() + ROWS, env.seen_by(whole_batches(active)[0])
        self.observation = seen.map(lambda t: _rows_like(t, capacity))
        self.action = torch.zeros(capacity, dtype=torch.long, device=active.device)
        self.log_prob = torch.zeros(capacity, device=active.device)

    def put(self, seen: Observation, at: int) -> Observation:
        """Copy what some agents see to the rows from ``at`` on; returns those rows."""
        rows = self.observation.map(lambda t: t[at : at + len(seen)])
        for source, target in zip(vars(seen).values(), vars(rows).values(), strict=True):
            _side_by_side(target).copy_(_side_by_side(source))
        return rows


def whole_batches(active: Tensor) -> tuple[Tensor, int]:
    """Slots of the active agents, then the first slot as often as whole batches take, and the agents' number.

    The number of agents waits for the device; to evaluate all slots would be three times the work.
    """
    index = active.flatten().nonzero().squeeze(-1)
    count = len(index)
    return torch.nn.functional.pad(index, (0, max(-count % ROWS, ROWS - count))), count


def _side_by_side(rows: Tensor) -> Tensor:
    """Set features [A, K, F] as they lie in memory, [A, F, K]; others as they are."""
    return rows.transpose(1, 2) if rows.dim() == 3 else rows


def _rows_like(seen: Tensor, capacity: int) -> Tensor:
    """Zeros for ``capacity`` agents like those of seen [A, ...], in the same memory layout."""
    return _side_by_side(seen.new_zeros(capacity, *_side_by_side(seen).shape[1:]))


@dataclass
class Rollout:
    """T steps of experience: S samples of the active agents in a row, and columns in world layout.

    Attributes:
        observation, action, log_prob: leading axis S, in the order of ``active``.
        active, finished, reward, value: [T, W, N]; reward includes the bootstrap of time-outs.
        last_value: [W, N] value after the last step.
        counts: what became of the agents.
    """

    observation: Observation
    action: Tensor
    log_prob: Tensor
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
    buffer: Buffer,
    steps: int,
    gamma: float,
    value_scale: tuple[float, float],
    generator: torch.Generator,
    bf16: bool,
) -> Rollout:
    """Drive ``env`` for ``steps`` steps with actions sampled from ``network``.

    Args:
        buffer: holds the samples until the next rollout.
        value_scale: mean and standard deviation that turn the network's value into returns.
    """
    mean, std = value_scale
    columns: dict[str, list[Tensor]] = {name: [] for name in ("active", "finished", "reward", "value")}
    totals: dict[str, Tensor] = {}
    terms: dict[str, Tensor] = {}
    at = 0
    for _ in range(steps):
        active = env.worlds.controlled
        index, count = whole_batches(active)
        logits, value = evaluate(network, buffer.put(env.seen_by(index), at), bf16)
        log_prob = logits[:count].log_softmax(-1)
        uniform = torch.rand(count, generator=generator, device=log_prob.device)
        token, index = choose(log_prob, uniform), index[:count]
        rows = slice(at, at + count)
        buffer.action[rows] = token
        buffer.log_prob[rows] = log_prob.gather(-1, token.unsqueeze(-1)).squeeze(-1)
        at += count
        step = env.step(scatter(token, index, active))
        value = scatter(value[:count] * std + mean, index, active)
        columns["active"].append(active)
        columns["finished"].append(step.finished)
        # a time-out is no failure: what the agent expected then stands for what would have come
        columns["reward"].append(step.reward + gamma * value * step.truncated)
        columns["value"].append(value)
        _add(totals, _happened(step))
        _add(terms, step.terms)
    active = env.worlds.controlled
    index, count = whole_batches(active)
    last = evaluate(network, buffer.put(env.seen_by(index), at), bf16)[1][:count] * std + mean
    return Rollout(
        buffer.observation.map(lambda t: t[:at]),
        buffer.action[:at],
        buffer.log_prob[:at],
        **{name: torch.stack(parts) for name, parts in columns.items()},
        last_value=scatter(last, index[:count], active),
        counts=Counts.of(totals, terms, steps).everywhere(),
    )


def evaluate(network: ActorCritic, observation: Observation, bf16: bool) -> tuple[Tensor, Tensor]:
    """The network with its matrix products in bf16 or not; outputs are fp32."""
    with torch.autocast(observation.ego.device.type, torch.bfloat16, enabled=bf16):
        return network(observation)


def scatter(rows: Tensor, index: Tensor, active: Tensor) -> Tensor:
    """Rows of the agents ``index`` of all slots back to [W, N], zeros elsewhere."""
    out = torch.zeros(active.numel(), dtype=rows.dtype, device=rows.device)
    return out.index_copy_(0, index, rows).view(active.shape)


def _happened(step: Transition) -> dict[str, Tensor]:
    """Numbers of agents by what became of them in this step."""
    done, outcome = step.finished, step.outcome
    return {
        "finished": done.sum(),
        "goal": (outcome.goal & done).sum(),
        "collision": (outcome.collision & done).sum(),
        "at_fault": (outcome.at_fault & done).sum(),
        "road_edge": (outcome.road_edge & done).sum(),
        "success": (outcome.goal & ~outcome.at_fault & done).sum(),
        "steps": step.active.sum(),
    }


def _add(sums: dict[str, Tensor], values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        sums[name] = sums[name] + value if name in sums else value
