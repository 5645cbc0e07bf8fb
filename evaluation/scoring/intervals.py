"""Means with bootstrap intervals: over images, over scenes, and of the difference of two methods.

Percentile bootstrap (Efron). Values that are undefined (None or NaN: an image without a pixel left) are left out and
counted, so that no mean is NaN; infinite ones (a PSNR of equal images) stay and make an infinite mean. Ends of
an interval are order statistics, never interpolated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument

FloatArray = NDArray[np.float64]
RESAMPLES = 1000


@dataclass(frozen=True)
class Interval:
    """A mean and where it might have fallen.

    Attributes:
        mean: None where nothing is defined.
        low, high: ends of the interval; None with fewer than two values: one says nothing of its spread.
        level: of the interval.
        count: defined values (of scenes: images in all).
        undefined: values left out.
    """

    mean: float | None
    low: float | None
    high: float | None
    level: float
    count: int
    undefined: int


def defined(values: Iterable[float | None]) -> tuple[FloatArray, int]:
    """The values that are neither None nor NaN, and how many were.

    Example:
        >>> values, undefined = defined([1.0, None, float("nan")])
        >>> values.tolist(), undefined
        ([1.0], 2)
    """
    listed = list(values)
    known = np.array([value for value in listed if value is not None and not np.isnan(value)], dtype=np.float64)
    return known, len(listed) - len(known)


def bootstrap_mean(
    values: Iterable[float | None], rng: np.random.Generator, *, level: float = 0.95, resamples: int = RESAMPLES
) -> Interval:
    """Mean of the images of one scene, and an interval by resampling images.

    Args:
        values: one an image; None or NaN where undefined.
        rng: draws ``resamples`` times ``(n,)`` indices, and nothing else.
        level: in (0, 1).
        resamples: >= 1.

    Example:
        >>> found = bootstrap_mean([18.0, 20.0, None], np.random.default_rng(0))
        >>> found.mean, found.low, found.high, found.undefined
        (19.0, 18.0, 20.0, 1)
    """
    _check("bootstrap_mean", level, resamples)
    known, undefined = defined(values)
    if len(known) < 2:
        return Interval(float(known[0]) if len(known) else None, None, None, level, len(known), undefined)

    means = known[rng.integers(0, len(known), (resamples, len(known)))].mean(axis=1)
    low, high = _ends(means, level)
    return Interval(float(known.mean()), low, high, level, len(known), undefined)


def bootstrap_scenes(
    scenes: Mapping[str, Sequence[float | None]],
    rng: np.random.Generator,
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    mean_over: str = "scenes",
) -> Interval:
    """Mean over scenes, and an interval by resampling scenes and then images within each drawn scene.

    A scene without a defined image takes no part. With one scene only its images are resampled: the interval
    then says nothing of other scenes.

    Args:
        scenes: name -> one value an image.
        rng: draws the scenes of all resamples, then the images of one scene after the other.
        level: in (0, 1).
        resamples: >= 1.
        mean_over: ``"scenes"`` (mean of the scenes' means) or ``"images"`` (of all images).

    Example:
        >>> scenes = {"room": [18.0, 20.0], "hall": [30.0]}
        >>> bootstrap_scenes(scenes, np.random.default_rng(0)).mean
        24.5
        >>> round(bootstrap_scenes(scenes, np.random.default_rng(0), mean_over="images").mean, 2)
        22.67
    """
    _check("bootstrap_scenes", level, resamples)
    if mean_over not in ("scenes", "images"):
        raise InvalidArgument(f"bootstrap_scenes: mean_over must be scenes or images, got {mean_over!r}")
    split = [defined(values) for values in scenes.values()]
    known = [values for values, _ in split if len(values)]
    undefined, count = sum(each for _, each in split), sum(map(len, known))

    def mean(parts: list[FloatArray]) -> float:
        return float(np.mean([each.mean() for each in parts] if mean_over == "scenes" else np.concatenate(parts)))

    if count < 2:
        return Interval(mean(known) if count else None, None, None, level, count, undefined)

    chosen = rng.integers(0, len(known), (resamples, len(known)))
    sums, images = np.zeros(chosen.shape), np.zeros(chosen.shape)
    for index, values in enumerate(known):
        drawn = chosen == index
        size = int(drawn.sum()), len(values)
        sums[drawn], images[drawn] = values[rng.integers(0, len(values), size)].sum(axis=1), len(values)
    means = (sums / images).mean(axis=1) if mean_over == "scenes" else sums.sum(axis=1) / images.sum(axis=1)
    low, high = _ends(means, level)
    return Interval(mean(known), low, high, level, count, undefined)


def bootstrap_difference(
    first: Sequence[float | None],
    second: Sequence[float | None],
    rng: np.random.Generator,
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
) -> Interval:
    """Mean of ``first - second`` over the same images, by resampling images: an interval without 0 is a difference.

    An image counts if both values are finite; the others are ``undefined``. Pairing takes out how hard an image is,
    so that the interval is far narrower than those of the two means.

    Example:
        >>> found = bootstrap_difference([18.0, 21.0], [17.0, 19.0], np.random.default_rng(0))
        >>> found.mean, found.low, found.high
        (1.5, 1.0, 2.0)
    """
    _check("bootstrap_difference", level, resamples)
    if len(first) != len(second):
        raise InvalidArgument(
            f"bootstrap_difference: first and second must pair up, got {len(first)} and {len(second)}"
        )
    pairs = np.array([[np.nan if v is None else v for v in pair] for pair in zip(first, second)]).reshape(-1, 2)
    usable = np.isfinite(pairs).all(axis=1)
    difference: list[float | None] = [*(pairs[usable, 0] - pairs[usable, 1]), *[None] * int((~usable).sum())]
    return bootstrap_mean(difference, rng, level=level, resamples=resamples)


def _check(caller: str, level: float, resamples: int) -> None:
    if not 0 < level < 1:
        raise InvalidArgument(f"{caller}: level must lie in (0, 1), got {level}")
    if resamples < 1:
        raise InvalidArgument(f"{caller}: resamples must be >= 1, got {resamples}")


def _ends(means: FloatArray, level: float) -> tuple[float, float]:
    outside = int((1 - level) / 2 * len(means) + 1e-9)  # that many fall off at either end
    means = np.sort(means)
    return float(means[outside]), float(means[len(means) - 1 - outside])
