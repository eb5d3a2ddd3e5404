"""The network's invariances and the checkpoint's refusals."""

from __future__ import annotations

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from phase_sumo.config import ActionConfig, NetworkConfig, SimConfig
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import Policy, load_policy, save_policy
from phase_sumo.policy.network import PolicyNetwork, choose, log_prior
from tests.helpers.observations import observation


def network(seed: int = 0) -> PolicyNetwork:
    torch.manual_seed(seed)
    return PolicyNetwork(NetworkConfig(), ActionConfig()).eval()


def trained_like() -> PolicyNetwork:
    """Weights far from the start, so that the output really depends on every input."""
    net = network()
    with torch.no_grad():
        last = net.policy[-1]
        assert isinstance(last, torch.nn.Linear)
        last.weight.mul_(300.0)
    return net


def test_it_has_the_papers_size():
    count = sum(p.numel() for p in network().parameters())
    assert 670_000 * 0.95 <= count <= 670_000 * 1.05, count


def test_it_starts_as_the_prior():
    logits, _ = network()(observation())
    expected = log_prior(ActionConfig()).expand(5, -1)
    torch.testing.assert_close(logits.log_softmax(-1), expected, atol=0.05, rtol=0.0)


@pytest.mark.parametrize("group", ["partner", "road"])
def test_the_order_of_elements_does_not_matter(group: str):
    net, seen = trained_like(), observation()
    before = net(seen)
    features, mask = getattr(seen, group), getattr(seen, f"{group}_mask")
    order = torch.randperm(features.shape[1], generator=torch.Generator().manual_seed(5))
    setattr(seen, group, features[:, order])
    setattr(seen, f"{group}_mask", mask[:, order])
    for a, b in zip(before, net(seen), strict=True):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("group", ["partner", "road"])
def test_masked_elements_do_not_matter_and_real_ones_do(group: str):
    net, seen = trained_like(), observation()
    before = net(seen)[0]
    features, mask = getattr(seen, group), getattr(seen, f"{group}_mask")
    setattr(seen, group, torch.where(mask.unsqueeze(-1), features, 99.0))
    torch.testing.assert_close(before, net(seen)[0], atol=1e-3, rtol=1e-3)
    setattr(seen, group, torch.where(mask.unsqueeze(-1), features + 1.0, features))
    assert (before - net(seen)[0]).abs().max() > 0.01


def test_empty_sets_are_legal_forward_and_backward():
    net, seen = network(), observation()
    seen.partner_mask[:] = False
    seen.road_mask[:] = False
    logits, value = net(seen)
    assert logits.isfinite().all() and value.isfinite().all()
    (logits.square().sum() + value.sum()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())


def make_policy() -> Policy:
    return Policy(trained_like(), SimConfig(), ActionConfig(), NetworkConfig(), {"agent_steps": 7})


def test_a_saved_policy_acts_the_same(tmp_path):
    policy = make_policy()
    save_policy(tmp_path / "p.safetensors", policy)
    again = load_policy(tmp_path / "p.safetensors")
    seen = observation(64)
    assert torch.equal(policy.act(seen), again.act(seen))
    sampled = [p.act(seen, torch.Generator().manual_seed(1)) for p in (policy, again)]
    assert torch.equal(*sampled) and not torch.equal(sampled[0], policy.act(seen))
    assert again.info["agent_steps"] == 7 and again.sim == policy.sim
    assert [p.name for p in tmp_path.iterdir()] == ["p.safetensors"]


def test_acting_on_nobody_is_legal():
    assert make_policy().act(observation(0)).shape == (0,)


def test_other_features_are_refused_by_name(tmp_path):
    path = tmp_path / "p.safetensors"
    save_policy(path, make_policy())
    weights = load_file(path)
    with safe_open(path, "pt") as file:
        header = file.metadata()
    header["layout"] = header["layout"].replace("closing_speed", "gap")
    save_file(weights, path, metadata=header)
    with pytest.raises(PhaseError, match="closing_speed"):
        load_policy(path)


def test_bad_files_are_refused(tmp_path):
    with pytest.raises(PhaseError, match="no such policy file"):
        load_policy(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("hello")
    with pytest.raises(PhaseError, match="not a safetensors file"):
        load_policy(tmp_path / "text.safetensors")


def test_actions_are_drawn_as_often_as_they_are_likely():
    chance = torch.tensor([0.0, 0.1, 0.0, 0.6, 0.3, 0.0])
    logits = chance.log().expand(10_000, -1)
    tokens = choose(logits, torch.arange(10_000) / 10_000)
    share = torch.bincount(tokens, minlength=6) / len(tokens)
    torch.testing.assert_close(share, chance, atol=1e-3, rtol=0.0)
    assert not share[chance == 0.0].any()
    assert choose(logits).unique().tolist() == [3]
