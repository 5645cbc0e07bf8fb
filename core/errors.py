"""Errors that a user can cause and mend: each is also the built-in kind that a caller would catch.

The command line shows an :class:`UnghostError` as one line; anything else is a bug of ours and shows its traceback.
"""

from __future__ import annotations


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
