"""Features and encoder: what they must not depend on, and that training is repeatable."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.realism.encoder import (
    ALONG,
    ASIDE,
    FORWARDS,
    SCALE,
    THERE,
    Encoder,
    Forecaster,
    Training,
    features,
    train,
    trajectories,
)
from tests.helpers.steady_recordings import WIDTH, recording


def some_scenes(count=12):
    rng = np.random.default_rng(0)
    starts = [
        [(30.0 * k + rng.uniform(0, 10), int(rng.integers(3)), rng.uniform(15, 25)) for k in range(8)]
        for _ in range(count)
    ]
    scenes = [recording(s, samples=51) for s in starts]
    return [features(scene, trajectories(scene)) for scene in scenes]


def test_features_by_hand():
    """A car, another 20 m ahead in the lane to the left and 2 m/s faster."""
    scene = recording([(50.0, 0, 10.0), (70.0, 1, 12.0)], samples=51)
    own = features(scene, trajectories(scene))[0].double().numpy() * SCALE
    seconds = 0.5 * np.arange(11)
    assert own[0, :, (ALONG, ASIDE, FORWARDS)] == pytest.approx(np.zeros((3, 11)), abs=1e-5)
    assert own[1, :, ALONG] == pytest.approx(20.0 + 2.0 * seconds, abs=1e-4)
    assert own[1, :, ASIDE] == pytest.approx(np.full(11, WIDTH), abs=1e-5)
    assert own[1, :, FORWARDS] == pytest.approx(np.full(11, 2.0), abs=1e-4)
    assert not own[2:].any()  # nobody else


def test_features_do_not_depend_on_where_the_road_lies():
    scene = recording([(50.0, 0, 10.0), (70.0, 1, 12.0)], samples=51)
    turn, (dx, dy) = 2.1, (400.0, -90.0)
    cos, sin = np.cos(turn), np.sin(turn)
    x, y = scene.x * cos - scene.y * sin + dx, scene.x * sin + scene.y * cos + dy
    moved = replace(scene, x=x, y=y, yaw=scene.yaw + turn)
    rows = trajectories(scene)
    assert torch.allclose(features(scene, rows), features(moved, rows), atol=1e-4)


def test_a_vehicle_that_is_lost_leaves_no_trajectory_but_stays_a_neighbour():
    scene = recording([(50.0, 0, 10.0), (70.0, 1, 12.0)], samples=51)
    present, x = scene.present.copy(), scene.x.copy()
    present[1, 26:], x[1, 26:] = False, np.nan
    cut = replace(scene, present=present, x=x)
    assert trajectories(cut).tolist() == [0]
    tokens = features(cut, np.array([0]))[0]
    assert tokens[1, :, THERE].tolist() == [1.0] * 6 + [0.0] * 5
    assert bool(torch.isfinite(tokens).all())


def test_masked_motion_and_absent_vehicles_change_nothing():
    x = some_scenes(1)[0]
    torch.manual_seed(0)
    model, masked = Forecaster(x.shape[2]).eval(), torch.zeros(x.shape[:3], dtype=torch.bool)
    masked[:, :, 5:] = True
    other = x.clone()
    other[:, :, 5:, :4] += 3.0
    assert torch.allclose(model.tokens(x, masked), model.tokens(other, masked))
    absent = x.clone()
    absent[:, 3] = 0.0
    scrambled = absent.clone()
    scrambled[:, 3, :, :THERE] = 7.0  # what an absent vehicle's features say is not looked at
    nothing = torch.zeros_like(masked)
    assert torch.allclose(
        model.tokens(absent, nothing)[:, 0], model.tokens(scrambled, nothing)[:, 0], atol=1e-6
    )


def test_training_learns_and_repeats(tmp_path):
    scenes = some_scenes()
    training = Training(5.0, ("a", "b"), sum(map(len, scenes)), 12, seed=3)
    first, again = train(scenes, training), train(scenes, training)
    assert torch.equal(first.model.state_dict()["head.weight"], again.model.state_dict()["head.weight"])
    assert first.training.loss < train(scenes, replace(training, steps=1)).training.loss - 0.5
    first.save(tmp_path / "encoder.safetensors")
    loaded = Encoder.load(tmp_path / "encoder.safetensors")
    assert loaded.training == first.training
    assert np.array_equal(loaded.embed(scenes[0]), first.embed(scenes[0]))


def test_a_file_that_is_no_encoder_is_refused(tmp_path):
    (tmp_path / "x.safetensors").write_bytes(b"nothing")
    with pytest.raises(PhaseError, match="not a trajectory encoder"):
        Encoder.load(tmp_path / "x.safetensors")
    with pytest.raises(PhaseError, match="only 0 whole trajectories"):
        train([], Training(5.0, (), 0, 1, 0))
