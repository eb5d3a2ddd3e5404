"""Which vehicles PHASE drives, and what they and their vTypes say: the precedence of SUMO's devices."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import pytest

from phase_sumo.bridge.fleet.parameters import Choice, Context, Marks, Parameters
from phase_sumo.bridge.sumo.conventions import shape_from_type
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


def parameters(own=None, types=None, vclass="trailer", length=20.0, width=2.55):
    own, types = own or {}, types or {}
    api = SimpleNamespace(
        vehicle=SimpleNamespace(getParameter=lambda vehicle, key: own.get(key, "")),
        vehicletype=SimpleNamespace(
            getParameter=lambda kind, key: types.get(key, ""),
            getVehicleClass=lambda kind: vclass,
            getLength=lambda kind: length,
            getWidth=lambda kind: width,
        ),
    )
    return Parameters(api, "veh", "semi")


def test_nothing_said_leaves_everything_to_the_run():
    found = parameters()
    assert found.marks() == Marks()
    assert found.context() == Context(None, None, None, None, None)
    assert found.shape() == (shape_from_type("trailer", 20.0, 2.55), "articulated_truck")


def test_the_vehicles_own_values_win_over_its_types():
    types = {"phase.alpha": "0.3", "phase.target_speed": "20", "phase.policy": "a.safetensors"}
    types |= {"phase.guard": "on", "phase.time_gap": "1.2"}
    own = {"phase.alpha": "0.9", "phase.policy": "b.safetensors", "phase.guard": "off"}
    own["phase.time_gap"] = "0.8"
    found = parameters(own, types)
    assert found.context() == Context(0.9, 20.0, 0.8, "b.safetensors", False)


def test_marks_are_read_where_sumo_allows_them():
    own = {"phase.device": "no", "has.phase.device": "true", "device.phase.probability": "1"}
    types = {"has.phase.device": "1", "device.phase.probability": "0.25", "phase.device": "true"}
    assert parameters(own, types).marks() == Marks(vehicle=False, type=True, share=0.25)


def test_type_and_dimensions_by_hand():
    own = {"phase.type": "rigid_truck", "phase.wheelbase": "5.5", "phase.rear_overhang": "2"}
    shape, kind = parameters(own, vclass="truck", length=11.0).shape()
    assert kind == "rigid_truck"
    assert (shape.length, shape.wheelbase, shape.rear_overhang, shape.trailer_length) == (11.0, 5.5, 2.0, 0.0)
    assert parameters({"phase.type": "car"}, vclass="motorcycle", length=2.2).shape()[1] == "car"
    assert parameters(vclass="motorcycle", length=2.2).shape()[1] is None


@pytest.mark.parametrize(
    "given",
    [
        {"phase.length": "7"},
        {"phase.trailer_length": "14.5"},
        {"phase.trailer_length": "13", "phase.trailer_setback": "1.2", "phase.rear_overhang": "0.6"},
        {"phase.length": "6.2", "phase.trailer_length": "15.32"},
    ],
    ids=lambda given: "-".join(given),
)
def test_what_is_left_out_fits_sumos_box(given):
    shape, _ = parameters(given).shape()
    assert shape.overall_length == pytest.approx(20.0, abs=0.1)
    for key, text in given.items():
        assert getattr(shape, key.removeprefix("phase.")) == float(text)


@pytest.mark.parametrize(
    ("own", "words"),
    [
        ({"phase.alpha": "fast"}, ["phase.alpha='fast'", "0.1..1"]),
        ({"phase.time_gap": "-1"}, ["phase.time_gap='-1'", "0..5"]),
        ({"phase.alpha": "1.2"}, ["phase.alpha='1.2'", "0.1..1"]),
        ({"phase.alpha": "nan"}, ["phase.alpha='nan'"]),
        ({"phase.target_speed": "130"}, ["phase.target_speed='130'", "3..40"]),
        ({"phase.type": "bus"}, ["phase.type='bus'", "rigid_truck"]),
        ({"phase.wheelbase": "40"}, ["phase.wheelbase='40'", "1..12"]),
        ({"phase.length": "7", "phase.wheelbase": "6.9"}, ["phase.wheelbase='6.9'", "7 m"]),
        ({"phase.type": "car", "phase.trailer_length": "12"}, ["phase.trailer_length", "articulated_truck"]),
        ({"phase.length": "7", "phase.trailer_length": "12"}, ["length 20 m for SUMO", "17.4 m"]),
        ({"phase.trailer_width": "2.8"}, ["width 2.55 m for SUMO", "2.8 m"]),
        ({"phase.type": "rigid_truck", "phase.length": "9"}, ["length 20 m for SUMO", "9 m"]),
        ({"phase.trailer_base": "15"}, ["phase.trailer_base", "under the trailer"]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else None,
)
@pytest.mark.parametrize("where", ["own", "types"])
def test_bad_values_name_vehicle_type_key_value_and_what_is_allowed(own, words, where):
    found = parameters(own) if where == "own" else parameters(None, own)
    with pytest.raises(PhaseError) as raised:
        found.context()
        found.shape()
    assert all(word in str(raised.value) for word in ["'veh'", "'semi'", *words]), raised.value


@pytest.mark.parametrize(
    ("own", "types", "words"),
    [
        ({"phase.device": "maybe"}, {}, "phase.device='maybe', expected true or false"),
        ({}, {"has.phase.device": "maybe"}, "has.phase.device='maybe', expected true or false"),
        ({}, {"device.phase.probability": "30"}, "device.phase.probability='30', expected a number in 0..1"),
    ],
)
def test_bad_marks_are_named(own, types, words):
    with pytest.raises(PhaseError, match=words):
        parameters(own, types).marks()


def test_a_short_articulated_truck_is_refused():
    with pytest.raises(PhaseError, match=r"8 m leaves .* for the trailer"):
        parameters({"phase.type": "articulated_truck"}, length=8.0).shape()
