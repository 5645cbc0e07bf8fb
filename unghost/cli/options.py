"""Command-line options from configuration dataclasses: one option per field, which wins over the field's default."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from tyro.conf import arg


def options_of(config: type[Any], *, leave_out: Sequence[str] = ()) -> type[Any]:
    """Make a dataclass whose fields are those of ``config``, each unset unless it is given on the command line.

    The help of an option is the field's entry in the ``Attributes`` of the docstring of ``config``, and its default.

    Args:
        config: a frozen dataclass with a default for every field that is not left out.
        leave_out: fields that a command sets in another way.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Config:
        ...     steps: int = 100
        ...     quiet: bool = False
        >>> made = options_of(Config)
        >>> given(made()), given(made(steps=3, quiet=True))
        ({}, {'steps': 3, 'quiet': True})
    """
    hints = get_type_hints(config, include_extras=True)
    fields: list[tuple[str, Any, Any]] = []
    for item in dataclasses.fields(config):
        if item.name in leave_out:
            continue
        default = item.default if item.default_factory is dataclasses.MISSING else item.default_factory()
        if hints[item.name] is bool and default is False:
            fields.append((item.name, bool, False))
            continue
        about = arg(metavar=_metavar(hints[item.name]), help_behavior_hint=f"(default: {_shown(default)})")
        fields.append((item.name, Annotated[hints[item.name] | None, about], None))
    made = dataclasses.make_dataclass(f"{config.__name__}Options", fields, frozen=True)
    made.__doc__ = re.sub(
        r":\w+:`[~.\w]*?(\w+)`|``(.*?)``", r"\1\2", config.__doc__ or ""
    )  # a terminal shows no markup
    return made


def given(options: Any) -> dict[str, Any]:
    """Name to value of the options that were given."""
    values = {item.name: getattr(options, item.name) for item in dataclasses.fields(options)}
    return {name: value for name, value in values.items() if value is not None and value is not False}


def _shown(value: Any) -> str:
    """A default as it would be typed."""
    if isinstance(value, (tuple, list)):
        return " ".join(map(str, value)) or "none"
    return "none" if value is None or value == "" else str(value)


def _metavar(hint: Any) -> str:
    """What stands for the value in the help."""
    parts = [part for part in get_args(hint) if part is not type(None)]
    origin = get_origin(hint)
    if origin is tuple:
        inner = [part for part in parts if part is not Ellipsis]
        return " ".join(map(_metavar, inner)) + (" ..." if Ellipsis in parts else "")
    if isinstance(hint, type):
        return hint.__name__.upper()
    if parts and all(isinstance(part, str) for part in parts):  # a Literal
        return "{" + ",".join(parts) + "}"
    return "|".join(map(_metavar, parts)) if parts else str(hint)
