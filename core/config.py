"""Configurations: frozen dataclasses to and from plain dictionaries (JSON, TOML), unknown keys refused."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from .errors import InvalidArgument, InvalidType

Config = TypeVar("Config")


def nearest(unknown: Iterable[str], known: Iterable[str]) -> str:
    """`` (did you mean ...?)`` for names that are almost known ones, else nothing.

    Example:
        >>> nearest(["step"], ["seed", "steps"])
        ' (did you mean steps?)'
        >>> nearest(["zzz"], ["seed", "steps"])
        ''
    """
    choices = list(known)
    near = [match for name in unknown for match in difflib.get_close_matches(name, choices, n=1)]
    return f" (did you mean {', '.join(near)}?)" if near else ""


def check_keys(given: Iterable[str], known: Iterable[str], *, caller: str, what: str = "keys") -> None:
    """Refuse names that are not among the known ones.

    Args:
        given: names to check.
        known: all names there are, in the order to list them.
        caller: begins the message.
        what: the names' name in the message.

    Raises:
        ValueError: a name is unknown; the message suggests the nearest known one and lists all.

    Example:
        >>> check_keys(["step"], ["seed", "steps"], caller="Run")  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        InvalidArgument: Run: unknown keys ['step'] (did you mean steps?); known: seed, steps
    """
    choices = list(known)
    unknown = sorted({str(name) for name in given} - set(choices))
    if unknown:
        raise InvalidArgument(
            f"{caller}: unknown {what} {unknown}{nearest(unknown, choices)}; known: {', '.join(choices)}"
        )


def to_dict(config: Any) -> dict[str, Any]:
    """Convert a dataclass to a dictionary as JSON has it: tuples become lists, nested dataclasses dictionaries.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Run:
        ...     steps: int = 10
        ...     widths: tuple[int, ...] = (8, 16)
        >>> to_dict(Run())
        {'steps': 10, 'widths': [8, 16]}
    """
    plain: dict[str, Any] = _plain(dataclasses.asdict(config))
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def from_dict(
    cls: type[Config],
    values: Mapping[str, Any],
    *,
    caller: str | None = None,
    what: str = "keys",
    nested: Mapping[str, Callable[[Any], Any]] | None = None,
) -> Config:
    """Build a dataclass from plain keys and values, as :func:`to_dict`, JSON or TOML has them.

    Lists become tuples where the field is one, and whole numbers floats. The class checks the values' ranges itself.

    Args:
        cls: the dataclass.
        values: its fields; those that are absent take their defaults.
        caller: begins the message of an error; the class's name if None.
        what: the fields' name in the message about unknown ones.
        nested: field to the function that makes its value, for fields that are dataclasses themselves.

    Raises:
        ValueError: ``values`` is not a mapping, a key is unknown or missing, or a value is of the wrong type.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Run:
        ...     steps: int = 10
        ...     widths: tuple[int, ...] = (8, 16)
        >>> from_dict(Run, {"widths": [4]})
        Run(steps=10, widths=(4,))
        >>> from_dict(Run, {"steps": "many"})  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        InvalidArgument: Run: steps must be int, got 'many'
    """
    name = cls.__name__ if caller is None else caller
    if not isinstance(values, Mapping):
        raise InvalidArgument(f"{name}: must be a table of keys and values, got {values!r:.80}")
    fields = {item.name: item for item in dataclasses.fields(cls)}  # type: ignore[arg-type]
    check_keys(values, fields, caller=name, what=what)
    absent = [
        key
        for key, item in fields.items()
        if item.default is item.default_factory is dataclasses.MISSING and key not in values
    ]
    if absent:
        raise InvalidArgument(f"{name}: {what} {absent} are missing")
    hints = typing.get_type_hints(cls)
    made: dict[str, Any] = {}
    for key, value in values.items():
        if nested is not None and key in nested:
            made[key] = nested[key](value)
            continue
        made[key] = _converted(value, hints[key])
        if made[key] is _MISFIT:
            raise InvalidArgument(f"{name}: {key} must be {_in_words(hints[key])}, got {value!r:.80}")
    return cls(**made)


_MISFIT = object()


def _converted(value: Any, hint: Any) -> Any:
    """The value as the type has it, or ``_MISFIT``; types that are not plain data fit whatever is given."""
    kind, arguments = typing.get_origin(hint) or hint, typing.get_args(hint)
    if kind in (typing.Union, types.UnionType):
        tried = (_converted(value, each) for each in arguments)
        return next((each for each in tried if each is not _MISFIT), _MISFIT)
    if kind is typing.Literal:
        return value if type(value) in {type(each) for each in arguments} else _MISFIT  # the class lists the choices
    if kind is tuple:
        return _converted_tuple(value, arguments)
    if kind is float and type(value) is int:
        return float(value)
    if kind in (bool, int, float, str, dict, list, type(None)):
        return value if isinstance(value, kind) and isinstance(value, bool) == (kind is bool) else _MISFIT
    return value


def _converted_tuple(value: Any, arguments: tuple[Any, ...]) -> Any:
    if not isinstance(value, (list, tuple)):
        return _MISFIT
    each = arguments[:1] * len(value) if arguments[-1:] == (...,) else arguments
    if len(each) != len(value):
        return tuple(value)  # the class says how many there must be
    made = tuple(_converted(entry, hint) for entry, hint in zip(value, each))
    return _MISFIT if _MISFIT in made else made


def _in_words(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint).replace("typing.", "")


def override(config: Config, changes: Mapping[str, Any], *, caller: str, what: str = "settings") -> Config:
    """Replace single fields of a dataclass that a caller gave as keyword arguments.

    Raises:
        TypeError: a field is unknown; the message suggests the nearest known one and lists all.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Run:
        ...     steps: int = 10
        >>> override(Run(), {"steps": 3}, caller="train")
        Run(steps=3)
        >>> override(Run(), {"step": 3}, caller="train")  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        InvalidType: train: unknown settings ['step'] (did you mean steps?); known: steps
    """
    try:
        check_keys(changes, [item.name for item in dataclasses.fields(config)], caller=caller, what=what)  # type: ignore[arg-type]
    except ValueError as error:
        raise InvalidType(str(error)) from None
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]
