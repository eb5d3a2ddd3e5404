"""The realism command on a small log: training, rollouts, distances, figure and files."""

import json

import numpy as np
import pytest

from phase_sumo import cli
from phase_sumo.errors import PhaseError
from phase_sumo.report.study_figures import cluster_figure
from phase_sumo.studies import realism as command
from tests.helpers.standin import Standin


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two scenes of 15 s with 12 cars each in three lanes, as track CSV."""
    rng = np.random.default_rng(0)
    lines = ["scene,id,t,x_m,y_m,lane,v_mps,length_m,width_m"]
    for scene in ("a", "b"):
        for car in range(12):
            lane, speed, start = car % 3, rng.uniform(18, 24), 45.0 * (car // 3) + rng.uniform(0, 10)
            lines += [
                f"{scene},{car},{t:.1f},{start + speed * t:.3f},{3.66 * lane:.3f},{lane},{speed:.3f},4.6,1.9"
                for t in 0.1 * np.arange(151)
            ]
    path = tmp_path_factory.mktemp("log") / "made.csv"
    path.write_text("\n".join(lines) + "\n")
    return f"tracks:{path}"


def test_from_log_to_table(log, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "TRAINING_STEPS", 3)
    result = command.realism([log], ["phase", "idm"], tmp_path, policy=Standin(), most=2, draw=cluster_figure)
    assert result["encoder"]["recordings"] == ("made/a",)
    assert result["recordings"] == ["made/b"]
    assert (result["windows"], result["trajectories"]) == (2, 24)
    assert result["lost"] == {"phase": 0, "idm": 0}
    for model in ("phase", "idm"):
        table = result["models"][model]
        assert 0.0 < table["frechet"]["low"] < table["frechet"]["value"] < table["frechet"]["high"]
        assert table["w1_speed"]["value"] < 5.0
    assert sum(result["clusters"]["share"]) == pytest.approx(1.0)
    assert (tmp_path / "clusters.png").stat().st_size > 10_000
    json.dumps(result)
    again = command.realism(
        [log], ["idm"], tmp_path / "again", encoder=tmp_path / "encoder.safetensors", policy=Standin(), most=2
    )
    assert json.dumps(again["models"]["idm"]) == json.dumps(result["models"]["idm"])  # NaN is NaN there


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--logs", "nonsense:x"], "no such source of recordings"),
        (["--logs", "tracks:x.csv", "--models", "phase:0.3"], "all vehicles of a rollout have one model"),
        (["--logs", "tracks:x.csv", "--models", "idl"], "idl"),
    ],
)
def test_bad_arguments_get_one_line(words, message, tmp_path, capsys):
    assert cli.main(["realism", *words, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out" / "clusters.png").exists()


def test_an_encoder_that_has_seen_all_is_refused(log, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "TRAINING_STEPS", 2)
    monkeypatch.setattr(command, "roll_out_all", lambda *_: pytest.fail("nothing is left to roll out"))
    (source,) = command.open_sources([log])
    each = [iter([recording]) for recording in source]  # a source each: both are learnt from
    both = command.select(each, None, 5.0, 1, lambda _: None)
    command._train(both, 5.0, 0, lambda *_: None).save(tmp_path / "e.safetensors")
    with pytest.raises(PhaseError, match="trained on all of these"):
        command.realism([log], ["idm"], tmp_path, encoder=tmp_path / "e.safetensors", policy=Standin())
