"""DClamp-PPO with inverse-agent-count weights and a Gaussian action prior (paper: Training)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from phase_sumo.config import TrainConfig
from phase_sumo.policy.network import ActorCritic
from phase_sumo.train import distributed
from phase_sumo.train.rollout import Rollout, Samples, evaluate


def gae(
    reward: Tensor,
    value: Tensor,
    last_value: Tensor,
    finished: Tensor,
    active: Tensor,
    gamma: float,
    lam: float,
) -> Tensor:
    """Generalised advantage estimation over [T, W, N] slots that agents leave and enter.

    delta_t = r_t + gamma V_{t+1} (1 - finished_t) - V_t and A_t = delta_t + gamma lam (1 - finished_t)
    A_{t+1}. Time-outs carry their bootstrap in the reward, so finished covers both kinds of ending.

    Args:
        last_value: [W, N] value after the last step.

    Returns:
        [T, W, N], 0 where not active.
    """
    advantage = torch.zeros_like(reward)
    running, following = torch.zeros_like(last_value), last_value
    for t in range(reward.shape[0] - 1, -1, -1):
        alive = (active[t] & ~finished[t]).float()
        delta = reward[t] + gamma * following * alive - value[t]
        running = torch.where(active[t], delta + gamma * lam * alive * running, 0.0)
        advantage[t] = running
        following = value[t]
    return advantage


def world_weights(active: Tensor) -> Tensor:
    """1 / N_w for every sample (Eq. sample_reweighting), scaled to mean 1 over the samples.

    N_w is the number of agent steps of world w in the rollout, so each world counts alike.

    Args:
        active: [T, W, N] bool.

    Returns:
        [T, W, N], 0 where not active.
    """
    per_world = active.sum((0, 2), keepdim=True).clamp_min(1)
    weight = active / per_world
    count, mass = distributed.total(active.sum()), distributed.total(weight.sum())
    return weight * (count / mass.clamp_min(1e-12))


def dclamp_objective(ratio: Tensor, advantage: Tensor, clip: float, alpha: float, beta: float) -> Tensor:
    """DClamp-PPO's surrogate, to be maximised (arXiv 2511.02577).

    J = min(w A, clip(w, 1 - eps, 1 + eps) A, f(w) A) with f(w) = alpha w - (alpha - 1)(1 - beta) for
    A > 0 and alpha w - (alpha - 1)(1 + beta) for A < 0: slope alpha A where the update went the wrong
    way by more than beta, plain PPO elsewhere; alpha = 1 is PPO.
    """
    edge = torch.where(advantage > 0, 1.0 - beta, 1.0 + beta)
    steep = alpha * ratio - (alpha - 1.0) * edge
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    return torch.minimum(torch.minimum(ratio * advantage, clipped * advantage), steep * advantage)


def prior_kl(log_probs: Tensor, log_prior: Tensor) -> Tensor:
    """D_KL(pi || prior) of each row, [S] (Eq. kl_action_reg; the loss adds it, pulling to the prior)."""
    return (log_probs.exp() * (log_probs - log_prior)).sum(-1)


class ValueScale:
    """Running mean and standard deviation of the returns, for a value head of unit size."""

    def __init__(self) -> None:
        self.mean, self.square, self.weight = 0.0, 0.0, 0.0

    def update(self, returns: Tensor, decay: float = 0.98) -> None:
        self.mean = decay * self.mean + (1 - decay) * float(distributed.mean(returns))
        self.square = decay * self.square + (1 - decay) * float(distributed.mean(returns.square()))
        self.weight = decay * self.weight + (1 - decay)

    def get(self) -> tuple[float, float]:
        if self.weight == 0.0:
            return 0.0, 1.0
        mean = self.mean / self.weight
        return mean, max(self.square / self.weight - mean**2, 1e-6) ** 0.5


def make_samples(rollout: Rollout, config: TrainConfig, scale: ValueScale) -> Samples:
    """Advantages, value targets and weights of a rollout as flat samples.

    Advantages are normalised over all active samples with the loss weights, before any filtering.
    """
    advantage = gae(
        rollout.reward,
        rollout.value,
        rollout.last_value,
        rollout.finished,
        rollout.active,
        config.gamma,
        config.gae_lambda,
    )
    active = rollout.active
    returns = (advantage + rollout.value)[active]
    scale.update(returns)
    mean, std = scale.get()
    weight = world_weights(active)[active] if config.reweight else torch.ones_like(returns)
    flat = advantage[active]
    centre = distributed.mean(weight * flat)
    spread = distributed.mean(weight * (flat - centre).square()).sqrt()
    return Samples(
        observation=rollout.observation,
        action=rollout.action,
        log_prob=rollout.log_prob,
        advantage=(flat - centre) / (spread + 1e-8),
        value_target=(returns - mean) / std,
        weight=weight,
    )


def filter_samples(samples: Samples, share: float, minibatch: int) -> Tensor:
    """Numbers [S'] of the ``share`` of the samples with the largest |A|: the others hardly move the policy.

    Advantage filtering after GIGAFLOW; weights and advantage statistics are those of all samples. They are
    cut to whole minibatches if there is more than one: a CPU prepares kernels for every new size.
    """
    size = samples.advantage.abs()
    if share >= 1.0:
        return torch.arange(len(size), device=size.device)
    everywhere = distributed.joint(size)
    count = max(1, round(share * len(everywhere)))
    if count > minibatch:
        count -= count % minibatch
    least = everywhere.topk(count, sorted=False).values.min()
    return (size >= least).nonzero().squeeze(-1)


def minibatches(
    kept: Tensor, config: TrainConfig, generator: torch.Generator
) -> Iterator[tuple[Tensor, int]]:
    """Parts [B] of the sample numbers, each once per epoch, of nearly equal size.

    Yields:
        The numbers, and the size of the minibatch in all processes together.
    """
    # dropout draws from the global generator: seeded by ours, a resumed run goes on exactly
    torch.manual_seed(int(torch.randint(2**31, (1,), generator=generator, device=kept.device)))
    parts = max(1, round(distributed.totals([len(kept)])[0] / config.minibatch))
    sizes = distributed.totals([len(part) for part in kept.tensor_split(parts)])
    for _ in range(config.epochs):
        order = torch.randperm(len(kept), generator=generator, device=kept.device)
        yield from zip(kept[order].tensor_split(parts), map(int, sizes), strict=True)


def learn(
    network: ActorCritic,
    optimiser: torch.optim.Optimizer,
    samples: Samples,
    kept: Tensor,
    config: TrainConfig,
    generator: torch.Generator,
) -> dict[str, float]:
    """All epochs of minibatch updates on the samples ``kept``; returns means of losses and diagnostics."""
    rows, norms, names = [], [], ()
    for index, count in minibatches(kept, config, generator):
        loss, parts = _loss(network, samples.select(index), config, count)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        distributed.sum_gradients(network)
        norms.append(torch.nn.utils.clip_grad_norm_(network.parameters(), config.gradient_norm))
        optimiser.step()
        rows.append(torch.stack([value.detach() for value in parts.values()]))
        names = tuple(parts)
    means = distributed.total(torch.stack(rows).mean(0)).tolist()
    return {**dict(zip(names, means, strict=True)), "gradient_norm": float(torch.stack(norms).mean())}


def _loss(
    network: ActorCritic, batch: Samples, config: TrainConfig, count: int
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss and diagnostics of a minibatch: this process's terms of means over all ``count`` samples."""

    def mean(values: Tensor) -> Tensor:
        return values.sum() / count

    logits, value = evaluate(network, batch.observation, config.bf16)
    log_probs = logits.log_softmax(-1)
    log_prob = log_probs.gather(-1, batch.action.unsqueeze(-1)).squeeze(-1)
    log_ratio = log_prob - batch.log_prob
    ratio = log_ratio.exp()
    objective = dclamp_objective(ratio, batch.advantage, config.clip, config.dclamp_alpha, config.dclamp_beta)
    policy_loss = -mean(batch.weight * objective)
    value_loss = mean(batch.weight * F.huber_loss(value, batch.value_target, reduction="none", delta=10.0))
    kl = mean(prior_kl(log_probs, network.log_prior))
    loss = policy_loss + config.value_weight * value_loss + config.prior_weight * kl
    with torch.no_grad():
        parts = {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "prior_kl": kl,
            "entropy": -mean((log_probs.exp() * log_probs).sum(-1)),
            "approx_kl": mean((ratio - 1.0) - log_ratio),
            "clip_fraction": mean(((ratio - 1.0).abs() > config.clip).float()),
        }
    return loss, parts
