"""The compiled trunk and heads do what torch does with products in bf16, for results and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from phase_sumo.config import ActionConfig, DirectActionConfig, NetworkConfig
from phase_sumo.policy import network as module
from phase_sumo.policy.native import TILES
from phase_sumo.policy.network import PolicyNetwork
from phase_sumo.sim.compiler import cpp_compiler
from tests.helpers.observations import observation

pytestmark = pytest.mark.skipif(cpp_compiler() is None or not TILES, reason="no compiler or no tiles here")
ODD = NetworkConfig(width=48, hidden=32, heads=3, feedforward=16, seeds=5, trunk=90, head=50)
CASES = [(NetworkConfig(), ActionConfig()), (ODD, DirectActionConfig())]


def network(config: NetworkConfig, actions: ActionConfig | DirectActionConfig) -> PolicyNetwork:
    torch.manual_seed(1)
    net = PolicyNetwork(config, actions)
    with torch.no_grad():
        for weight in net.trunk[0].parameters():
            weight.add_(0.3 * torch.randn_like(weight))
        net.get_parameter("policy.2.weight").mul_(100.0)
    return net


def results(net: PolicyNetwork, bf16: bool) -> list[Tensor]:
    """Logits, value and the gradients of all parameters."""
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        logits, value = net(observation(300))
    draw = torch.Generator().manual_seed(2)
    loss = (logits * torch.randn(logits.shape, generator=draw)).sum()
    loss = loss + (value * torch.randn(value.shape, generator=draw)).sum()
    return [logits.detach(), value.detach(), *torch.autograd.grad(loss, list(net.parameters()))]


@pytest.mark.parametrize(("config", "actions"), CASES)
@pytest.mark.parametrize("threads", [1, 2])
def test_it_is_as_far_from_fp32_as_torch_in_bf16(config, actions, threads: int, monkeypatch):
    net, before = network(config, actions), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        right, ours = results(net, False), results(net, True)
        monkeypatch.setattr(module, "load_trunk", lambda *_: None)
        theirs = results(net, True)
    finally:
        torch.set_num_threads(before)
    assert not all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))  # another way of doing it
    for mine, torchs, exact in zip(ours, theirs, right, strict=True):
        off, allowed = (mine - exact).norm() / exact.norm(), (torchs - exact).norm() / exact.norm()
        assert float(off) < max(1.5 * float(allowed), 0.01)


def test_an_agent_gets_the_same_in_any_company():
    net, seen = network(*CASES[0]), observation(600)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        logits, value = net(seen)
        some = net(seen.map(lambda t: t[250:270]))
        assert torch.equal(net.logits(seen), logits)
    assert torch.equal(some[0], logits[250:270]) and torch.equal(some[1], value[250:270])


def test_the_same_again():
    net = network(*CASES[0])
    assert all(torch.equal(a, b) for a, b in zip(results(net, True), results(net, True), strict=True))
