"""Two camera sweeps from above, as the paper's appendix draws its captures (needs matplotlib: ``unghost[eval]``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import MissingExtra
from .difficulty import Difficulty, difficulty, every_nth, normalising_factor

TRAIN_COLOUR, EVAL_COLOUR, LINK_COLOUR = "#1a1a1a", "#d62728", "#c9c9c9"
UPRIGHT = 0.3  # length of the mean of the cameras' up axes below which it says nothing
PANEL = 4.6  # width in inches
TICK = 0.11  # length of what shows where a camera looks, in normalised units


def ground_plane(*sweeps: Cameras) -> NDArray[np.float64]:
    """Two unit vectors ``(2, 3)`` that span the ground, right-handed as seen from above, the longer extent first.

    Up is the mean of the cameras' up axes, as in nerfstudio; where these cancel (cameras that look straight down while
    they turn), the direction in which the origins vary least.
    """
    up = np.concatenate([cameras.camera_to_world[:, :, 1] for cameras in sweeps]).mean(axis=0)
    origins = np.concatenate([cameras.origins for cameras in sweeps])
    centred = origins - origins.mean(axis=0)
    if np.linalg.norm(up) < UPRIGHT:
        up = np.linalg.svd(centred)[2][2]
    up = up / np.linalg.norm(up)
    flat = centred - np.outer(centred @ up, up)
    first = np.linalg.svd(flat)[2][0]
    if np.linalg.norm(flat) < 1e-12 or abs(first @ up) > 0.5:  # all above one point: any direction will do
        first = np.eye(3)[np.abs(up).argmin()]
    first = first - (first @ up) * up
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)])


def draw_birds_eye(
    path: str | Path,
    train: Cameras,
    evaluation: Cameras,
    *,
    title: str = "",
    heading: str = "scored on the other sweep",
    n: int | None = 8,
) -> None:
    """Draw both sweeps from above and, beside them, what holding out every n-th training photo would test.

    A dot is a camera (black: training, red: scored), its tick the way it looks, a grey line the way from a scored one
    to the nearest training one. Units as in :func:`~unghost.evaluation.captures.difficulty.difficulty`.

    Args:
        path: of the PNG.
        train, evaluation: in one world.
        title: above the picture.
        heading: of the panel with both sweeps.
        n: of the panel on the right, which is left out with None, or if ``train`` has one photo.

    Raises:
        ImportError: matplotlib is missing.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("draw_birds_eye needs matplotlib: pip install unghost[eval]") from error
    unit, plane = normalising_factor(train, evaluation), ground_plane(train, evaluation)
    center = np.concatenate([train.origins, evaluation.origins]).mean(axis=0)
    panels = [(heading, train, evaluation)]
    if n is not None and len(train) > 1:
        taught, held_out = every_nth(len(train), n=n)
        panels.append((f"scored on every {n}th training photo", train.select(taught), train.select(held_out)))
    around = (np.concatenate([train.origins, evaluation.origins]) - center) @ plane.T * unit
    low, high = around.min(axis=0) - 1.5 * TICK, around.max(axis=0) + 1.5 * TICK
    height = PANEL * float(np.clip((high - low)[1] / (high - low)[0], 0.4, 1.0))
    figure = Figure(figsize=(PANEL * len(panels) + 0.2, height + 1.2), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, weight="bold", color="#222222")
    grid = figure.subplots(1, len(panels), squeeze=False)
    for axes, (told, black, red) in zip(grid[0], panels):
        found = difficulty(black, red, factor=unit)
        _panel(
            axes,
            [
                ((each.origins - center) @ plane.T * unit, -each.camera_to_world[:, :, 2] @ plane.T)
                for each in (black, red)
            ],
            found,
        )
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_xlabel("seen from above, normalised units", fontsize=8.5, color="#555555")
        means = f"mean to nearest: {found.translation.mean():.2f}, {found.rotation_deg.mean():.1f}°"
        axes.set_title(f"{told}\n{means}", fontsize=10, color="#222222")
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9, frameon=False
    )
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, format="png", metadata={"Software": None})


def _panel(axes: Any, sweeps: list[tuple[NDArray[Any], NDArray[Any]]], found: Difficulty) -> None:
    """One view from above; ``sweeps``: places and directions, ``(n, 2)`` each, of training and scored cameras."""
    (black, _), (red, _) = sweeps
    for number, (place, other) in enumerate(zip(red, found.nearest)):
        pair = np.stack([place, black[other]])
        label = "to the nearest training photo" if number == 0 else None
        axes.plot(pair[:, 0], pair[:, 1], color=LINK_COLOUR, linewidth=0.9, zorder=1, label=label)
    looks = ((TRAIN_COLOUR, "training", 16, 2), (EVAL_COLOUR, "scored", 22, 3))
    for (places, directions), (colour, label, area, order) in zip(sweeps, looks):
        ends = places + TICK * directions
        for start, end in zip(places, ends):
            axes.plot([start[0], end[0]], [start[1], end[1]], color=colour, linewidth=0.8, zorder=order)
        axes.scatter(places[:, 0], places[:, 1], s=area, color=colour, label=label, zorder=order, linewidths=0)
    axes.grid(color="#eeeeee", linewidth=0.6)
    axes.tick_params(labelsize=8, colors="#555555")
    for spine in axes.spines.values():
        spine.set_color("#cccccc")
