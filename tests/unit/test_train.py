"""Run folder, resume and refusals of the training loop."""

from __future__ import annotations

import csv
import dataclasses
import json

import pytest
import torch

from phase_sumo.config import TrainConfig, from_dict, preset, to_dict
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.train.loop import Trainer
from phase_sumo.train.run_folder import RunFolder

TINY = dataclasses.replace(
    preset("smoke"), worlds=8, slots=8, minibatch=128, total_steps=4000, checkpoint_every=700
)


def weights(trainer: Trainer) -> list[torch.Tensor]:
    return [p.detach().clone() for p in trainer.network.parameters()]


def test_a_run_leaves_config_curve_checkpoint_and_policy(straight_map, tmp_path):
    config = dataclasses.replace(TINY, held_out_every=1000)
    trainer = Trainer(config, [straight_map], [straight_map], RunFolder(tmp_path / "run"))
    before = weights(trainer)
    trainer.run()
    assert trainer.steps >= config.total_steps
    assert any(not torch.equal(a, b) for a, b in zip(before, weights(trainer), strict=True))
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "checkpoint.pt",
        "config.json",
        "curve.csv",
        "policy.safetensors",
    ]
    with (tmp_path / "run" / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["steps"]) for r in rows] == sorted(float(r["steps"]) for r in rows)
    assert sum(bool(r["held_out_goal_rate"]) for r in rows) == 4
    assert load_policy(tmp_path / "run" / "policy.safetensors").info["agent_steps"] == trainer.steps
    assert (tmp_path / "run" / "checkpoint.pt").stat().st_size < 16e6


BASELINE = dataclasses.replace(
    preset("gpudrive"), worlds=8, slots=8, rollout=16, minibatch=256, epochs=2, total_steps=2500
)


@pytest.mark.parametrize("config", [TINY, BASELINE], ids=["phase", "gpudrive"])
def test_a_stopped_run_continues_bit_for_bit(straight_map, tmp_path, config: TrainConfig):
    whole = Trainer(config, [straight_map], [], RunFolder(tmp_path / "whole"))
    whole.run()
    first = Trainer(config, [straight_map], [], RunFolder(tmp_path / "parts"))
    updates: list[dict[str, float]] = []
    first.run(updates.append, stopping=lambda: len(updates) == 2)
    assert first.steps < config.total_steps
    second = Trainer(config, [straight_map], [], RunFolder(tmp_path / "parts"), resume=True)
    second.run()
    assert second.steps == whole.steps
    for a, b in zip(weights(whole), weights(second), strict=True):
        assert torch.equal(a, b)


def test_an_existing_run_is_not_overwritten(straight_map, tmp_path):
    config = dataclasses.replace(TINY, total_steps=1)
    Trainer(config, [straight_map], [], RunFolder(tmp_path)).run()
    with pytest.raises(PhaseError, match="--resume"):
        Trainer(config, [straight_map], [], RunFolder(tmp_path))


def test_resume_needs_a_run(straight_map, tmp_path):
    with pytest.raises(PhaseError, match="without --resume"):
        Trainer(TINY, [straight_map], [], RunFolder(tmp_path / "nothing"), resume=True)


def test_a_new_run_can_start_from_a_policy(straight_map, tmp_path):
    first = Trainer(TINY, [straight_map], [], RunFolder(tmp_path / "first"))
    first.run()
    policy = load_policy(tmp_path / "first" / "policy.safetensors")
    second = Trainer(TINY, [straight_map], [], RunFolder(tmp_path / "second"), start=policy)
    for a, b in zip(weights(first), weights(second), strict=True):
        assert torch.equal(a, b)
    assert second.steps == 0 and second.scale.get() == first.scale.get()
    wider = dataclasses.replace(TINY, network=dataclasses.replace(TINY.network, trunk=256))
    with pytest.raises(PhaseError, match="same network"):
        Trainer(wider, [straight_map], [], RunFolder(tmp_path / "third"), start=policy)


def test_divergence_stops_with_the_last_checkpoint_intact(straight_map, tmp_path):
    trainer = Trainer(TINY, [straight_map], [], RunFolder(tmp_path))
    trainer.save()
    with torch.no_grad():
        trainer.network.value[-1].bias.fill_(float("nan"))  # type: ignore[union-attr]
    with pytest.raises(PhaseError, match="diverged"):
        trainer.run()
    assert all(t.isfinite().all() for t in RunFolder(tmp_path).load()["network"].values())


def test_presets_differ_in_what_they_ablate():
    phase = preset("phase")
    assert preset("no-dclamp") == dataclasses.replace(phase, dclamp_alpha=1.0)
    assert preset("no-reweighting") == dataclasses.replace(phase, reweight=False)
    assert preset("no-curriculum") == dataclasses.replace(phase, curriculum=(2.0, 3.0))
    baseline, same_model = preset("gpudrive"), preset("gpudrive-same-model")
    assert same_model.network == phase.network and same_model.actions.axes == phase.actions.axes
    model = {"network": baseline.network, "actions": baseline.actions}
    assert dataclasses.replace(same_model, **model) == baseline
    assert baseline.scenarios == phase.scenarios and baseline.curriculum == phase.curriculum
    with pytest.raises(PhaseError, match="no preset 'fast'"):
        preset("fast")


@pytest.mark.parametrize("name", ["smoke", "gpudrive", "gpudrive-same-model"])
def test_config_round_trip(name: str):
    config = preset(name)
    assert from_dict(TrainConfig, json.loads(json.dumps(to_dict(config)))) == config


def test_unknown_settings_are_refused():
    with pytest.raises(PhaseError, match="no setting 'speed'"):
        from_dict(TrainConfig, {"speed": 1})
