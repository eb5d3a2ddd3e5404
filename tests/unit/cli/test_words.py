"""Words of a command line: SUMO's options among ours, mistyped ones, numbers and defaults."""

from __future__ import annotations

import argparse

import pytest

from phase_sumo.cli import main
from phase_sumo.cli.commands import drive_options, scenario_of, seeds_of
from phase_sumo.cli.parser import make_parser
from phase_sumo.cli.words import CommandParser
from phase_sumo.errors import PhaseError


def parsed(*words: str) -> argparse.Namespace:
    return make_parser().parse_args(list(words))


def test_sumos_habits():
    words = "-c x.sumocfg -b 0 -e 1:00:00 --seed 3 --fcd-output f.xml --no-warnings --scale=2 -W true"
    args = parsed("run", *words.split())
    assert scenario_of(args) == "x.sumocfg"
    options = drive_options(args)
    assert (options.end, options.seed) == (3600.0, 3)
    expected = "-b 0 --fcd-output f.xml --no-warnings --scale=2 -W true"
    assert options.sumo_options == tuple(expected.split())


def test_a_flag_of_sumos_does_not_eat_the_scenario():
    args = parsed("run", "--fcd-output", "f.xml", "--no-warnings", "x.sumocfg", "--share", "0.5")
    assert (args.cfg, args.share) == ("x.sumocfg", 0.5)
    assert args.sumo_options == ["--fcd-output", "f.xml", "--no-warnings"]


def test_a_network_and_routes_do_without_a_scenario_file():
    args = parsed("run", "-n", "a.net.xml", "-r", "b.rou.xml", "-a", "c.add.xml")
    assert scenario_of(args) is None
    for words, message in (
        (["run"], "no scenario"),
        (["run", "a.sumocfg", "-c", "b.sumocfg"], "two scenarios"),
    ):
        with pytest.raises(PhaseError, match=message):
            scenario_of(parsed(*words))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["run", "x.sumocfg", "--fdc-output", "f"], ["phase-sumo run", "--fdc-output", "--fcd-output"]),
        (["run", "x.sumocfg", "--shar", "0.5"], ["--shar;", "--share"]),
        (["train", "--networks", "x", "--run", "y", "--step", "5"], ["usage: phase-sumo train", "--steps"]),
        (["evaluate", "--scenarios", "x", "--fcd-output", "f"], ["usage: phase-sumo evaluate", "no option"]),
        (["train", "--networks", "x", "--run", "y", "--", "--scale", "2"], ["--scale 2: options of SUMO"]),
        (["train", "--networks", "x", "--run", "y", "--steps", "1.5"], ["1.5", "whole number"]),
    ],
)  # fmt: skip
def test_mistyped_options_get_the_usage_of_their_command_and_the_nearest_names(words, told, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    text = " ".join(capsys.readouterr().err.split())
    for part in told:
        assert part in text


def test_numbers_as_people_write_them():
    args = parsed(
        "train", "--networks", "x", "--run", "y", "--steps", "4e5", "--set", "reward.collision=2", "a=1"
    )
    assert (args.steps, args.set) == (400_000, ["reward.collision=2", "a=1"])
    assert seeds_of(parsed("compare", "x", "--out", "o", "--seeds", "3", "1", "2").seeds, 1) == [3, 1, 2]
    assert seeds_of([3], 5) == [5, 6, 7]


def test_every_option_tells_its_default():
    (subparsers,) = [a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)]
    assert len(subparsers.choices) > 10
    for name, sub in subparsers.choices.items():
        assert isinstance(sub, CommandParser)
        text = " ".join(sub.format_help().split())
        assert "default: None" not in text and "default: False" not in text, name
        for action in sub._actions:
            given = action.default not in (None, False, [], argparse.SUPPRESS) and action.option_strings
            assert not given or action.required or f"default: {_shown(action.default)}" in text, action
            optional = action.option_strings and action.default in (None, []) and not action.required
            silent = ("--json", "--help", "--configuration-file", "--held-out", "--start-from", "--cfg")
            if optional and not set(silent) & set(action.option_strings):
                assert any(w in (action.help or "") for w in ("left out", "without", "in any case")), action


def _shown(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
