"""A policy as a file: safetensors weights with configuration and feature layout in the header."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from phase_sumo.atomic_files import write_whole
from phase_sumo.config import Actions, Network, SimConfig, from_dict, restore, to_dict
from phase_sumo.errors import PhaseError
from phase_sumo.policy.build import build_network
from phase_sumo.policy.network import ActorCritic, choose
from phase_sumo.sim.observation import LAYOUT, Observation

FORMAT = "phase_sumo policy 1"
SHIPPED = Path(__file__).parent / "weights" / "phase.safetensors"


@dataclass
class Policy:
    """A trained network with the configuration that it needs to drive.

    Attributes:
        network: in evaluation mode.
        sim, actions, network_config: what it was trained with.
        info: facts about its training (agent steps, networks, version).
    """

    network: ActorCritic
    sim: SimConfig
    actions: Actions
    network_config: Network
    info: dict[str, Any]

    @torch.no_grad()
    def scores(self, observation: Observation) -> Tensor:
        """Logits [A, actions] of the observing agents."""
        return self.network.logits(observation)

    def act(self, observation: Observation, generator: torch.Generator | None = None) -> Tensor:
        """Action tokens [A] of the observing agents.

        Args:
            generator: samples from the policy with it; None takes the most probable action.
        """
        logits = self.scores(observation)
        if generator is None:
            return choose(logits)
        return choose(logits, torch.rand(len(logits), generator=generator, device=logits.device))


def save_policy(path: str | Path, policy: Policy) -> None:
    """Write ``policy``: a reader sees the old file or the whole new one."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, policy_bytes(policy))


def policy_bytes(policy: Policy) -> bytes:
    """The content of a policy file."""
    header = {
        "format": FORMAT,
        "network": json.dumps(to_dict(policy.network_config)),
        "sim": json.dumps(to_dict(policy.sim)),
        "actions": json.dumps(to_dict(policy.actions)),
        "layout": json.dumps(_layout()),
        "info": json.dumps(policy.info),
    }
    tensors = {
        name: tensor.detach().cpu().contiguous() for name, tensor in policy.network.state_dict().items()
    }
    return save(tensors, metadata=header)


def load_policy(path: str | Path | None = None, device: torch.device | str = "cpu") -> Policy:
    """Read a policy; without a path, the one shipped with the package.

    Raises:
        PhaseError: the file is missing, is no policy, or was trained with other features.
    """
    path = SHIPPED if path is None else Path(path)
    if not path.is_file():
        raise PhaseError(f"{path}: no such policy file; train one or leave --policy out for the shipped one")
    try:
        with safe_open(path, framework="pt", device=str(device)) as file:
            header = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise PhaseError(
            f"{path}: not a safetensors file ({error}); pass a policy written by phase-sumo"
        ) from None
    if header.get("format") != FORMAT:
        raise PhaseError(f"{path}: format {header.get('format')!r}, expected {FORMAT!r}; retrain the policy")
    _check_layout(path, json.loads(header["layout"]))
    actions = restore(Actions, json.loads(header["actions"]))
    network_config = restore(Network, json.loads(header["network"]))
    network = build_network(network_config, actions).to(device).eval()
    network.load_state_dict(weights)
    sim = from_dict(SimConfig, json.loads(header["sim"]))
    return Policy(network, sim, actions, network_config, json.loads(header["info"]))


def _layout() -> dict[str, list[dict[str, Any]]]:
    return {group: [asdict(feature) for feature in features] for group, features in LAYOUT.items()}


def _check_layout(path: Path, stored: dict[str, list[dict[str, Any]]]) -> None:
    for group, features in _layout().items():
        theirs = {f["name"]: f for f in stored.get(group, [])}
        for position, feature in enumerate(features):
            there = stored.get(group, [])[position : position + 1]
            if there != [feature]:
                known = theirs.get(feature["name"])
                raise PhaseError(
                    f"{path}: {group} feature {feature['name']!r} is {feature} here and {known} in the file; "
                    "use the version of phase_sumo that trained it, or retrain"
                )
        if len(stored.get(group, [])) != len(features):
            raise PhaseError(
                f"{path}: {group} has {len(stored[group])} features, here {len(features)}; retrain"
            )
