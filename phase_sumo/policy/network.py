"""The PHASE network: ego, context and scene meet in a trunk with two heads."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from phase_sumo.config import Actions, NetworkConfig
from phase_sumo.policy.native import autocasts_to_bf16
from phase_sumo.policy.scene_encoder import SceneEncoder
from phase_sumo.policy.trunk import TrunkKernel, load_trunk
from phase_sumo.sim.observation import CONTEXT, EGO, Observation


class ActorCritic(nn.Module):
    """Observation of one agent to action logits and a (normalised) value; the first policy is the prior."""

    log_prior: Tensor

    def __init__(self, actions: Actions) -> None:
        super().__init__()
        self.register_buffer("log_prior", log_prior(actions), persistent=False)

    def logits(self, observation: Observation) -> Tensor:
        """The logits of `forward` alone, for driving, which needs no value."""
        return self(observation)[0]

    def start_from_prior(self, last: nn.Linear) -> None:
        """Let the last layer give the prior's logits: smooth driving from the first step, and KL 0."""
        with torch.no_grad():
            last.weight.mul_(0.01)
            last.bias.copy_(self.log_prior)


class PolicyNetwork(ActorCritic):
    """The network of PHASE (paper: Fig. network)."""

    def __init__(self, config: NetworkConfig, actions: Actions) -> None:
        super().__init__(actions)
        self.config, hidden = config, config.hidden
        self.ego = nn.Sequential(
            nn.Linear(len(EGO), hidden), nn.ReLU(inplace=True), nn.Linear(hidden, hidden)
        )
        self.scene = SceneEncoder(config)
        fused = hidden + len(CONTEXT) + self.scene.size
        self.trunk = nn.Sequential(nn.LayerNorm(fused), nn.Linear(fused, config.trunk), nn.ReLU(inplace=True))
        self.policy = head(config.trunk, config.head, actions.count)
        self.value = head(config.trunk, config.head, 1)
        last = self.policy[-1]
        assert isinstance(last, nn.Linear)
        self.start_from_prior(last)

    def forward(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Logits [B, A] and value [B] in fp32 for an observation with one leading axis B."""
        seen = self._seen(observation)
        kernel = self._kernel(seen)
        if kernel is not None:
            out = self._compiled(kernel, seen)
            return out[:, :-1], out[:, -1]
        trunk = self.trunk(seen)
        return self.policy(trunk).float(), self.value(trunk).float().squeeze(-1)

    def logits(self, observation: Observation) -> Tensor:
        seen = self._seen(observation)
        kernel = self._kernel(seen)
        return (
            self.policy(self.trunk(seen)).float() if kernel is None else self._compiled(kernel, seen)[:, :-1]
        )

    def _seen(self, observation: Observation) -> Tensor:
        parts = self.ego(observation.ego), observation.context, self.scene(observation)
        return torch.cat(parts, -1)

    def _compiled(self, kernel: TrunkKernel, seen: Tensor) -> Tensor:
        layers = self.trunk, self.policy, self.value
        return kernel(seen, [weight for layer in layers for weight in layer.parameters()])

    def _kernel(self, seen: Tensor) -> TrunkKernel | None:
        """The compiled trunk and heads, for products in bf16."""
        if seen.device.type != "cpu" or torch.compiler.is_compiling() or not autocasts_to_bf16():
            return None
        return load_trunk(self.config, seen.shape[-1], len(self.log_prior))


def head(width: int, hidden: int, out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(width, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, out))


def choose(logits: Tensor, uniform: Tensor | None = None) -> Tensor:
    """One token per row of logits [A, actions]: the most probable one, or a draw.

    Args:
        uniform: [A] in [0, 1); the token is the first whose cumulated probability exceeds it.
    """
    if uniform is None:
        return logits.argmax(-1)
    reached = logits.softmax(-1).cumsum(-1)
    passed = reached <= (uniform * reached[:, -1]).unsqueeze(-1)
    return passed.sum(-1).clamp_max(logits.shape[-1] - 1)


def log_prior(actions: Actions) -> Tensor:
    """log p(a) of the discrete Gaussian prior, p ~ exp(-j^2 / 2 sigma_j^2 - r^2 / 2 sigma_r^2), [A]."""
    along, across = (
        -0.5 * (torch.tensor(axis) / sigma).square()
        for axis, sigma in zip(actions.axes, actions.prior, strict=True)
    )
    return F.log_softmax((along[:, None] + across[None, :]).flatten(), -1)
