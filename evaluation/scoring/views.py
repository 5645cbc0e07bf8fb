"""What is scored and what it is scored against: renders and the truth of the same views, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument
from ..metrics.checks import Mask
from ..metrics.geometry import normals_from_depth

COLOUR_SLACK = 1e-4  # renderers overshoot [0, 1] by rounding; more is refused, never clipped in silence


def _colours(caller: str, name: str, values: NDArray[Any]) -> None:
    if values.ndim != 4 or values.shape[-1] != 3 or not values.size:
        raise InvalidArgument(f"{caller}: {name} must have shape (n, H, W, 3) with pixels, got {values.shape}")
    if not np.issubdtype(values.dtype, np.floating):
        raise InvalidArgument(
            f"{caller}: {name} must be floating point in [0, 1], got {values.dtype}: divide by 255 first"
        )
    inside = (values >= -COLOUR_SLACK) & (values <= 1 + COLOUR_SLACK)
    if not inside.all():
        raise InvalidArgument(f"{caller}: {name} must lie in [0, 1], {int((~inside).sum())} values do not (NaN counts)")


def _map_shape(caller: str, name: str, values: NDArray[Any] | None, shape: tuple[int, ...]) -> None:
    if values is not None and values.shape != shape:
        raise InvalidArgument(f"{caller}: {name} must have shape {shape}, got {values.shape}")


def check_depth(caller: str, name: str, values: NDArray[Any] | None) -> None:
    """Depth must be > 0; inf is "no surface"; NaN is refused and counted."""
    if values is not None and not (values > 0).all():
        bad, nan = int((~(values > 0)).sum()), int(np.isnan(values).sum())
        raise InvalidArgument(f"{caller}: {name} must be > 0 (inf for no surface), {bad} values are not ({nan} NaN)")


def check_normals(caller: str, name: str, values: NDArray[Any] | None) -> None:
    """Normals must be unit vectors (to a thousandth), or NaN in all three for none; the others are counted."""
    if values is None:
        return
    none = np.isnan(values).all(axis=-1)
    length = np.linalg.norm(np.where(none[..., None], 0.0, values), axis=-1)
    bad = int((~none & ~(np.abs(length - 1.0) <= 1e-3)).sum())
    if bad:
        raise InvalidArgument(f"{caller}: {name} must be unit vectors, or NaN for none; {bad} are not")


@dataclass(frozen=True, eq=False)
class Renders:
    """Rendered evaluation views of one method.

    Attributes:
        colours: ``(n, H, W, 3)`` sRGB in [0, 1].
        depth: ``(n, H, W)`` along the unit ray, scene units, > 0, inf for no surface; None if not rendered.
        accumulation: ``(n, H, W)`` opacity of the ray in [0, 1]; None if not rendered.
        normals: ``(n, H, W, 3)`` unit, world axes, NaN where there is none; None: taken from the depth.
    """

    colours: NDArray[Any]
    depth: NDArray[Any] | None = None
    accumulation: NDArray[Any] | None = None
    normals: NDArray[Any] | None = None

    def __post_init__(self) -> None:
        _colours("Renders", "colours", self.colours)
        shape = self.colours.shape[:3]
        _map_shape("Renders", "depth", self.depth, shape)
        _map_shape("Renders", "accumulation", self.accumulation, shape)
        _map_shape("Renders", "normals", self.normals, (*shape, 3))
        check_depth("Renders", "depth", self.depth)
        check_normals("Renders", "normals", self.normals)

    def __len__(self) -> int:
        return len(self.colours)


@dataclass(frozen=True, eq=False)
class Truth:
    """What the evaluation views really show.

    Attributes:
        photos: ``(n, H, W, 3)`` sRGB in [0, 1].
        visible: ``(n, H, W)`` bool, what the training views saw; None if unknown.
        depth: ``(n, H, W)`` as in :class:`Renders`: pseudo ground truth or exact; None if unknown.
        normals: ``(n, H, W, 3)`` as in :class:`Renders`; None: taken from the depth.
        cameras: the ``n`` cameras, to take normals from depth; None if normals are given or not asked for.
        names: of the views, for rows and pages; ``0``, ``1``, … unless given.
        sizes: ``(n, 2)`` width and height of each view, where they differ; None: those of the cameras, or all the
            same. Every array, also of the renders, then holds each view in its upper left corner, and what lies beside
            it (:func:`pad_views`) counts nowhere.
    """

    photos: NDArray[Any]
    visible: Mask | None = None
    depth: NDArray[Any] | None = None
    normals: NDArray[Any] | None = None
    cameras: Cameras | None = None
    names: tuple[str, ...] = ()
    sizes: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        _colours("Truth", "photos", self.photos)
        shape = self.photos.shape[:3]
        _map_shape("Truth", "visible", self.visible, shape)
        _map_shape("Truth", "depth", self.depth, shape)
        _map_shape("Truth", "normals", self.normals, (*shape, 3))
        if self.visible is not None and self.visible.dtype != np.bool_:
            raise InvalidArgument(f"Truth: visible must be bool, got {self.visible.dtype}")
        check_depth("Truth", "depth", self.depth)
        check_normals("Truth", "normals", self.normals)
        if self.cameras is not None:
            found = (len(self.cameras), *self.cameras.canvas)
            if found != shape:
                raise InvalidArgument(f"Truth: cameras must be {shape} (n, H, W), got {found}")
        names = tuple(self.names) or tuple(str(index) for index in range(shape[0]))
        if len(names) != shape[0] or len(set(names)) != len(names):
            raise InvalidArgument(
                f"Truth: names must be {shape[0]} different ones, got {len(names)} ({len(set(names))})"
            )
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "sizes", self._sizes())

    def _sizes(self) -> NDArray[np.int64]:
        count, height, width = self.photos.shape[:3]
        known = None if self.cameras is None else self.cameras.sizes
        sizes = self.sizes if self.sizes is not None else known
        if sizes is None:
            sizes = np.tile([width, height], (count, 1))
        sizes = np.asarray(sizes, dtype=np.int64)
        if sizes.shape != (count, 2) or (sizes < 1).any() or tuple(sizes.max(axis=0)) != (width, height):
            raise InvalidArgument(
                f"Truth: sizes must be {count} of width and height, the largest {width} x {height}, "
                f"got {sizes.tolist()}"
            )
        if known is not None and (known != sizes).any():
            raise InvalidArgument("Truth: sizes must be those of the cameras")
        return sizes

    def __len__(self) -> int:
        return len(self.photos)

    def window(self, index: int) -> tuple[slice, slice]:
        """Rows and columns of one view."""
        assert self.sizes is not None
        width, height = self.sizes[index].tolist()
        return slice(0, height), slice(0, width)

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Height and width of each view."""
        assert self.sizes is not None
        return [(height, width) for width, height in self.sizes.tolist()]

    def inside(self) -> Mask | None:
        """``(n, H, W)`` bool: pixels that belong to a view; None where all do."""
        assert self.sizes is not None
        height, width = self.photos.shape[1:3]
        if (self.sizes == [width, height]).all():
            return None
        column, row = np.arange(width) < self.sizes[:, :1], np.arange(height) < self.sizes[:, 1:]
        return np.asarray(row[:, :, None] & column[:, None, :], dtype=np.bool_)


