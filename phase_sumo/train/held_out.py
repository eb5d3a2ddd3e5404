"""Rates on maps that are never trained on, now and then during training."""

from __future__ import annotations

from phase_sumo.config import TrainConfig
from phase_sumo.evaluate.synthetic import RATES, evaluate_synthetic
from phase_sumo.policy.checkpoint import Policy
from phase_sumo.sim.bundle import MapBundle

WORLDS = 60
BY_GROUP = ("goal_rate", "at_fault_rate")


def is_due(steps: int, latest: int, every: int) -> bool:
    """Whether the ``latest`` of ``steps`` agent steps crossed a multiple of ``every``."""
    return steps // every > (steps - latest) // every


def held_out_rates(policy: Policy, maps: list[MapBundle], config: TrainConfig) -> dict[str, float]:
    """Columns of the curve: goal, collision and road-edge rates in the same worlds every time."""
    result = evaluate_synthetic(
        policy, maps, config.scenarios, WORLDS, config.slots, seed=10_000 + config.seed
    )
    rates = {f"held_out_{name}": result[name] for name in RATES}
    for group in {**result["by_regime"], **result["by_kind"]}.items():
        rates |= {f"held_out_{group[0]}_{name}": group[1][name] for name in BY_GROUP}
    return rates
