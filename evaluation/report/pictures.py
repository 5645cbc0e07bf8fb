"""Pictures of a report's page: photo, renders and where they err, as JPEG (needs Pillow: ``unghost[eval]``)."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, MissingExtra
from ...core.metrics import get_metric
from ..metrics.checks import Mask
from ..scoring.renders import Method
from ..scoring.views import Truth
from .tables import EQUAL_KEYS, OWN_KEYS, number

LARGEST_SIDE = 1200  # pixels; larger pictures are shrunk for the page
COARSE = 320  # pixels across; smaller ones are shown with their pixels as squares
QUALITY = 90
WORST = 0.5  # an error from here on is drawn white
NOT_COUNTED = (0.42, 0.46, 0.52)
HEAT = np.array([[0.0, 0.0, 0.02], [0.32, 0.07, 0.48], [0.72, 0.21, 0.47], [0.99, 0.56, 0.35], [1.0, 1.0, 0.9]])
PHOTO = "photo"


@dataclass(frozen=True)
class ViewPictures:
    """The pictures of one view.

    Attributes:
        name: of the view.
        shown: label -> JPEG: the photo (``PHOTO``) and each method's render.
        errors: method -> JPEG of its error.
        captions: method -> its numbers, as text.
        coarse: few pixels.
    """

    name: str
    shown: Mapping[str, bytes]
    errors: Mapping[str, bytes]
    captions: Mapping[str, str]
    coarse: bool


def worst_first(images: Sequence[Mapping[str, Any]], key: str) -> list[str]:
    """Names of views from the worst to the best by a metric; those where it is undefined come last.

    Raises:
        ValueError: a metric of which one cannot say which way is better.
    """
    sortable = [each for each in (*OWN_KEYS, *EQUAL_KEYS) if get_metric(each).sign]
    if key not in sortable:
        raise InvalidArgument(f"worst_first: key must be one of {', '.join(sortable)}, got {key!r}")

    def badness(row: Mapping[str, Any]) -> tuple[bool, float]:
        infinite = key in row.get("infinite", ())
        value = math.inf if infinite else row.get(key)
        return (True, 0.0) if value is None else (False, value * get_metric(key).sign)

    return [row["name"] for row in sorted(images, key=badness)]


def view_pictures(
    names: Sequence[str],
    methods: Sequence[Method],
    truth: Truth,
    masks: Mapping[str, Mask],
    rows: Sequence[Mapping[str, Any]],
    *,
    keys: Sequence[str],
) -> list[ViewPictures]:
    """Pictures of some views.

    Args:
        names: of the views, in order.
        methods, truth: what was rendered and photographed.
        masks: method -> ``(n, H, W)`` bool, the pixels that counted; the error of others is drawn grey.
        rows: of :func:`unghost.evaluation.scoring.comparison.compare_methods`, for the numbers.
        keys: metrics named in the captions.
    """
    position = {name: index for index, name in enumerate(truth.names)}
    scores = {row["method"]: {each["name"]: each for each in row["per_image"]} for row in rows}
    result = []
    for name in names:
        index = position[name]
        window = truth.window(index)
        photo = truth.photos[index][window]
        rendered = {each.name: each.renders.colours[index][window] for each in methods}
        shown = {PHOTO: jpeg(photo)} | {method: jpeg(picture) for method, picture in rendered.items()}
        errors = {
            method: jpeg(error_picture(picture, photo, masks[method][index][window]))
            for method, picture in rendered.items()
        }
        captions = {each.name: _caption(scores[each.name][name], keys) for each in methods}
        result.append(ViewPictures(name, shown, errors, captions, max(photo.shape[:2]) <= COARSE))
    return result


def error_picture(preds: NDArray[Any], target: NDArray[Any], mask: Mask) -> NDArray[np.float64]:
    """The largest channel's absolute error ``(H, W, 3)``: black is none, white ``WORST`` or more, grey not counted."""
    error = np.clip(np.abs(preds.astype(np.float64) - target).max(axis=-1) / WORST, 0, 1)
    stops = np.linspace(0, 1, len(HEAT))
    painted = np.stack([np.interp(error, stops, HEAT[:, channel]) for channel in range(3)], axis=-1)
    return np.where(mask[..., None], painted, NOT_COUNTED)


def jpeg(image: NDArray[Any]) -> bytes:
    """``(H, W, 3)`` in [0, 1] as JPEG of at most ``LARGEST_SIDE`` pixels a side."""
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtra("pictures need Pillow: pip install unghost[eval]") from error
    picture = Image.fromarray(np.round(np.clip(image, 0, 1) * 255).astype(np.uint8))
    factor = LARGEST_SIDE / max(picture.size)
    if factor < 1:
        wanted = max(1, round(picture.width * factor)), max(1, round(picture.height * factor))
        picture = picture.resize(wanted, Image.Resampling.BOX)
    stream = io.BytesIO()
    picture.save(stream, format="JPEG", quality=QUALITY, subsampling=0)
    return stream.getvalue()


def _caption(row: Mapping[str, Any], keys: Sequence[str]) -> str:
    if not row["pixels"]:
        return "no pixel counts"
    named = [
        (get_metric(key), number(row.get(key), get_metric(key).decimals, infinite=key in row["infinite"]))
        for key in keys
        if row.get(key) is not None or key in row["infinite"]
    ]
    return " · ".join(f"{metric.label.removesuffix(f', {metric.unit}')} {shown}" for metric, shown in named)
