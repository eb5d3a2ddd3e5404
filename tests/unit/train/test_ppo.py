"""GAE by hand, the DClamp objective at known points, weights, prior and filtering."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from phase_sumo.config import ActionConfig, DirectActionConfig
from phase_sumo.policy.network import log_prior
from phase_sumo.sim.observation import Observation
from phase_sumo.train.ppo import (
    ValueScale,
    dclamp_objective,
    filter_samples,
    gae,
    minibatches,
    prior_kl,
    world_weights,
)
from phase_sumo.train.presets import preset
from phase_sumo.train.rollout import Samples


def slots(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(-1, 1, 1)


def test_gae_by_hand_without_an_ending():
    advantage = gae(
        reward=slots(1.0, 2.0),
        value=slots(0.5, 1.0),
        last_value=torch.full((1, 1), 3.0),
        finished=slots(0, 0).bool(),
        active=slots(1, 1).bool(),
        gamma=0.9,
        lam=0.5,
    )
    second = 2.0 + 0.9 * 3.0 - 1.0
    first = 1.0 + 0.9 * 1.0 - 0.5 + 0.45 * second
    assert advantage.flatten().tolist() == pytest.approx([first, second])


def test_gae_stops_at_an_ending_and_skips_empty_slots():
    """The agent ends at step 1, its slot is empty at step 2, another agent begins at step 3."""
    advantage = gae(
        reward=slots(1.0, 2.0, 0.0, 5.0),
        value=slots(0.5, 1.0, 0.0, 2.0),
        last_value=torch.full((1, 1), 4.0),
        finished=slots(0, 1, 0, 0).bool(),
        active=slots(1, 1, 0, 1).bool(),
        gamma=0.9,
        lam=0.5,
    )
    second = 2.0 - 1.0
    first = 1.0 + 0.9 * 1.0 - 0.5 + 0.45 * second
    assert advantage.flatten().tolist() == pytest.approx([first, second, 0.0, 5.0 + 3.6 - 2.0])


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (0.5, 1.0, -0.1),  # PPO: 0.5
        (1.5, -1.0, -2.1),  # PPO: -1.5
        (1.5, 1.0, 1.2),
        (0.5, -1.0, -0.8),
        (1.0, 2.0, 2.0),
        (0.9, 1.0, 0.9),
        (0.8, 1.0, 0.8),  # continuous at the threshold
    ],
)
def test_dclamp_at_known_points(ratio: float, advantage: float, expected: float):
    got = dclamp_objective(torch.tensor(ratio), torch.tensor(advantage), 0.2, 3.0, 0.2)
    assert got.item() == pytest.approx(expected, abs=1e-6)


def test_dclamp_with_alpha_one_is_ppo():
    generator = torch.Generator().manual_seed(0)
    ratio = 2.0 * torch.rand(1000, generator=generator)
    advantage = torch.randn(1000, generator=generator)
    ppo = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage)
    torch.testing.assert_close(dclamp_objective(ratio, advantage, 0.2, 1.0, 0.2), ppo)


def test_dclamp_pulls_three_times_as_hard_in_the_wrong_region():
    ratio = torch.tensor(0.5, requires_grad=True)
    dclamp_objective(ratio, torch.tensor(1.0), 0.2, 3.0, 0.2).backward()
    assert ratio.grad is not None and ratio.grad.item() == pytest.approx(3.0)


def test_every_world_weighs_the_same_however_many_agents():
    active = torch.zeros(5, 2, 8, dtype=torch.bool)
    active[:, 0, :8] = True
    active[:, 1, :2] = True
    weight = world_weights(active)
    assert weight[:, 0].sum().item() == pytest.approx(weight[:, 1].sum().item())
    assert weight[active].mean().item() == pytest.approx(1.0)
    assert weight[~active].sum().item() == 0.0


def test_prior_is_a_discrete_gaussian_centred_at_zero_and_the_kl_is_zero_on_it():
    actions = ActionConfig()
    prior = log_prior(actions)
    assert prior.exp().sum().item() == pytest.approx(1.0)
    centre = actions.jerk.index(0.0) * len(actions.steering_rate) + actions.steering_rate.index(0.0)
    assert prior.argmax().item() == centre
    step = actions.jerk.index(1.5) * len(actions.steering_rate) + actions.steering_rate.index(0.0)
    expected = -0.5 * (1.5 / actions.prior_jerk) ** 2
    assert (prior[step] - prior[centre]).item() == pytest.approx(expected, rel=1e-4)
    assert prior_kl(prior.unsqueeze(0), prior).item() == pytest.approx(0.0, abs=1e-6)
    uniform = torch.full((1, actions.count), 1.0 / actions.count).log()
    assert prior_kl(uniform, prior).item() > 0.1


def test_kl_to_the_uniform_prior_is_the_entropy_bonus():
    prior = log_prior(DirectActionConfig())
    assert len(prior) == 91
    policy = torch.randn(5, 91, generator=torch.Generator().manual_seed(0)).log_softmax(-1)
    entropy = -(policy.exp() * policy).sum(-1)
    torch.testing.assert_close(prior_kl(policy, prior), math.log(91) - entropy)


def numbered(advantage: torch.Tensor) -> Samples:
    """Samples that carry their number."""
    rows = torch.arange(float(len(advantage)))
    seen = Observation(*(rows.unsqueeze(-1) for _ in range(6)))
    return Samples(seen, rows.long(), rows, advantage, rows, rows)


@pytest.mark.parametrize(("count", "parts"), [(10, 1), (64, 1), (95, 1), (97, 2), (1000, 16)])
def test_every_epoch_visits_every_sample_once_in_parts_of_equal_size(count: int, parts: int):
    config = dataclasses.replace(preset("smoke"), minibatch=64, epochs=3)
    found = list(minibatches(torch.arange(count), config, torch.Generator().manual_seed(0)))
    batches = [index for index, _ in found]
    assert len(batches) == 3 * parts and all(len(index) == size for index, size in found)
    assert max(map(len, batches)) - min(map(len, batches)) <= 1
    for epoch in range(3):
        visited = torch.cat(batches[epoch * parts : (epoch + 1) * parts])
        assert visited.sort().values.tolist() == list(range(count))


def test_filter_keeps_the_samples_with_the_largest_advantages():
    samples = numbered(torch.tensor([0.1, -3.0, 0.5, 2.0, -0.2, 0.0]))
    kept = samples.select(filter_samples(samples, 0.5, 64))
    assert sorted(kept.advantage.tolist()) == [-3.0, 0.5, 2.0]
    assert kept.observation.ego.flatten().tolist() == kept.log_prob.tolist()
    assert len(filter_samples(samples, 1.0, 4)) == 6


def test_filter_keeps_whole_minibatches():
    samples = numbered(torch.arange(100.0))
    kept = filter_samples(samples, 0.75, 32)
    assert kept.tolist() == list(range(36, 100))


def test_value_scale_learns_mean_and_spread():
    scale = ValueScale()
    assert scale.get() == (0.0, 1.0)
    for _ in range(50):
        scale.update(torch.tensor([1.0, 5.0]))
    assert scale.get() == (pytest.approx(3.0), pytest.approx(2.0))
