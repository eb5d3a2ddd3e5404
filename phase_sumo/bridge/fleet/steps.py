"""How SUMO's step and the policy's fit into each other.

The policy decides every 0.1 s of simulated time, as it was trained to. A longer step of SUMO holds several
decisions; between two decisions there may be several shorter ones, in which the vehicles only move on. All
decide at the same instants, the multiples of 0.1 s. A vehicle that is taken over in between keeps the
acceleration that it had under SUMO until then, so that its speed does not jump.
"""

from __future__ import annotations

from dataclasses import dataclass

from phase_sumo.errors import PhaseError

TOLERANCE = 1e-6  # s
MILLISECOND = 1e-3  # s, SUMO's clock counts them


@dataclass(frozen=True)
class Steps:
    """Moves of the vehicles, each as long as the shorter of the two steps.

    Attributes:
        seconds: of a move.
        per_sumo_step: moves in a step of SUMO.
        per_decision: moves from one decision to the next; one of the two numbers is 1.
    """

    seconds: float
    per_sumo_step: int
    per_decision: int

    @classmethod
    def fit(cls, sumo: float, policy: float) -> Steps:
        """For steps of SUMO and of the policy in s.

        Raises:
            PhaseError: neither is a multiple of the other.
        """
        several, parts = max(round(sumo / policy), 1), max(round(policy / sumo), 1)
        if abs(several * policy - parts * sumo) > TOLERANCE:
            in_milliseconds = round(policy / MILLISECOND)
            usable = [policy / n for n in range(1, in_milliseconds + 1) if in_milliseconds % n == 0]
            nearest = min([several * policy, *usable], key=lambda step: abs(step - sumo))
            raise PhaseError(
                f"option step-length {sumo:g} s: PHASE decides every {policy:g} s, which the step "
                f"must divide or be a multiple of; pass -- --step-length {nearest:g}"
            )
        return cls(policy / parts, several, parts)

    def decides(self, time: float) -> bool:
        """Whether the move that begins at a time begins with a decision."""
        return round(time / self.seconds) % self.per_decision == 0
