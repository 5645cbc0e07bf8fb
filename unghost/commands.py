"""What each verb of ``unghost`` does. Signatures are the command line; heavy imports wait for the verb."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any


def demo(out: Path = Path("out/demo"), seed: int = 0) -> None:
    """Clean a synthetic room whose ghosts are known; writes a page to look at and result.json.

    Args:
        out: folder for index.html, result.json and the pictures.
        seed: of the room and its ghosts.
    """
    from .demo import run_demo, summary_table

    results = run_demo(out, seed=seed)
    print(summary_table(results))
    print(f"look at {out / 'index.html'}")


VERBS: dict[str, Callable[..., Any]] = {"demo": demo}
