"""Rows that test nothing: their method changed nothing, or one of its losses was never above 0."""

from __future__ import annotations

from collections.abc import Iterable

from .tables import REFERENCE, Cell

AS_FITTED = ("fitted", "photo-doubt", "scratch")  # rows whose field is the fitted one


def idle_lines(cells: Iterable[Cell]) -> list[str]:
    """A line for every method that did not do what its row is there to test; rows that do not say are left out.

    A method that trains must change the field on every scene and use all its losses; one that removes or filters may
    find nothing to remove on a scene, but not on all.
    """
    lines, largest = [], dict[str, float]()
    for cell in cells:
        name = cell["method"]
        if "@" in name or cell.get("changed_share") is None or name in (*AS_FITTED, REFERENCE):
            continue
        where = f"{name} on {cell['scene']}, seed {cell['seed']}"
        if cell.get("idle"):
            lines.append(f"tests nothing: {where}: {', '.join(cell['idle'])} was 0 at every step")
        if not cell["changed_share"] and cell.get("trained_steps"):
            lines.append(f"tests nothing: {where}: no weight of the field changed")
        if not cell.get("trained_steps"):
            largest[name] = max(largest.get(name, 0.0), cell["changed_share"])
    return [
        *lines,
        *(f"tests nothing: {name} changed no cell on any scene" for name, share in largest.items() if not share),
    ]
