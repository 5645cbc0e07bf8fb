"""Did a method do anything? What it changed of the field, and which of its losses were never above 0."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from .cells import cell_places
from .methods import AS_FITTED
from .tables import REFERENCE, Cell

AT_ONCE = 1 << 18


def changed_share(field: Any, base: Any) -> float:
    """Share of the base's weights, or if those are the same of the cells of its box, that differ in the field.

    Args:
        field: what a method made of it: trained further, or filtered.
        base: the field as it was fitted.
    """
    if field is base:
        return 0.0
    inner = getattr(field, "field", field)  # of a filtered field
    before, after = ([*each.state_dict().values()] for each in (base, inner))
    if any(one.shape != other.shape for one, other in zip(before, after)):
        return 1.0
    changed, count = sum(int((one != other).sum()) for one, other in zip(before, after)), sum(map(torch.numel, before))
    if changed or inner is field:
        return changed / count
    places, differs = cell_places(base).reshape(-1, 3), 0
    for start in range(0, len(places), AT_ONCE):
        part = torch.from_numpy(places[start : start + AT_ONCE])
        differs += int((_density(field, part) != _density(base, part)).sum())
    return differs / len(places)


def _density(field: Any, places: Tensor) -> Tensor:
    with torch.no_grad():
        found: Tensor = field.density_fn(places)[..., 0]
    return found


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
