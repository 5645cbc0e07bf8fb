"""Lazy attributes of a package: a public name is imported when it is first used (PEP 562)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from .errors import MissingExtra


def attach(
    package: str, homes: Mapping[str, Sequence[str]], *, extras: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make ``__getattr__``, ``__dir__`` and ``__all__`` of a package whose public names live in its modules.

    Args:
        package: ``__name__`` of the package.
        homes: relative module to the public names that it defines, ``{".keep_mask": ["KeepMask"]}``.
        extras: relative module to the extra of the distribution that it needs; an ``ImportError`` then names it.

    Returns:
        ``(__getattr__, __dir__, __all__)``, to be assigned in the package's ``__init__``. Its ``TYPE_CHECKING`` block
        repeats the names for type checkers and editors.

    Example:
        >>> get, names, public = attach("unghost.core", {".aabb": ["as_aabb", "contains"]})
        >>> get("as_aabb").__name__
        'as_aabb'
        >>> public
        ['as_aabb', 'contains']
    """
    home_of = {name: module for module, names in homes.items() for name in names}

    def get(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = home_of[name]
        try:
            value = getattr(import_module(home, package), name)
        except ImportError as error:
            missing = (error.name or "").partition(".")[0]
            if home not in (extras or {}) or missing in ("", "unghost"):
                raise
            needed = f"pip install unghost[{(extras or {})[home]}]"
            raise MissingExtra(f"{package}.{name} needs {missing}: {needed}", name=error.name) from error
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *home_of})

    return get, names, sorted(home_of)
