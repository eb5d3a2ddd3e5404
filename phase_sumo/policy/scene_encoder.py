"""Partners and road points to two embeddings: encoders, cross-attention to the road, attention pooling."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from phase_sumo.config import NetworkConfig
from phase_sumo.policy.native import Kernel, autocasts_to_bf16, load_kernel
from phase_sumo.sim.observation import PARTNER, ROAD, Observation


class SceneEncoder(nn.Module):
    """The part of the network that reads sets (paper: Fig. network), whatever their order and size.

    Partners and road points are encoded by linear maps around a normalisation and one ReLU. The road's last
    map gives keys, values and pooling scores at once. Every partner attends to the road; a feed-forward layer
    follows, both residual. Each set is then pooled by learned seeds (Set Transformer's PMA): seeds are
    constants, so seed times key projection is one linear map from element to scores, and the map of pooled
    values that would follow is left to the trunk, which begins with one.

    On a CPU with a C++ compiler `scene_encoder.cpp` does the same several times faster. Under autocast to
    bf16 its matrix products are in bf16 too, where the processor has tiles for them.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        d, hidden, feedforward = config.width, config.hidden, config.feedforward
        self.partner_in = nn.Linear(len(PARTNER), hidden)
        self.partner_out = nn.Linear(hidden, d)
        self.road_in = nn.Linear(len(ROAD), hidden)
        self.road_out = nn.Linear(hidden, 2 * d + config.seeds)
        self.query = nn.Linear(d, d)
        self.attended = nn.Linear(d, d)
        self.feed_in = nn.Linear(d, feedforward)
        self.feed_out = nn.Linear(feedforward, d)
        self.score = nn.Linear(d, config.seeds)

    @property
    def size(self) -> int:
        """Numbers in the result: seeds x width of either set."""
        return 2 * self.config.seeds * self.config.width

    def forward(self, observation: Observation) -> Tensor:
        """Pooled partners, then pooled road points, [B, size]; zeros for an empty set."""
        kernel = self._kernel(observation)
        if kernel is not None:
            return kernel(observation, list(self.parameters()))
        return self.reference(observation)

    def _kernel(self, observation: Observation) -> Kernel | None:
        road = observation.road
        if road.device.type != "cpu" or road.dtype != torch.float32 or torch.compiler.is_compiling():
            return None
        return load_kernel(self.config, observation.partner.shape[-2], road.shape[-2], autocasts_to_bf16())

    def reference(self, observation: Observation) -> Tensor:
        """`forward` in torch operations, on any device."""
        d, seeds = self.config.width, self.config.seeds
        partner = self.partner_out(F.relu(normalise(self.partner_in(observation.partner))))
        given = self.road_out(F.relu(normalise(self.road_in(observation.road))))
        key, value, score = given.split((d, d, seeds), -1)
        partner = partner + self.attended(self._attend(partner, key, value, observation.road_mask))
        partner = partner + self.feed_out(F.relu(self.feed_in(normalise(partner))))
        pooled = (
            pool(self.score(normalise(partner)), partner, observation.partner_mask),
            pool(score, value, observation.road_mask),
        )
        return torch.cat(pooled, 1).flatten(1)

    def _attend(self, partner: Tensor, key: Tensor, value: Tensor, mask: Tensor) -> Tensor:
        """Partners [B, K, d] attend to road points [B, R, d] where mask [B, R], in several heads."""

        def heads(elements: Tensor) -> Tensor:
            return elements.unflatten(-1, (self.config.heads, -1)).transpose(1, 2)

        query, key, value = heads(self.query(partner)), heads(key), heads(value)
        score = query @ key.transpose(-1, -2) / math.sqrt(query.shape[-1])
        weight = softmax_with_zero(score, mask[:, None, None, :])
        return (weight.to(value.dtype) @ value).transpose(1, 2).flatten(2)


def normalise(elements: Tensor) -> Tensor:
    """Layer normalisation without weights of its own: a linear map follows, or ReLU and one."""
    return F.layer_norm(elements, elements.shape[-1:])


def pool(score: Tensor, value: Tensor, mask: Tensor) -> Tensor:
    """Means of value [B, K, d] weighted by the softmax of each seed's score [B, K, S]: [B, S, d]."""
    weight = softmax_with_zero(score.transpose(1, 2), mask[:, None, :])
    return weight.to(value.dtype) @ value


def softmax_with_zero(score: Tensor, mask: Tensor) -> Tensor:
    """exp(s) / (1 + sum exp(s)) over the last axis where mask holds, 0 elsewhere.

    The 1 is a score of zero for nothing at all: an empty set is legal and adds nothing.
    """
    score = score.masked_fill(~mask, -torch.inf)
    return torch.softmax(F.pad(score, (0, 1)), -1)[..., :-1]
