"""The network of the GPUDrive baseline: three encoders, max pooling, late fusion (Cornelisse et al. 2025)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from phase_sumo.config import Actions, LateFusionConfig
from phase_sumo.policy.network import ActorCritic
from phase_sumo.sim.observation import EGO, PARTNER, ROAD, Observation


class LateFusionNetwork(ActorCritic):
    """Sets meet the ego state only after each was pooled, in one linear map; both heads are linear.

    It reads our features of ego, partners and road. The context vector is the conditioning of PHASE and is
    not concatenated again.
    """

    def __init__(self, config: LateFusionConfig, actions: Actions) -> None:
        super().__init__(actions)
        self.ego = _encoder(len(EGO), config)
        self.partner = _encoder(len(PARTNER), config)
        self.road = _encoder(len(ROAD), config)
        self.fuse = nn.Sequential(nn.Linear(3 * config.embedding, config.hidden), nn.Dropout(config.dropout))
        self.policy = _orthogonal(nn.Linear(config.hidden, actions.count), 1.0)
        self.value = _orthogonal(nn.Linear(config.hidden, 1), 1.0)
        self.start_from_prior(self.policy)

    def forward(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Logits [B, A] and value [B] in fp32 for an observation with one leading axis B."""
        parts = (
            self.ego(observation.ego),
            max_pool(self.partner(observation.partner), observation.partner_mask),
            max_pool(self.road(observation.road), observation.road_mask),
        )
        fused = self.fuse(torch.cat(parts, -1))
        return self.policy(fused).float(), self.value(fused).float().squeeze(-1)


def max_pool(elements: Tensor, mask: Tensor) -> Tensor:
    """Largest value of each feature over elements [B, K, d] where mask [B, K], [B, d]; 0 for an empty set."""
    highest = elements.masked_fill(~mask.unsqueeze(-1), -torch.inf).amax(1)
    return torch.where(mask.any(1, keepdim=True), highest, 0.0)


def _encoder(features: int, config: LateFusionConfig) -> nn.Sequential:
    """Linear, LayerNorm, tanh, dropout, Linear: one element's features to its embedding."""
    width, gain = config.embedding, math.sqrt(2.0)
    return nn.Sequential(
        _orthogonal(nn.Linear(features, width), gain),
        nn.LayerNorm(width),
        nn.Tanh(),
        nn.Dropout(config.dropout),
        _orthogonal(nn.Linear(width, width), gain),
    )


def _orthogonal(layer: nn.Linear, gain: float) -> nn.Linear:
    """The layer with orthogonal weights and no bias to begin with."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
