"""Named training configurations: the recipe, the paper's, ablations and baselines."""

from __future__ import annotations

import dataclasses
import math

from phase_sumo.config import (
    POOLS,
    ActionConfig,
    DirectActionConfig,
    LateFusionConfig,
    NetworkConfig,
    RewardConfig,
    ScriptConfig,
    SimConfig,
    TrainConfig,
)
from phase_sumo.errors import PhaseError


def preset(name: str) -> TrainConfig:
    """A named training configuration; ablations and baselines are the paper's Table main_ablation."""
    paper = TrainConfig()
    phase = _phase(paper)
    baseline = dataclasses.replace(
        _gpudrive(), scenarios=phase.scenarios, worlds=phase.worlds, slots=phase.slots
    )
    presets = {
        "phase": phase,
        "paper": paper,  # the paper's own weights and worlds
        "no-dclamp": dataclasses.replace(phase, dclamp_alpha=1.0),
        "no-reweighting": dataclasses.replace(phase, reweight=False),
        # rho never leaves 0: dense progress reward, early penalties and early scenarios throughout
        "no-curriculum": dataclasses.replace(phase, curriculum=(math.inf, math.inf)),
        "gpudrive": baseline,
        # our network and our lattice under its uniform prior, all else the baseline's
        "gpudrive-same-model": dataclasses.replace(
            baseline,
            network=NetworkConfig(),
            actions=ActionConfig(prior_jerk=math.inf, prior_steering_rate=math.inf),
        ),
        "smoke": dataclasses.replace(
            phase, worlds=16, slots=16, total_steps=40_000, minibatch=1024, compiled=False
        ),
    }
    if name not in presets:
        raise PhaseError(f"there is no preset {name!r}; choose one of: {', '.join(presets)}")
    return presets[name]


def _phase(paper: TrainConfig) -> TrainConfig:
    """Our recipe so far: see PAPER.md for each departure.

    - A speed above the target is what is dangerous, one below it what traffic does: it costs a tenth.
    - Goals reached slowly count in full, since nobody meets a target speed in a jam.
    - A goal missed by a lane costs less and a contact more, so that nobody pushes through; a contact ends
      the episode, so that it counts once.
    - Worlds hold what roads are full of: standing and scripted vehicles, stop and go, goals that roll on.
    """
    reward = dataclasses.replace(
        paper.reward,
        speed=0.05,
        speed_below=0.005,
        goal_speed_tolerance=(paper.sim.max_speed, 2.0),
        contacts_end=True,
        collision=20.0,
        road_edge=10.0,
        distance_unit=100.0,
    )
    scenarios = dataclasses.replace(
        paper.scenarios,
        regimes=POOLS,
        agent_scale=0.6,
        rolling_worlds=0.25,
        script=ScriptConfig(standing_worlds=0.12, scripted_worlds=0.18),
    )
    return dataclasses.replace(
        paper,
        reward=reward,
        scenarios=scenarios,
        worlds=88,  # one for every (map, regime) tuple of networks
        slots=128,
    )


def _gpudrive() -> TrainConfig:
    """The prior self-play baseline (Cornelisse et al. 2025) in our worlds: plain PPO with its settings.

    Its three rewards are ours with all other weights 0: goals of any quality count in full, penalties do
    not grow, and both agents pay for a collision. So rho moves the scenarios alone, which stay the same as
    in all other trainings.
    """
    reward = RewardConfig(
        goal=1.0,
        collision=0.75,
        not_at_fault=1.0,
        road_edge=0.75,
        lane=0.0,
        termination=0.0,
        alignment=0.0,
        speed=0.0,
        speed_below=0.0,
        progress=0.0,
        penalty_growth=1.0,
        goal_speed_tolerance=(SimConfig().max_speed, SimConfig().max_speed),
        goal_yaw_tolerance=math.pi,
    )
    return TrainConfig(
        sim=SimConfig(early_termination=False),
        actions=DirectActionConfig(),
        reward=reward,
        network=LateFusionConfig(),
        rollout=64,  # of 77 worlds with some 2,000 agents: about its batch of 131,072
        minibatch=8192,
        epochs=4,
        learning_rate=3e-4,
        final_learning_rate=1.0,
        gamma=0.99,
        dclamp_alpha=1.0,
        value_weight=0.3,
        prior_weight=1e-4,  # of the entropy
        reweight=False,
        learn_share=1.0,
    )
