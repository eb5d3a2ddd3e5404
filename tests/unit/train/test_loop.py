"""Run folder, resume and refusals of the training loop."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
import torch

from phase_sumo.config import REGIMES, RewardConfig, TrainConfig, from_dict, to_dict
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.train import ppo
from phase_sumo.train.loop import Trainer
from phase_sumo.train.presets import preset
from phase_sumo.train.run_folder import RunFolder
from tests.helpers.curves import read_curve, read_tensorboard

TINY = dataclasses.replace(
    preset("smoke"), worlds=8, slots=8, minibatch=128, total_steps=4000, checkpoint_every=700
)


def weights(trainer: Trainer) -> list[torch.Tensor]:
    return [p.detach().clone() for p in trainer.network.parameters()]


def test_a_run_leaves_config_curve_checkpoint_and_policy(straight_map, tmp_path):
    config = dataclasses.replace(TINY, held_out_every=2000)
    trainer = Trainer(config, [straight_map], [straight_map], RunFolder(tmp_path / "run"))
    before = weights(trainer)
    trainer.run()
    assert trainer.steps >= config.total_steps
    assert any(not torch.equal(a, b) for a, b in zip(before, weights(trainer), strict=True))
    assert sorted(p.name for p in (tmp_path / "run").iterdir() if p.is_file()) == [
        "checkpoint.pt",
        "config.json",
        "curve.csv",
        "policy.safetensors",
        "run.lock",
    ]
    rows = read_curve(tmp_path / "run")
    assert [float(r["steps"]) for r in rows] == sorted(float(r["steps"]) for r in rows)
    assert sum(bool(r["held_out_goal_rate"]) for r in rows) == 2
    points = read_tensorboard(tmp_path / "run")
    assert len(points) == len(rows[0]) and len(points["held_out/goal_rate"]) == 2
    assert points["training/goal_rate"] == [int(r["steps"]) for r in rows]
    assert all(float(r["peak_memory_mb"]) > 50 for r in rows)
    assert load_policy(tmp_path / "run" / "policy.safetensors").info["agent_steps"] == trainer.steps


BASELINE = dataclasses.replace(
    preset("gpudrive"),
    compiled=False,
    worlds=8,
    slots=8,
    rollout=16,
    minibatch=256,
    epochs=2,
    total_steps=2500,
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


@pytest.mark.parametrize("when", ["before", "in the last step"])
def test_divergence_stops_with_the_last_checkpoint_intact(straight_map, tmp_path, monkeypatch, when: str):
    config = dataclasses.replace(TINY, checkpoint_every=1)
    trainer = Trainer(config, [straight_map], [], RunFolder(tmp_path))

    def break_weights() -> None:
        with torch.no_grad():
            trainer.network.value[-1].bias.fill_(float("nan"))  # type: ignore[union-attr]

    def learn_and_break(*arguments) -> dict[str, float]:
        losses = ppo.learn(*arguments)
        break_weights()
        return losses  # of the minibatches before: all finite

    if when == "before":
        break_weights()
    else:
        monkeypatch.setattr("phase_sumo.train.loop.learn", learn_and_break)
    with pytest.raises(PhaseError, match=r"diverged at 0 .*learning_rate in config.json.*--resume"):
        trainer.run()
    assert all(t.isfinite().all() for t in RunFolder(tmp_path).load()["network"].values())


@pytest.mark.parametrize(("worlds", "slots"), [(72, 48), (24, 192)])
def test_a_checkpoint_is_small(straight_map, tmp_path, worlds: int, slots: int):
    config = dataclasses.replace(
        preset("phase"), compiled=False, worlds=worlds, slots=slots, rollout=1, total_steps=1
    )
    Trainer(config, [straight_map], [], RunFolder(tmp_path)).run()
    assert (tmp_path / "checkpoint.pt").stat().st_size < 10e6


def test_a_resumed_run_keeps_its_maps_and_its_new_length(straight_map, tmp_path):
    Trainer(dataclasses.replace(TINY, total_steps=1), [straight_map], [], RunFolder(tmp_path)).run()
    Trainer(dataclasses.replace(TINY, total_steps=2), [straight_map], [], RunFolder(tmp_path), resume=True)
    assert RunFolder(tmp_path).config().total_steps == 2
    other = dataclasses.replace(straight_map, name="other")
    with pytest.raises(PhaseError, match=r"trains on straight, not other.*same --networks"):
        Trainer(TINY, [other], [], RunFolder(tmp_path), resume=True)


def test_a_broken_checkpoint_is_refused(straight_map, tmp_path):
    Trainer(TINY, [straight_map], [], RunFolder(tmp_path))
    file = tmp_path / "checkpoint.pt"
    stored = torch.load(file, weights_only=True)
    file.write_bytes(file.read_bytes()[:5000])
    refusal = r"checkpoint.pt: broken, or of another version.*--start-from"
    with pytest.raises(PhaseError, match=refusal):
        Trainer(TINY, [straight_map], [], RunFolder(tmp_path), resume=True)
    del stored["env"]["worlds"]
    torch.save(stored, file)
    with pytest.raises(PhaseError, match=refusal):
        Trainer(TINY, [straight_map], [], RunFolder(tmp_path), resume=True)


def test_presets_differ_in_what_they_ablate():
    phase = preset("phase")
    assert preset("no-dclamp") == dataclasses.replace(phase, dclamp_alpha=1.0)
    assert preset("no-reweighting") == dataclasses.replace(phase, reweight=False)
    assert preset("no-curriculum") == dataclasses.replace(phase, curriculum=(math.inf, math.inf))
    assert preset("paper").reward == RewardConfig() and preset("paper").scenarios.regimes == REGIMES
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


def test_two_cannot_train_in_one_folder(straight_map, tmp_path):
    first = Trainer(TINY, [straight_map], [], RunFolder(tmp_path))
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    for resume in (False, True):
        with pytest.raises(PhaseError, match="another process trains in this folder"):
            Trainer(TINY, [straight_map], [], RunFolder(tmp_path), resume=resume)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
    (tmp_path / "checkpoint.pt.1.part").write_bytes(b"left by a process that was killed")
    first.run()
    Trainer(TINY, [straight_map], [], RunFolder(tmp_path), resume=True)
    assert not list(tmp_path.glob("*.part"))