def pad_views(views: Sequence[NDArray[Any]], canvas: tuple[int, int], fill: Any) -> NDArray[Any]:
    """Arrays ``(h, w, ...)`` of views as one ``(n, H, W, ...)``, each in the upper left corner of ``canvas (H, W)``.

    Equal views that fill the canvas are stacked.

    Example:
        >>> portrait, landscape = np.ones((3, 2)), np.full((2, 3), 4.0)
        >>> pad_views([portrait, landscape], (3, 3), np.inf)[1].tolist()
        [[4.0, 4.0, 4.0], [4.0, 4.0, 4.0], [inf, inf, inf]]
    """
    if all(view.shape[:2] == canvas for view in views):
        return np.stack(views)
    padded = np.full((len(views), *canvas, *views[0].shape[2:]), fill, dtype=views[0].dtype)
    for place, view in zip(padded, views):
        place[: view.shape[0], : view.shape[1]] = view
    return padded


def check_match(caller: str, renders: Renders, truth: Truth) -> None:
    """Refuse renders of another number or size than the photos."""
    if renders.colours.shape != truth.photos.shape:
        raise InvalidArgument(
            f"{caller}: renders must have the photos' shape {truth.photos.shape}, got {renders.colours.shape}: "
            "render at the photos' size, or resize the photos, before scoring"
        )


def view_normals(
    normals: NDArray[Any] | None, depth: NDArray[Any] | None, cameras: Cameras | None, index: int
) -> NDArray[Any] | None:
    """Normals ``(H, W, 3)`` of one view: those given, else those of its depth ``(H, W)``; None for neither."""
    if normals is not None:
        return normals
    if depth is None or cameras is None:
        return None
    return normals_from_depth(depth, cameras, index)
