"""One look for long work: a bar with the time left in a terminal; in a log, a line now and then."""

from __future__ import annotations

import sys
from typing import Any, Protocol, TextIO

SECONDS_BETWEEN_LINES = 30.0  # in a log


class Bar(Protocol):
    """What a progress bar can do (``tqdm``'s)."""

    n: float
    total: float | None

    def update(self, n: float = 1) -> bool | None:
        """Count ``n`` more units."""

    def set_postfix_str(self, s: str = "", refresh: bool = True) -> None:
        """Show a few words after the figures."""

    def close(self) -> None:
        """End the bar."""


class _Lines:
    """A stream that writes each state of a bar as a line of its own, without the control characters."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> None:
        words = text.strip("\r\n ")
        if words:
            self.stream.write(words + "\n")

    def flush(self) -> None:
        self.stream.flush()


def progress_bar(
    total: float | None, *, unit: str, describe: str = "", shown: bool = True, leave: bool = True, **options: Any
) -> Any:
    """A bar on the standard error with the time left; where that is no terminal, a line each half minute.

    Args:
        total: of units; None if unknown.
        unit: what is counted.
        describe: begins the line.
        shown: whether to show it at all.
        leave: whether the full bar stays.
        options: others of ``tqdm`` (https://tqdm.github.io), such as ``initial``.

    Returns:
        The bar, also a context manager: ``update(units)``, ``set_postfix_str(text, refresh=False)``, ``close()``.

    Example:
        >>> with progress_bar(3, unit="cube", shown=False) as bar:
        ...     bar.update(3)
    """
    from tqdm import tqdm

    if sys.stderr.isatty():
        look: dict[str, Any] = {"file": sys.stderr, "dynamic_ncols": True, "leave": leave}
    else:
        look = {"file": _Lines(sys.stderr), "ncols": 100, "leave": True, "ascii": True}
        look |= dict.fromkeys(("mininterval", "maxinterval", "delay"), SECONDS_BETWEEN_LINES)
    return tqdm(total=total, unit=unit, desc=describe or None, disable=not shown, **look, **options)


class StagedProgress:
    """Bars of work that reports ``(done, total)`` itself: a new one when the stage changes or the count starts again.

    A bar ends when all is done, or with the ``with`` block.

    Args:
        unit: what is counted.
        leave: whether full bars stay.

    Example:
        >>> with StagedProgress("window") as progress:
        ...     progress(1, 2)
        ...     progress(2, 2)
    """

    def __init__(self, unit: str, *, leave: bool = False) -> None:
        self.unit, self.leave = unit, leave
        self.bar: Bar | None = None
        self.stage = ""

    def __call__(self, done: int, total: int, *, stage: str = "", unit: str | None = None) -> None:
        """Show that ``done`` of ``total`` units of ``stage`` are done."""
        if self.bar is None or stage != self.stage or done < self.bar.n:
            self.close()
            self.bar = progress_bar(total, unit=unit or self.unit, describe=stage, leave=self.leave)
            self.stage = stage
        self.bar.total = total
        self.bar.update(done - self.bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        """End the bar that is shown, if any."""
        if self.bar is not None:
            self.bar.close()
            self.bar = None

    def __enter__(self) -> StagedProgress:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
