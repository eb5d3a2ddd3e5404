"""Which network a configuration means."""

from __future__ import annotations

from phase_sumo.config import Actions, LateFusionConfig, Network
from phase_sumo.policy.late_fusion import LateFusionNetwork
from phase_sumo.policy.network import ActorCritic, PolicyNetwork


def build_network(config: Network, actions: Actions) -> ActorCritic:
    """A network with fresh weights from torch's global generator."""
    if isinstance(config, LateFusionConfig):
        return LateFusionNetwork(config, actions)
    return PolicyNetwork(config, actions)
