"""What ``clean`` decided: a grid of cells to keep, to preview, apply, save and undo. numpy only."""

from __future__ import annotations

import dataclasses
import json
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.aabb import as_aabb
from ..core.arrays import is_tensor, to_numpy
from ..core.errors import InvalidArgument, InvalidFile
from ..core.file_kinds import KEEP_MASK, file_kind
from ..core.io import write_npz
from ..core.lattice import cells_within, lattice_axes, lattice_origin, look_up_cells
from ..core.occupancy import check_density_shape

FORMAT = "unghost-keep-mask"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class KeepMask:
    """Cubic cells over a box; the lattice is centred on the box and may stick out by less than a cell.

    Attributes:
        aabb: ``(2, 3)`` scene units; what lies outside is never changed.
        pitch: side of a cell, scene units.
        cells: ``(X, Y, Z)`` bool, True to keep.
        details: JSON-able: ``occupied``, ``removed``, ``faint_removed`` and ``dropped`` cells, positions ``asked``,
            ``windows`` sent, ``regions`` removed (largest first: ``voxels, volume, box, confidence``),
            ``region_count``, ``settings``.

    Example:
        >>> cells = np.ones((2, 2, 2), dtype=bool)
        >>> cells[0, 0, 0] = False
        >>> mask = KeepMask(np.array([[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]]), 1.0, cells)
        >>> mask.keep(np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [9.0, 0.0, 0.0]])).tolist()  # the last lies outside
        [False, True, True]
    """

    aabb: NDArray[np.float64]
    pitch: float
    cells: NDArray[np.bool_]
    details: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "aabb", as_aabb(self.aabb, caller="KeepMask"))
        if not (np.isfinite(self.pitch) and self.pitch > 0):
            raise InvalidArgument(f"KeepMask: pitch must be finite and > 0, got {self.pitch}")
        sides = self.aabb[1] - self.aabb[0]
        covered = np.array(self.cells.shape[:3]) * self.pitch
        if self.cells.ndim != 3 or self.cells.dtype != np.bool_ or (covered < sides * (1 - 1e-5)).any():
            raise InvalidArgument(
                f"KeepMask: cells must be bool (X, Y, Z) and cover the box, got {self.cells.dtype} "
                f"{self.cells.shape} of side {self.pitch} for sides {sides.tolist()}"
            )

    @property
    def origin(self) -> NDArray[np.float64]:
        """``(3,)`` lowest corner of the lattice."""
        return lattice_origin(self.aabb, self.pitch, self.cells.shape)

    def keep(self, positions: Any) -> Any:
        """Whether each of ``positions (..., 3)`` is kept: bool ``(...)``, an array or a tensor like the input.

        True outside the box, and for positions that are not finite.
        """
        if is_tensor(positions):
            import torch

            kept = self._keep(to_numpy(positions.detach().float()).astype(np.float64))
            return torch.as_tensor(kept, device=positions.device)
        return self._keep(np.asarray(positions, dtype=np.float64))

    def _keep(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        if positions.shape[-1:] != (3,):
            raise InvalidArgument(f"KeepMask.keep: positions must have shape (..., 3), got {positions.shape}")
        return look_up_cells(self.cells, positions, aabb=self.aabb, pitch=self.pitch, outside=True)

    def apply(self, density_fn: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """The cleaned field: ``density_fn`` with its density set to 0 in cells that are not kept.

        It takes and gives what ``density_fn`` does, arrays or tensors; gradients pass where density is kept.
        """

        def cleaned(positions: Any) -> Any:
            density = density_fn(positions)
            flat = check_density_shape(density, positions, caller="KeepMask.apply")
            kept = self.keep(positions)
            if density.ndim > flat.ndim:
                kept = kept[..., None]
            if is_tensor(density):
                import torch

                kept = torch.as_tensor(kept, device=density.device)
                return torch.where(kept, density, torch.zeros_like(density))
            return np.where(to_numpy(kept), density, np.zeros_like(density))

        return cleaned

    def apply_grid(self, values: NDArray[Any]) -> NDArray[Any]:
        """A copy of a grid ``(X, Y, Z, ...)`` over the aabb, of any resolution, with 0 in cells not kept.

        Cell-centred; a cell is judged by its centre.
        """
        if values.ndim < 3 or 0 in values.shape[:3]:
            raise InvalidArgument(f"KeepMask.apply_grid: values must have shape (X, Y, Z, ...), got {values.shape}")
        axes = [
            low + (np.arange(length) + 0.5) * (high - low) / length
            for low, high, length in zip(self.aabb[0], self.aabb[1], values.shape)
        ]
        kept = np.empty(values.shape[:3], dtype=bool)
        for row, x in enumerate(axes[0]):  # a slab at a time: positions take 24 bytes a cell
            kept[row] = self._keep(np.stack(np.meshgrid([x], axes[1], axes[2], indexing="ij"), axis=-1)[0])
        result: NDArray[Any] = np.where(kept.reshape(kept.shape + (1,) * (values.ndim - 3)), values, 0)
        return result.astype(values.dtype, copy=False)

    def restored(self, boxes: Sequence[ArrayLike]) -> KeepMask:
        """The same mask with all that was removed in some boxes kept again (undo, piece by piece).

        Args:
            boxes: ``(2, 3)`` each, scene units: those of ``summary()["regions"]``, say. A cell belongs to a box that
                holds its centre. They are added to ``details["restored"]``; the other details stay as they were.
        """
        if not len(boxes):
            return self
        chosen = [as_aabb(box, caller="KeepMask.restored: boxes") for box in boxes]
        cells = self.cells.copy()
        for box in chosen:
            cells |= cells_within(lattice_axes(self.aabb, self.pitch, cells.shape), box)
        before = self.details.get("restored", [])
        return dataclasses.replace(
            self, cells=cells, details={**self.details, "restored": [*before, *(box.tolist() for box in chosen)]}
        )

    def summary(self) -> dict[str, Any]:
        """Counts, ``removed_share`` of the occupied cells (0 if there are none), and the removed regions."""
        occupied, removed = self.details.get("occupied", 0), self.details.get("removed", 0)
        return {**self.details, "removed_share": removed / occupied if occupied else 0.0}

    def save(self, path: str | Path) -> None:
        """Write ``.npz`` without pickles: ``manifest`` (JSON) and ``cells`` (bits, C order); whole or not at all."""
        manifest = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "aabb": self.aabb.tolist(),
            "pitch": self.pitch,
            "shape": list(self.cells.shape),
            "details": self.details,
        }
        text = np.frombuffer(json.dumps(manifest, allow_nan=False).encode(), dtype=np.uint8)
        write_npz(path, parents=False, manifest=text, cells=np.packbits(self.cells))

    @classmethod
    def load(cls, path: str | Path) -> KeepMask:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a foreign, truncated or inconsistent file; the message names it.
        """
        source = Path(path)
        try:
            with source.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
                manifest, packed = json.loads(archive["manifest"].tobytes().decode()), archive["cells"]
        except FileNotFoundError:
            raise
        except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error):
            kind = file_kind(source, caller="KeepMask.load")
            about = f"it is {kind.name}" if kind is not KEEP_MASK else "an array cannot be read"
            raise InvalidFile(f"KeepMask.load: {source} is not a keep mask, or is truncated ({about})") from None
        if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
            raise InvalidFile(f"KeepMask.load: {source} is not a keep mask (format must be {FORMAT!r})")
        if manifest.get("format_version") != FORMAT_VERSION:
            raise InvalidFile(
                f"KeepMask.load: {source} has version {manifest.get('format_version')!r}, "
                f"this release reads {FORMAT_VERSION}"
            )
        try:
            shape = tuple(int(length) for length in manifest["shape"])
            count = int(np.prod(shape))
            if min(shape) < 1 or packed.dtype != np.uint8 or packed.shape != (-(-count // 8),):
                raise InvalidFile(f"cells do not fit shape {shape}")
            cells = np.unpackbits(packed, count=count).reshape(shape).astype(bool)
            return cls(np.array(manifest["aabb"]), float(manifest["pitch"]), cells, dict(manifest["details"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidFile(f"KeepMask.load: {source}: {error}") from None
