"""What a method changed of a field."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .cells import cell_places

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
