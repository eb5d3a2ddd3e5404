"""The baseline's network: its size, its invariances, and policies that carry it."""

from __future__ import annotations

import pytest
import torch

from phase_sumo.config import DirectActionConfig, LateFusionConfig
from phase_sumo.errors import PhaseError
from phase_sumo.policy.build import build_network
from phase_sumo.policy.checkpoint import Policy, load_policy, save_policy
from phase_sumo.policy.late_fusion import LateFusionNetwork
from phase_sumo.policy.network import PolicyNetwork
from phase_sumo.sim.observation import EGO, PARTNER, ROAD
from phase_sumo.train.presets import preset
from tests.helpers.observations import observation


def network() -> LateFusionNetwork:
    """Weights far from the start, so that the output really depends on every input."""
    torch.manual_seed(0)
    net = LateFusionNetwork(LateFusionConfig(), DirectActionConfig()).eval()
    with torch.no_grad():
        net.policy.weight.mul_(300.0)
    return net


def test_it_has_the_baselines_size_but_for_the_features():
    count = sum(p.numel() for p in network().parameters())
    assert count == 51_228 + 64 * (len(EGO) + len(PARTNER) + len(ROAD) - (6 + 6 + 13))


@pytest.mark.parametrize("group", ["partner", "road"])
def test_neither_the_order_of_elements_nor_masked_ones_matter(group: str):
    net, seen = network(), observation()
    before = net(seen)
    features, mask = getattr(seen, group), getattr(seen, f"{group}_mask")
    order = torch.randperm(features.shape[1], generator=torch.Generator().manual_seed(5))
    setattr(seen, group, torch.where(mask.unsqueeze(-1), features, 99.0)[:, order])
    setattr(seen, f"{group}_mask", mask[:, order])
    for a, b in zip(before, net(seen), strict=True):
        torch.testing.assert_close(a, b)
    setattr(seen, group, getattr(seen, group) + 1.0)
    assert (before[0] - net(seen)[0]).abs().max() > 0.01


def test_empty_sets_are_legal_forward_and_backward():
    net, seen = network(), observation()
    seen.partner_mask[:] = False
    seen.road_mask[:] = False
    logits, value = net(seen)
    (logits.square().sum() + value.sum()).backward()
    assert logits.isfinite().all() and value.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())


@pytest.mark.parametrize(
    ("name", "kind"), [("gpudrive", LateFusionNetwork), ("gpudrive-same-model", PolicyNetwork)]
)
def test_a_baseline_is_saved_and_loaded_like_any_policy(tmp_path, name: str, kind: type):
    config = preset(name)
    net = build_network(config.network, config.actions).eval()
    save_policy(tmp_path / "p", Policy(net, config.sim, config.actions, config.network, {}))
    again = load_policy(tmp_path / "p")
    assert isinstance(again.network, kind)
    assert (again.sim, again.actions, again.network_config) == (config.sim, config.actions, config.network)
    seen = observation(64)
    draws = [net(seen)[0], again.network(seen)[0]]
    torch.testing.assert_close(*draws)


def test_a_network_of_no_known_kind_is_refused(tmp_path):
    config = preset("gpudrive")
    net = build_network(config.network, config.actions)
    path = tmp_path / "p"
    save_policy(path, Policy(net, config.sim, config.actions, config.network, {}))
    path.write_bytes(path.read_bytes().replace(b"embedding", b"embodding"))
    with pytest.raises(PhaseError, match="no setting 'dropout'"):
        load_policy(path)
