"""The cells of a field's box."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from unghost.core.lattice import lattice_axes


def cell_places(field: Any) -> NDArray[np.float32]:
    """Centres of the cells of a field's box ``(X, Y, Z, 3)``."""
    box, pitch = field.aabb, field.field_pitch
    counts = np.ceil((box[1] - box[0]) / pitch - 1e-4).astype(int)
    axes = lattice_axes(box, pitch, tuple(counts))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
