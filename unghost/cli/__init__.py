"""The command ``unghost``: one verb each."""

from __future__ import annotations

from .entry import main as main

__all__ = ["main"]
