"""Command-line options from configuration dataclasses: one option per field, which wins over the field's default."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Collection, Sequence
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


ALIASES = {"minimum_views": "min_views", "keep_boxes": "keep_box"}  # arguments that a verb offers by another name


def option_names(verb: Callable[..., Any]) -> set[str]:
    """The options of a verb by their names in Python: its parameters that are not positional, and their fields.

    Example:
        >>> def verb(source: Positional[str], min_views: int = 1) -> None: ...
        >>> option_names(verb)
        {'min_views'}
    """
    names: set[str] = set()
    for name, parameter in inspect.signature(verb).parameters.items():
        if dataclasses.is_dataclass(parameter.default):
            names |= {item.name for item in dataclasses.fields(parameter.default)}
        elif not str(parameter.annotation).startswith("Positional"):
            names.add(name)
    return names


def in_options(message: str, names: Collection[str]) -> str:
    """An error message of the library with its arguments written as the options of a verb.

    Rewritten are ``name='value'``, "see name", "name must be", and every name of two words or more. A hint in brackets
    that begins with ``name='value'`` goes where the verb has no such option.

    Args:
        message: one line.
        names: of options, as :func:`option_names` gives them.

    Example:
        >>> in_options("3 photos are gone (missing='drop' leaves them out)", {"missing"})
        '3 photos are gone (--missing drop leaves them out)'
        >>> in_options("load: downscale must be >= 1 for the best downscale", {"downscale"})
        'load: --downscale must be >= 1 for the best downscale'
    """
    message = re.sub(
        r" \(([a-z_]+)='[^']*'[^()]*\)", lambda each: each[0] if each[1] in (*names, *ALIASES) else "", message
    )
    typed = {name: name for name in names} | {name: to for name, to in ALIASES.items() if to in names}
    if not typed:
        return message
    listed = "|".join(sorted(map(re.escape, typed), key=len, reverse=True))
    before, after = r"(?<![\w.\-/'\"])", r"(?![\w\-/'\"]|\.\w)"

    def option(name: str) -> str:
        return "--" + typed[name].replace("_", "-")

    def assigned(match: re.Match[str]) -> str:
        name, value = match[1], match[2].strip("'\"")
        if value in ("True", "False"):
            return option(name) if value == "True" else option(name).replace("--", "--no-", 1)
        return f"{option(name)} {value}"

    def ruled(match: re.Match[str]) -> str:
        return re.sub(f"{before}({listed}){after}", lambda each: option(each[1]), match[0])

    message = re.sub(f"{before}({listed})=('[^']*'|\"[^\"]*\"|[\\w.+-]+)", assigned, message)
    message = re.sub(r"(?:^|(?<=: ))[\w, ]*?(?= (?:must (?:be|lie|name|end)|names no|needs)\b)", ruled, message)
    message = re.sub(rf"(?<=\bsee )({listed}){after}", lambda each: option(each[1]), message)
    long = "|".join(sorted((re.escape(name) for name in typed if "_" in name), key=len, reverse=True))
    return re.sub(f"{before}({long}){after}", lambda each: option(each[1]), message) if long else message
