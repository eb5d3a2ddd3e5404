"""Training visibly learns: the goal rate on held-out worlds rises from the prior's."""

from __future__ import annotations

import dataclasses

from phase_sumo.config import ScenarioConfig
from phase_sumo.evaluate.synthetic import evaluate_synthetic
from phase_sumo.train.loop import Trainer
from phase_sumo.train.presets import preset
from phase_sumo.train.run_folder import RunFolder

SCENARIOS = ScenarioConfig(agent_scale=0.1)


def test_goal_rate_rises_on_held_out_worlds(straight_map, tmp_path):
    config = dataclasses.replace(
        preset("paper"),
        scenarios=SCENARIOS,
        compiled=False,
        worlds=32,
        slots=12,
        minibatch=512,
        learning_rate=1e-3,
        learn_share=1.0,
        total_steps=260_000,
        curriculum=(2.0, 3.0),  # rewards stay as they are, so that the rise is learning
    )
    trainer = Trainer(config, [straight_map], [], RunFolder(tmp_path / "run"))

    def goal_rate() -> float:
        result = evaluate_synthetic(
            trainer.policy(), [straight_map], SCENARIOS, worlds=48, slots=12, seed=777, sampled=True
        )
        return result["goal_rate"]

    before = goal_rate()
    trainer.run()
    after = goal_rate()
    assert after > before + 0.15, (before, after)
