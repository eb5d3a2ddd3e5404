"""Which vehicles PHASE drives: the precedence of SUMO's devices, shares by draw and by count."""

from __future__ import annotations

import itertools

import pytest

from phase_sumo.bridge.fleet.parameters import Choice, Marks
from phase_sumo.errors import PhaseError

NAMES = [f"veh{i}" for i in range(4000)]


def test_the_share_is_nested_seeded_and_fair():
    few = {n for n in NAMES if Choice(share=0.2, seed=1).drawn(n, "car")}
    many = {n for n in NAMES if Choice(share=0.6, seed=1).drawn(n, "car")}
    assert few < many
    assert len(few) / len(NAMES) == pytest.approx(0.2, abs=0.03)
    assert few != {n for n in NAMES if Choice(share=0.2, seed=2).drawn(n, "car")}
    assert all(Choice(share=1.0).drawn(n, "car") for n in NAMES)
    assert not any(Choice(share=0.0).drawn(n, "car") for n in NAMES)


def test_types_and_alpha():
    choice = Choice(types=("semi",), alpha=0.5)
    assert choice.drawn("a", "semi")
    assert not choice.drawn("a", "car")
    assert choice.alpha_of("a") == 0.5
    drawn = [Choice(alpha=(0.4, 0.6)).alpha_of(f"v{i}") for i in range(100)]
    assert min(drawn) >= 0.4
    assert max(drawn) <= 0.6
    assert len(set(drawn)) > 90


def test_explicit_ids_win_over_the_vehicle_and_that_over_its_type():
    choice, options = Choice(explicit=("named",)), (None, True, False)
    for own, kind in itertools.product(options, options):
        marks = Marks(own, kind)
        assert choice.certain("named", marks) is True
        assert choice.certain("other", marks) == (kind if own is None else own)


def test_explicit_ids_alone_leave_the_others_to_sumo():
    assert Choice().probability == 1.0
    assert Choice(explicit=("named",)).probability == 0.0
    assert Choice(explicit=("named",), share=0.5).probability == 0.5


@pytest.mark.parametrize("share", [0.0, 0.25, 0.3, 0.377, 1.0])
def test_a_deterministic_share_is_met_exactly_and_spread_evenly(share):
    choice = Choice(share=share, deterministic=True)
    chosen = [choice.drawn("any", "car", number) for number in range(1000)]
    assert sum(chosen) == round(1000 * share)
    for first in range(0, 990, 90):  # nowhere bunched
        assert sum(chosen[first : first + 90]) == pytest.approx(90 * share, abs=1.0)


def test_a_types_own_share_wins_over_the_common_one():
    choice = Choice(share=0.0)
    few = {n for n in NAMES if choice.drawn(n, "car", share=0.2)}
    assert len(few) / len(NAMES) == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(
    ("given", "words"),
    [({"alpha": 0.05}, r"alpha 0\.05"), ({"share": 1.5}, r"share 1\.5.*0 and 1")],
)
def test_bad_values_are_named(given, words):
    with pytest.raises(PhaseError, match=words):
        Choice(**given)
