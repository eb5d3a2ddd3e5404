"""Single settings of a training, as the command line writes them."""

from __future__ import annotations

import ast
import dataclasses
import typing
from collections.abc import Sequence
from typing import Any, TypeVar

from phase_sumo.config import restore
from phase_sumo.errors import PhaseError, nearest

C = TypeVar("C")


def with_settings(config: C, settings: Sequence[str]) -> C:
    """A config with ``"reward.collision=2"`` and the like in it.

    Raises:
        PhaseError: there is no such setting, or the value is of another kind.
    """
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise PhaseError(f"--set {setting}: write KEY=VALUE, e.g. reward.collision=2")
        config = _with(config, key, text, key)
    return config


def _with(config: Any, key: str, text: str, whole: str) -> Any:
    name, _, rest = key.partition(".")
    names = [field.name for field in dataclasses.fields(config)]
    if name not in names:
        raise PhaseError(
            f"--set {whole}: {type(config).__name__} has no setting {name!r}{nearest(name, names)}; "
            f"it has {', '.join(names)}"
        )
    before = getattr(config, name)
    if dataclasses.is_dataclass(before) != bool(rest):
        example = f"{whole}.NAME=VALUE" if not rest else f"{whole.removesuffix('.' + rest)}=VALUE"
        raise PhaseError(f"--set {whole}: write {example}")
    value = _with(before, rest, text, whole) if rest else _value(config, name, before, text, whole)
    return dataclasses.replace(config, **{name: value})


def _value(config: Any, name: str, before: Any, text: str, whole: str) -> Any:
    """The text as a value of the setting's kind; whole numbers may be written ``4e5``."""
    try:
        value = ast.literal_eval({"true": "True", "false": "False"}.get(text.lower(), text))
    except (ValueError, SyntaxError):
        value = text
    if isinstance(before, float) and type(value) is int:
        value = float(value)
    if type(before) is int and isinstance(value, float) and value == int(value):
        value = int(value)
    if type(value) is not type(before):
        raise PhaseError(f"--set {whole}={text}: expected {type(before).__name__}, as in {before!r}")
    return restore(typing.get_type_hints(type(config))[name], value)
