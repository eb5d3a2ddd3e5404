"""The PHASE network: encoders, cross-attention to the road, attention pooling, two heads."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from phase_sumo.config import Actions, NetworkConfig
from phase_sumo.sim.observation import CONTEXT, EGO, PARTNER, ROAD, Observation


def encoder(features: int, width: int) -> nn.Sequential:
    """Linear, LayerNorm, ReLU, Linear: one element's features to its embedding."""
    return nn.Sequential(
        nn.Linear(features, width), nn.LayerNorm(width), nn.ReLU(inplace=True), nn.Linear(width, width)
    )


class CrossAttention(nn.Module):
    """Each query element attends to a set, then a feed-forward layer, both residual."""

    def __init__(self, width: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)
        self.feedforward = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, feedforward),
            nn.ReLU(inplace=True),
            nn.Linear(feedforward, width),
        )

    def forward(self, x: Tensor, elements: Tensor, mask: Tensor) -> Tensor:
        """x [B, K, d] attends to elements [B, R, d] where mask [B, R]."""
        batch, count, width = x.shape
        size = width // self.heads
        query = self.query(x).view(batch, count, self.heads, size).transpose(1, 2)
        key_value = self.key_value(elements).view(batch, elements.shape[1], 2, self.heads, size)
        key, value = key_value.permute(2, 0, 3, 1, 4).unbind(0)
        weight = softmax_with_zero(query @ key.transpose(-1, -2) / math.sqrt(size), mask[:, None, None, :])
        attended = (weight.to(value.dtype) @ value).transpose(1, 2).reshape(batch, count, width)
        x = x + self.out(attended)
        return x + self.feedforward(x)


class AttentionPooling(nn.Module):
    """Learned seeds query a set (Set Transformer's PMA); the result ignores the set's order.

    The seeds are constants, so seed times key projection is one linear map from element to scores; and
    values are projected after they were summed, which is the same and costs seeds instead of elements.
    """

    def __init__(self, width: int, heads: int, seeds: int) -> None:
        super().__init__()
        self.heads, self.seeds = heads, seeds
        self.score = nn.Linear(width, seeds * heads)
        self.value = nn.Parameter(torch.randn(heads, width, width // heads) / math.sqrt(width))

    def forward(self, elements: Tensor, mask: Tensor) -> Tensor:
        """elements [B, K, d] where mask [B, K] to [B, seeds * d]; zeros for an empty set."""
        batch, _, width = elements.shape
        weight = softmax_with_zero(self.score(elements).transpose(1, 2), mask[:, None, :])
        summed = (weight.to(elements.dtype) @ elements).view(batch, self.seeds, self.heads, width)
        return torch.einsum("bshd,hde->bshe", summed, self.value.to(summed.dtype)).flatten(1)


def softmax_with_zero(score: Tensor, mask: Tensor) -> Tensor:
    """exp(s) / (1 + sum exp(s)) over the last axis where mask holds, 0 elsewhere.

    The 1 is a score of zero for nothing at all: an empty set is legal and adds nothing.
    """
    score = score.masked_fill(~mask, -torch.inf)
    return torch.softmax(F.pad(score, (0, 1)), -1)[..., :-1]


class ActorCritic(nn.Module):
    """Observation of one agent to action logits and a (normalised) value; the first policy is the prior."""

    log_prior: Tensor

    def __init__(self, actions: Actions) -> None:
        super().__init__()
        self.register_buffer("log_prior", log_prior(actions), persistent=False)

    def start_from_prior(self, last: nn.Linear) -> None:
        """Let the last layer give the prior's logits: smooth driving from the first step, and KL 0."""
        with torch.no_grad():
            last.weight.mul_(0.01)
            last.bias.copy_(self.log_prior)


class PolicyNetwork(ActorCritic):
    """The network of PHASE (paper: Fig. network)."""

    def __init__(self, config: NetworkConfig, actions: Actions) -> None:
        super().__init__(actions)
        d = config.width
        self.ego = encoder(len(EGO), d)
        self.partner = encoder(len(PARTNER), d)
        self.road = encoder(len(ROAD), d)
        self.attend_road = CrossAttention(d, config.heads, config.feedforward)
        self.pool_partner = AttentionPooling(d, config.heads, config.seeds)
        self.pool_road = AttentionPooling(d, config.heads, config.seeds)
        fused = d + len(CONTEXT) + 2 * config.seeds * d
        self.trunk = nn.Sequential(nn.LayerNorm(fused), nn.Linear(fused, config.trunk), nn.ReLU(inplace=True))
        self.policy = head(config.trunk, config.head, actions.count)
        self.value = head(config.trunk, config.head, 1)
        last = self.policy[-1]
        assert isinstance(last, nn.Linear)
        self.start_from_prior(last)

    def forward(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Logits [B, A] and value [B] in fp32 for an observation with one leading axis B."""
        road = self.road(observation.road)
        partner = self.partner(observation.partner)
        partner = self.attend_road(partner, road, observation.road_mask)
        fused = torch.cat(
            (
                self.ego(observation.ego),
                observation.context,
                self.pool_partner(partner, observation.partner_mask),
                self.pool_road(road, observation.road_mask),
            ),
            -1,
        )
        trunk = self.trunk(fused)
        return self.policy(trunk).float(), self.value(trunk).float().squeeze(-1)


def head(width: int, hidden: int, out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(width, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, out))


def log_prior(actions: Actions) -> Tensor:
    """log p(a) of the discrete Gaussian prior, p ~ exp(-j^2 / 2 sigma_j^2 - r^2 / 2 sigma_r^2), [A]."""
    along, across = (
        -0.5 * (torch.tensor(axis) / sigma).square()
        for axis, sigma in zip(actions.axes, actions.prior, strict=True)
    )
    return F.log_softmax((along[:, None] + across[None, :]).flatten(), -1)
