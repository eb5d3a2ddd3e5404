"""Which recordings an encoder learns from and which are tested, and that none is held."""

from __future__ import annotations

import weakref

import numpy as np

from phase_sumo.evaluate.realism import selection
from phase_sumo.evaluate.realism.selection import select
from tests.helpers.steady_recordings import recording

CARS = [(20.0, 0, 5.0), (60.0, 1, 5.5)]


def source(names, samples=121, held=None):
    for name in names:
        made = recording(CARS, samples, name=name)
        if held is not None:
            assert not any(other() for other in held)
            held.append(weakref.ref(made))
        yield made
        del made


def selected(*sources, known=None, most=64):
    return select(sources, known, 5.0, most, lambda _: None)


def test_every_second_recording_of_a_source_is_learnt_from_and_the_others_are_tested():
    found = selected(source("abc"), source("de"))
    assert found.names == ["a", "c", "d"]
    assert [len(x) for x in found.learnt] == [2] * 8 * 3  # two cars; 12 s, a window of 5 s each second
    assert [(w.recording.name, w.steps) for w in found.tested] == [("b", 50)] * 2 + [("e", 50)] * 2


def test_an_encoder_is_tested_on_what_it_does_not_know():
    found = selected(source("abc"), known=("a", "b"))
    assert found.names == found.learnt == []
    assert {w.recording.name for w in found.tested} == {"c"}


def test_windows_are_spread_over_all_recordings_and_times(monkeypatch):
    found = selected(source("abcd", samples=501), known=(), most=7)
    assert len(found.tested) == 7
    assert [w.recording.name for w in found.tested] == ["a", "a", "b", "c", "c", "d", "d"]
    monkeypatch.setattr(selection, "TRAINING_WINDOWS", 4)
    long = selected(source("ab", samples=401))
    assert len(long.learnt) == 4  # of 40 s, every tenth one: the last begins at 30 s
    assert np.isfinite(long.learnt[-1].numpy()).all()


def test_one_recording_is_in_memory_at_a_time():
    held = []
    found = selected(source("abcd", held=held))
    assert len(held) == 4 and not any(other() for other in held)
    assert found.learnt and found.tested
