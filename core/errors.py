"""Errors that a user can cause and mend: each is also the built-in kind that a caller would catch.

The command line shows an :class:`UnghostError` as one line; anything else is a bug of ours and shows its traceback.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class UnghostError(Exception):
    """Base class of every deliberate error of this package.

    Example:
        >>> issubclass(InvalidArgument, UnghostError), issubclass(InvalidArgument, ValueError)
        (True, True)
    """


class InvalidArgument(UnghostError, ValueError):
    """An argument or setting has a value that it must not have."""


class InvalidType(UnghostError, TypeError):
    """An argument is of a type that it must not have, or is not among those that there are."""


class InvalidFile(UnghostError, ValueError):
    """A file or folder cannot be read as what it should be: foreign, truncated, altered or inconsistent."""


class MissingFile(UnghostError, FileNotFoundError):
    """A file or folder that was named does not exist."""


class MissingExtra(UnghostError, ImportError):
    """A package is missing that an extra of the distribution installs; the message names the extra."""


@contextmanager
def needs_extra(extra: str, *, caller: str) -> Iterator[None]:
    """Turn the error of a missing package in the block's imports into a :class:`MissingExtra`.

    Args:
        extra: the extra of the distribution that installs what the block imports.
        caller: begins the message.

    Raises:
        MissingExtra: a package from outside is missing; the message names it and the extra.

    Example:
        >>> with needs_extra("torch", caller="train"):  # doctest: +IGNORE_EXCEPTION_DETAIL
        ...     import absent_package
        Traceback (most recent call last):
        MissingExtra: train: needs absent_package: pip install unghost[torch]
    """
    try:
        yield
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        if isinstance(error, MissingExtra) or missing in ("", __name__.partition(".")[0]):
            raise
        raise MissingExtra(f"{caller}: needs {missing}: pip install unghost[{extra}]", name=error.name) from error
