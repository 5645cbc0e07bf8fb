"""From scores to a results row, a printed table and a comparison figure (needs matplotlib: ``unghost[eval]``)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, MissingExtra
from ...core.results import json_ready
from ..scoring.conventions import get_convention, one_convention

TABLE_KEYS = (
    "psnr",
    "ssim",
    "depth_mse",
    "disparity_mae",
    "normal_mean_deg",
    "normal_median_deg",
    "normal_pct_30",
    "coverage",
    "psnr_common",
    "psnr_visible",
)


def mean_over_seeds(method: str, per_seed: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One results row: the mean of every number over the seeds, and each seed's own values under ``per_seed``.

    A seed without a value (NaN or None) makes the mean None: half a mean is not comparable with a whole one.

    Args:
        method: the row's name.
        per_seed: scores with the same keys, a ``seed`` and one ``convention``.

    Raises:
        ValueError: no seed, different keys, or scores of different conventions.
    """
    if not per_seed:
        raise InvalidArgument("mean_over_seeds: per_seed must hold at least one seed's scores")
    keys = list(per_seed[0])
    if any(set(scores) != set(keys) for scores in per_seed):
        raise InvalidArgument("mean_over_seeds: every seed must have the same keys")
    one_convention("mean_over_seeds", per_seed)
    row: dict[str, Any] = {"method": method}
    for key in keys:
        if key == "convention":
            row[key] = per_seed[0][key]
        elif key != "seed":
            values = [scores[key] for scores in per_seed]
            row[key] = None if None in values else float(np.mean(values))
    row["per_seed"] = [{key: value for key, value in scores.items() if key != "convention"} for scores in per_seed]
    return dict(json_ready(row))


def format_table(rows: Sequence[Mapping[str, Any]], keys: Sequence[str] = TABLE_KEYS) -> str:
    """Rows as aligned text, one method a line; a dash where there is no number.

    Raises:
        ValueError: rows of different conventions (both named): see :func:`format_conventions` for those.
    """
    one_convention("format_table", rows)
    cells = [["method", *keys]]
    for row in rows:
        values = [row.get(key) for key in keys]
        cells.append([str(row["method"]), *map(_number, values)])
    return _aligned(cells)


def convention_rows(scores: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The same renders under several conventions: a row a metric, a column a convention, and how far they differ.

    Args:
        scores: convention -> its scores of one and the same renders (:meth:`SceneScores.means` or a row of
            :func:`unghost.evaluation.scoring.engine.summarize`).

    Returns:
        Rows ``{"metric", <convention>: value or None, …, "spread"}``, ``spread`` being the largest finite value less
        the smallest, None with fewer than two.

    Raises:
        ValueError: scores stand under another convention's name (both named).
    """
    for name, each in scores.items():
        if each.get("convention", name) != name:
            raise InvalidArgument(f"convention_rows: the scores given as {name!r} are of {each['convention']!r}")
    keys = dict.fromkeys(key for name in scores for key in get_convention(name).keys)
    rows = []
    for key in keys:
        values = {name: each.get(key) for name, each in scores.items()}
        finite = [float(value) for value in values.values() if value is not None and np.isfinite(value)]
        spread = max(finite) - min(finite) if len(finite) > 1 else None
        rows.append({"metric": key, **values, "spread": spread})
    return rows


def format_conventions(scores: Mapping[str, Mapping[str, Any]]) -> str:
    """:func:`convention_rows` as aligned text; a dash where a convention does not define a metric."""
    cells = [["metric", *scores, "spread"]]
    for row in convention_rows(scores):
        cells.append([row["metric"], *(_number(row[name]) for name in scores), _number(row["spread"])])
    return _aligned(cells)


def _number(value: Any) -> str:
    return "–" if value is None else f"{value:.3f}"


def _aligned(cells: Sequence[Sequence[str]]) -> str:
    widths = [max(len(line[column]) for line in cells) for column in range(len(cells[0]))]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths)).rstrip() for line in cells]
    return "\n".join(lines)


def draw_comparison(
    path: str | Path,
    columns: Mapping[str, Mapping[str, NDArray[Any]]],
    *,
    views: Sequence[int],
    limit: float,
    title: str,
    note: str = "",
) -> None:
    """Draw colour over depth for some views, a column a method; two views side by side.

    Args:
        path: of the PNG.
        columns: heading -> ``rgb (n, H, W, 3)`` in [0, 1] and ``depth (n, H, W)`` along unit rays. The
            first column sets the range of depths of each view.
        views: which of the ``n`` to show.
        limit: depths from here on, infinite ones too, are drawn in grey.
        title: above the picture.
        note: below the picture.

    Raises:
        ImportError: matplotlib is missing.
    """
    try:
        from matplotlib import colormaps
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("draw_comparison needs matplotlib: pip install unghost[eval]") from error
    blocks = 2 if len(views) > 1 else 1
    across = len(columns) * blocks
    down = 2 * -(-len(views) // blocks)
    height, width = next(iter(columns.values()))["depth"].shape[1:]
    cell = 1.9
    size = (cell * across + 0.6, cell * height / width * down + 1.1)
    figure = Figure(figsize=size, facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.012, 1 - 0.28 / size[1], title, fontsize=13, weight="bold", va="center", color="#222222")
    figure.text(0.012, 0.17 / size[1], note, fontsize=8.5, va="center", color="#555555")
    turbo = colormaps["turbo"]
    for number, view in enumerate(views):
        near, far = _depth_range(next(iter(columns.values()))["depth"][view], limit)
        for column, (heading, maps) in enumerate(columns.items()):
            left = 0.012 + (number % blocks * len(columns) + column) * (cell / size[0])
            left += number % blocks * 0.25 / size[0]
            for row, picture in enumerate((maps["rgb"][view], _paint(maps["depth"][view], near, far, limit, turbo))):
                line = number // blocks * 2 + row
                bottom = 1 - (0.72 + (line + 1) * cell * height / width) / size[1]
                axes = figure.add_axes((left, bottom, 0.97 * cell / size[0], 0.97 * cell * height / width / size[1]))
                axes.imshow(np.clip(picture, 0, 1), interpolation="nearest")
                axes.set_axis_off()
                if line == 0:
                    axes.set_title(heading, fontsize=9.5, color="#222222", pad=3)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    dpi = max(110, math.ceil(width / (0.97 * cell)))  # no pixel of a picture is lost
    figure.savefig(path, dpi=dpi, format="png", metadata={"Software": None})


def _depth_range(depth: NDArray[Any], limit: float) -> tuple[float, float]:
    known = depth[depth < limit]
    if not known.size:
        return 0.0, limit
    near, far = np.percentile(known, [2, 98])
    return float(near), float(max(far, near + 1e-6))


def _paint(depth: NDArray[Any], near: float, far: float, limit: float, colours: Any) -> NDArray[Any]:
    """Near is warm, far is cold (by inverse distance), nothing is grey."""
    shown = depth < limit
    inverse = 1.0 / np.clip(np.where(shown, depth, far), 1e-6, None)
    spread = max(1.0 / max(near, 1e-6) - 1.0 / far, 1e-9)
    painted: NDArray[Any] = colours(np.clip((inverse - 1.0 / far) / spread, 0, 1))[..., :3]
    return np.where(shown[..., None], painted, 0.55)
