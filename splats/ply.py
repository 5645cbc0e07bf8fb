"""The ``.ply`` of 3D (and 2D) Gaussian splatting, read and written back byte for byte. numpy only.

Written here, because ``unghost clean`` reads splats on the base install, which has no ``plyfile``, and because rows
stay on the disk until they are read: a file of 500,000 splats (124 MB) opens in 1 ms.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InvalidArgument, InvalidFile
from ..core.file_kinds import SPLATS, file_kind, not_readable
from ..core.io import atomic_file
from ..core.ply import MOST_HEADER, Element, parse_header

MOST_EXTENT = 1e30
_NEEDED = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
KEEP_SCORE = "keep_score"


def _no_bytes() -> NDArray[np.uint8]:
    return np.zeros(0, np.uint8)


@dataclass(frozen=True)
class SplatPly:
    """The rows of a splat file, as they lie there.

    Attributes:
        rows: ``(N,)`` structured, memory-mapped, one field a property of the element ``vertex``.
        header: the lines of its header, without the line's end.
        before: bytes of the elements that stand before ``vertex``.
        after: bytes of those behind it, memory-mapped.
        others: those elements.
    """

    rows: NDArray[np.void]
    header: tuple[str, ...]
    before: NDArray[np.uint8] = field(default_factory=_no_bytes)
    after: NDArray[np.uint8] = field(default_factory=_no_bytes)
    others: tuple[Element, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def columns(self, *names: str) -> NDArray[np.float64]:
        """``(N, len(names))`` of the raw values (logarithms of the extents, logits of the opacity)."""
        return np.stack([self.rows[name].astype(np.float64) for name in names], axis=1)

    def gaussians(self) -> Gaussians:
        """Activated as the renderers do: exponential, sigmoid, normalised quaternion (w, x, y, z).

        A file of 2D Gaussians (``scale_0`` and ``scale_1`` alone) has discs: their third extent is 0.
        """
        means = self.columns("x", "y", "z")
        extents = np.zeros((len(self), 3))
        with np.errstate(over="ignore"):
            for axis, name in enumerate(("scale_0", "scale_1", "scale_2")):
                if name in (self.rows.dtype.names or ()):
                    extents[:, axis] = np.exp(self.columns(name)[:, 0])
        quaternions = self.columns("rot_0", "rot_1", "rot_2", "rot_3")
        return Gaussians.create(means, extents, quaternions, self.columns("opacity")[:, 0])


@dataclass(frozen=True)
class Gaussians:
    """``N`` Gaussians.

    Attributes:
        means: ``(N, 3)``, scene units.
        extents: ``(N, 3)`` standard deviations along their own axes, scene units, >= 0 (0: a disc, a needle, a point).
        rotations: ``(N, 3, 3)``, columns are their own axes.
        logits: ``(N,)``, of the opacity; infinity is opaque, minus infinity transparent.

    Example:
        >>> gaussians = Gaussians(np.zeros((1, 3)), np.full((1, 3), 0.1), np.eye(3)[None], np.zeros(1))
        >>> gaussians.opacity().tolist(), gaussians.valid.tolist()
        ([0.5], [True])
    """

    means: NDArray[np.float64]
    extents: NDArray[np.float64]
    rotations: NDArray[np.float64]
    logits: NDArray[np.float64]

    @classmethod
    def create(cls, means: ArrayLike, extents: ArrayLike, quaternions: ArrayLike, logits: ArrayLike) -> Gaussians:
        """Check the shapes and turn quaternions into rotations.

        Args:
            means: ``(N, 3)``, scene units.
            extents: ``(N, 3)``, scene units, >= 0.
            quaternions: ``(N, 4)`` w, x, y, z of any length but 0.
            logits: ``(N,)``, of the opacity.

        Values are not refused: :attr:`valid` says which Gaussians can be judged.

        Raises:
            ValueError: shapes that do not fit each other.
        """
        place, sides, turns, logit = (np.asarray(a, dtype=np.float64) for a in (means, extents, quaternions, logits))
        count = len(place)
        if (place.shape, sides.shape, turns.shape, logit.shape) != ((count, 3), (count, 3), (count, 4), (count,)):
            raise InvalidArgument(
                "Gaussians: means, extents, quaternions, logits must have shapes (N, 3), (N, 3), (N, 4), (N,), got "
                f"{place.shape}, {sides.shape}, {turns.shape}, {logit.shape}"
            )
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # 0 / 0 is NaN: not valid
            w, x, y, z = (turns / np.linalg.norm(turns, axis=1)[:, None]).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        return cls(place, sides, np.moveaxis(np.array(rows), -1, 0), logit)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """``(N,)``: which can be judged. Means and rotations are finite, extents in [0, 1e30), logits not NaN."""
        good = np.isfinite(self.means).all(axis=1) & np.isfinite(self.rotations).all(axis=(1, 2))
        good &= ((self.extents >= 0) & (self.extents < MOST_EXTENT)).all(axis=1) & ~np.isnan(self.logits)
        return np.asarray(good)

    def only(self, chosen: NDArray[np.bool_]) -> Gaussians:
        """Those of a mask ``(N,)``; the same object if it is all of them."""
        if chosen.all():
            return self
        parts = (self.means, self.extents, self.rotations, self.logits)
        return Gaussians(*(part[chosen] for part in parts))

    def __len__(self) -> int:
        return len(self.means)

    def opacity(self) -> NDArray[np.float64]:
        """``(N,)`` in [0, 1]; NaN where the logit is."""
        return 1.0 / (1.0 + np.exp(-np.clip(self.logits, -700.0, 700.0)))

    def aabb(self, *, share: float = 0.98) -> NDArray[np.float64]:
        """``(2, 3)``: the box that holds this share of the means along each axis, weighted by opacity.

        A capture's last per cent are splats of the far background; a box around them would be mostly empty. Those
        that are not valid do not count.

        Raises:
            ValueError: an impossible share; no Gaussians, or none that is valid.
        """
        if not 0.0 < share <= 1.0:
            raise InvalidArgument(f"Gaussians.aabb: share must lie in (0, 1], got {share}")
        if len(self) == 0:
            raise InvalidArgument("Gaussians.aabb: there are no Gaussians")
        valid = self.valid
        if not valid.all():
            if not valid.any():
                raise InvalidArgument(f"Gaussians.aabb: not one of {len(self)} Gaussians is finite")
            return self.only(valid).aabb(share=share)
        weight = self.opacity()
        box = np.empty((2, 3))
        for axis in range(3):
            order = np.argsort(self.means[:, axis], kind="stable")
            total = np.cumsum(weight[order])
            ends = np.searchsorted(total, np.array([(1 - share) / 2, (1 + share) / 2]) * total[-1])
            picked = order[np.clip(ends, 0, len(order) - 1)]
            reach = self.extents[picked].max(axis=1)
            box[:, axis] = self.means[picked, axis] + np.array([-1.0, 1.0]) * reach
        return box


def read_splat_ply(path: str | Path) -> SplatPly:
    """Open a splat file; its rows stay on the disk until they are read.

    Elements beside ``vertex`` (Apple's ml-sharp and gsbox write some) are kept as bytes.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a binary little-endian PLY with an element ``vertex`` of plain numbers and the properties of
            Gaussian splatting (the message says what else it is), or of another length than its header says.

    Example:
        >>> import tempfile
        >>> lines = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
        >>> lines += [*(f"property float {name}" for name in _NEEDED), "end_header", ""]
        >>> content = chr(10).join(lines).encode() + np.ones((2, len(_NEEDED)), "<f4").tobytes()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "two.ply").write_bytes(content)
        ...     splats = read_splat_ply(Path(folder, "two.ply"))
        ...     print(len(splats), splats.gaussians().means.tolist())
        2 [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    source = Path(path)
    kind = file_kind(source, caller="read_splat_ply")
    if kind is not SPLATS:
        raise not_readable(source, kind, caller="read_splat_ply")

    def refuse(rule: str) -> InvalidFile:
        return InvalidFile(f"read_splat_ply: {source} is not a PLY of Gaussian splats: {rule}")

    with source.open("rb") as stream:
        start = stream.read(MOST_HEADER)
    try:
        header = parse_header(start, formats=("binary_little_endian",))
        place = header.place
    except ValueError as error:
        raise refuse(str(error)) from None
    elements, begins = header.elements, header.begins
    vertex, others = elements[place], (*elements[:place], *elements[place + 1 :])
    missing = [name for name in _NEEDED if name not in (vertex.dtype.names or ())]
    if missing:
        raise refuse(f"it lacks the properties {', '.join(missing)}")
    excess = source.stat().st_size - begins - sum(element.least_bytes for element in elements)
    if excess < 0 or (excess > 0 and not any(element.list_bytes for element in others)):
        state = "longer" if excess > 0 else "shorter"
        beside = f" and the elements {', '.join(element.name for element in others)}" if others else ""
        raise refuse(
            f"its body is {abs(excess)} bytes {state} than {vertex.count} rows of {vertex.dtype.itemsize}{beside}"
        )
    first = begins + sum(element.least_bytes for element in elements[:place])
    behind = first + vertex.least_bytes
    rows = np.memmap(source, vertex.dtype, "r", first, (vertex.count,)) if vertex.count else np.zeros(0, vertex.dtype)
    return SplatPly(
        rows, header.lines, _bytes_of(source, begins, first), _bytes_of(source, behind, source.stat().st_size), others
    )


def _bytes_of(source: Path, first: int, last: int) -> NDArray[np.uint8]:
    return np.memmap(source, np.uint8, "r", first, (last - first,)) if last > first else _no_bytes()


def write_splat_ply(
    path: str | Path, splats: SplatPly, *, keep: NDArray[np.bool_], keep_score: NDArray[np.floating] | None = None
) -> None:
    """Write the rows to keep, every property as it was, byte for byte; whole or not at all.

    Elements beside ``vertex`` are written as they came. A warning is raised where rows are left out and such an
    element has lists or as many rows as there were splats: it may count or number them.

    Args:
        path: a new file, or one to be replaced. Never the one that ``splats`` was read from, which is still open.
        splats: from :func:`read_splat_ply`.
        keep: ``(N,)`` bool.
        keep_score: ``(N,)``, written as a last property ``keep_score`` (float32); one that is there is replaced.

    Raises:
        ValueError: wrong shapes, or the file being written is the one being read.

    Example:
        >>> import tempfile
        >>> lines = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
        >>> lines += [*(f"property float {name}" for name in _NEEDED), "end_header", ""]
        >>> content = chr(10).join(lines).encode() + np.ones((2, len(_NEEDED)), "<f4").tobytes()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     source, target = Path(folder, "two.ply"), Path(folder, "one.ply")
        ...     _ = source.write_bytes(content)
        ...     write_splat_ply(target, read_splat_ply(source), keep=np.array([True, False]))
        ...     print(len(read_splat_ply(target)))
        1
    """
    target = Path(path)
    for name, array in (("keep", keep), ("keep_score", keep_score)):
        if array is not None and array.shape != (len(splats),):
            raise InvalidArgument(f"write_splat_ply: {name} must have shape ({len(splats)},), got {array.shape}")
    if keep.dtype != np.bool_:
        raise InvalidArgument(f"write_splat_ply: keep must be bool, got {keep.dtype}")
    origin = getattr(splats.rows, "filename", None)
    if origin is not None and target.exists() and target.samefile(origin):
        raise InvalidArgument(f"write_splat_ply: {target} is the file that is being read; write to another")
    names = [name for name in splats.rows.dtype.names or () if keep_score is None or name != KEEP_SCORE]
    fields = [(name, splats.rows.dtype[name]) for name in names]
    if keep_score is not None:
        fields.append((KEEP_SCORE, np.dtype("<f4")))
    chosen = np.flatnonzero(keep)
    bound = [e.name for e in splats.others if e.count and (e.list_bytes or e.count == len(splats))]
    if bound and len(chosen) < len(splats):
        warnings.warn(
            f"write_splat_ply: the element {', '.join(bound)} of {target.name} is as it was before rows were left out; "
            "it may refer to them",
            stacklevel=2,
        )
    with atomic_file(target) as stream:
        stream.write(_header(splats.header, len(chosen), with_score=keep_score is not None))
        stream.write(splats.before.tobytes())
        for start in range(0, len(chosen), 1 << 16):
            part = chosen[start : start + (1 << 16)]
            rows = np.empty(len(part), np.dtype(fields))
            for name in names:
                rows[name] = splats.rows[name][part]
            if keep_score is not None:
                rows[KEEP_SCORE] = keep_score[part]
            stream.write(rows.tobytes())
        for start in range(0, len(splats.after), 1 << 24):
            stream.write(splats.after[start : start + (1 << 24)].tobytes())


def _header(lines: tuple[str, ...], count: int, *, with_score: bool) -> bytes:
    """The header for ``count`` vertices; the score is their last property."""
    kept, element, end = list[str](), "", 0  # end: behind the last property of the vertices
    for line in lines:
        words = line.split()
        if words[:1] == ["element"]:
            element = words[1]
            line = f"element vertex {count}" if element == "vertex" else line
        in_vertex = element == "vertex" and words[:1] in (["element"], ["property"])
        if with_score and in_vertex and words[0] == "property" and words[-1] == KEEP_SCORE:
            continue
        kept.append(line)
        end = len(kept) if in_vertex else end
    if with_score:
        kept.insert(end, f"property float {KEEP_SCORE}")
    return ("\n".join([*kept, "end_header"]) + "\n").encode("latin-1")
