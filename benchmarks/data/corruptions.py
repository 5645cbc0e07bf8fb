"""Draw every family of corruption at growing severity, and write the page that shows and measures them.

python -m benchmarks.data.corruptions                 docs/corruptions.md and docs/corruptions/*.png
python -m benchmarks.data.corruptions --out FOLDER    the same under another folder than docs
"""

from __future__ import annotations

import argparse
import inspect
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unghost.core.distances import signed as sd
from unghost.core.frames import random_rotations, unit_lattice
from unghost.core.occupancy import DEFAULT_OPACITY_THRESHOLD, opacity_from_signed
from unghost.data_recipes.corruptions.softening import soften
from unghost.data_recipes.corruptions.structured import CORRUPTIONS, corrupt
from unghost.data_recipes.inspection.drawing import GHOST, MISSING, SURFACE, UNJUDGED, render_cube
from unghost.data_recipes.pairs import SOFT_SKIRT
from unghost.data_recipes.recipe import Recipe
from unghost.data_recipes.solids.compose import dilate, sample_cube

Occupancy = NDArray[np.bool_]
Values = NDArray[Any]

DOCS = Path(__file__).resolve().parents[2] / "docs"
SEVERITIES = (0.1, 0.3, 0.5, 0.8, 1.0)
WIDTH = 176  # pixels of one cube
MEASURED = 24  # cubes behind each number of the table
SEED = 7
REMOVED_OPACITY = 0.2  # what is gone is drawn see-through

IMITATES = {
    "detached_blobs": "Floaters that hang in free space, where few cameras look.",
    "touching_floaters": "Floaters that have grown from a surface; keeping the largest piece keeps them.",
    "fog_sheets": "A false wall in front of a camera, broken where another camera disagrees.",
    "fog_volumes": "Haze that fills what no photo constrains.",
    "holes": "Surface that too few views saw, or that reflects.",
    "rough_surface": "The bumps and pits of a field that was trained for too short.",
    "swollen_surface": "A surface smeared along the rays that saw it.",
    "doubled_surface": "The second copy of a surface that a wrong pose or exposure leaves.",
    "streaks": "Density drawn out towards a camera, along its rays.",
    "blocks": "The cells of a coarse voxel or hash grid that collided.",
    "salt": "Single cells that flicker about the threshold.",
    "corrupt": "What recipes use: one to four of the families above, mixed.",
    "soften": "What a smooth density grid would show of the mix: opacities instead of bits, spread-out surfaces, "
    "ghosts of every strength, and fog. Violet is the skirt of a surface, where a label says neither: a field spreads "
    "a surface over its neighbours, which is no fault.",
}


INTRODUCTION = f"""# Corruptions

What recipes do to clean cubes so that a prior can learn to undo it: the families of
`data_recipes/corruptions/structured.py`, and `soften`, which makes opacities of bits. This page is written by `python
-m benchmarks.data.corruptions`.

**How to read the pictures.** Each is a cube of 32³ voxels seen from one corner. On the left the clean cube; then the
same with growing severity and the same random numbers, so that what a family changes at one severity is part of what
it changes at the next. Grey is what is left of the clean cube, **orange** what was added (a ghost), **blue** and
see-through what was taken away.

**What severity means.** A number in [0, 1]; 0 changes nothing. A family ranks the voxels that it could flip and flips
the first of them: 0.042 of the number of occupied voxels at severity 0.1, 0.083 at 0.3, 0.126 at 0.5, 0.36 at 0.8 and
0.7 at 1 (that number taken to lie between 500 and 6000, so that empty cubes get ghosts too), times a log-normal
factor drawn once a call (median 1, mean 1.13). The same severity thus means about the same amount of damage in every
family, except that `salt` takes half, and that a family may run out of voxels that it can flip.

**Measured** on {MEASURED} procedural cubes: voxels changed over voxels occupied and, in brackets, the IoU with the
clean cube; means. For `soften` a voxel is occupied above an opacity of 0.1, and the skirt of a surface does not
count.
"""


def scenes() -> tuple[Occupancy, Occupancy]:
    """Two clean cubes: things on a floor, and thin, round ones in the air."""
    p = unit_lattice()
    floor = sd.box(p - [0, 0, -0.44], [0.6, 0.6, 0.04])
    box = sd.box(p - [-0.2, 0.16, -0.24], [0.19, 0.17, 0.17])
    ball = sd.sphere(p - [0.22, -0.2, -0.25], 0.155)
    pole = sd.cylinder(p - [0.22, 0.26, -0.08], 0.036, 0.34)
    shade = sd.cone(p - [0.22, 0.26, 0.16], 0.2, 0.28)
    turn = random_rotations(np.random.default_rng(3), 1)[0]
    ring = sd.torus((p - [0.02, 0.02, 0.02]) @ turn, 0.3, 0.05)
    stick = sd.capsule(p, [-0.42, -0.3, -0.35], [0.4, 0.3, 0.38], 0.04)
    leaf = sd.box((p - [0.1, 0.1, -0.3]) @ turn, [0.3, 0.22, 0.022])
    return np.minimum.reduce([floor, box, ball, pole, shade]) < 0, np.minimum.reduce([ring, stick, leaf]) < 0


def softened(rng: np.random.Generator, clean: Occupancy, severity: float) -> Values:
    """Opacity of the soft version of the mix; the clean bits at severity 0."""
    opacity: Values = opacity_from_signed(soften(rng, clean, corrupt(rng, clean, severity), severity))
    return opacity


def opacity_of(name: str) -> Callable[[np.random.Generator, Occupancy, float], Values]:
    """``(rng, clean, severity) -> opacity (R, R, R)`` of a family by its name."""
    if name == "soften":
        return softened
    family = CORRUPTIONS.get(name, corrupt)
    return lambda rng, clean, severity: family(rng, clean, severity).astype(np.float32)


def draw(clean: Occupancy, opacity: Values, unjudged: Occupancy) -> NDArray[np.uint8]:
    """One cube: what is left grey, what came orange, what is gone blue and see-through, what is unjudged violet."""
    gone = clean & (opacity <= DEFAULT_OPACITY_THRESHOLD)
    colors = np.where(clean[..., None], SURFACE, GHOST)
    colors[unjudged], colors[gone] = UNJUDGED, MISSING
    return render_cube(np.where(gone, REMOVED_OPACITY, opacity), colors, width=WIDTH)


def draw_family(name: str) -> bytes:
    """A PNG: one row a clean cube, the clean one first, then growing severity with the same random numbers."""
    from matplotlib.figure import Figure
    from PIL import Image

    cubes, columns = scenes(), (0.0, *SEVERITIES)
    figure = Figure(figsize=(len(columns) * WIDTH / 100, (len(cubes) * WIDTH + 34) / 100), dpi=100, facecolor="white")
    for row, bits in enumerate(cubes):
        clean, unjudged = prepared(name, bits)
        for column, severity in enumerate(columns):
            top = 34 / (len(cubes) * WIDTH + 34)
            height = (1 - top) / len(cubes)
            place = (column / len(columns), 1 - top - (row + 1) * height, 1 / len(columns), height)
            axes = figure.add_axes(place)
            opacity = opacity_of(name)(np.random.default_rng([SEED, row]), clean, severity)
            axes.imshow(draw(clean, opacity, unjudged))
            axes.set_axis_off()
            if row == 0:
                title = "clean" if severity == 0 else f"severity {severity:g}"
                figure.text((column + 0.5) / len(columns), 1 - top / 2, title, ha="center", va="center", fontsize=12)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    small = Image.open(io.BytesIO(stream.getvalue())).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    stream = io.BytesIO()
    small.save(stream, format="png", optimize=True)
    return stream.getvalue()


def prepared(name: str, bits: Occupancy) -> tuple[Occupancy, Occupancy]:
    """The clean cube that a family starts from, and where nobody judges: recipes thicken surfaces to be softened."""
    if name != "soften":
        return bits, np.zeros_like(bits)
    clean = dilate(bits, Recipe().soft_dilation)
    return clean, dilate(clean, SOFT_SKIRT) & ~clean


def measure(name: str, cubes: list[Occupancy]) -> list[tuple[float, float]]:
    """For each of ``SEVERITIES`` the mean of (voxels whose occupancy changed / occupied ones, IoU with the clean)."""
    family, rows = opacity_of(name), []
    for severity in SEVERITIES:
        found = []
        for index, bits in enumerate(cubes):
            clean, unjudged = prepared(name, bits)
            noisy = family(np.random.default_rng([SEED, index]), clean, severity) > DEFAULT_OPACITY_THRESHOLD
            noisy &= ~unjudged
            found.append(((noisy ^ clean).sum() / clean.sum(), (noisy & clean).sum() / (noisy | clean).sum()))
        changed, overlap = np.mean(found, axis=0)
        rows.append((float(changed), float(overlap)))
    return rows


def clean_cubes() -> list[Occupancy]:
    """The first ``MEASURED`` cubes of the procedural recipe that hold more than 100 occupied voxels."""
    cubes: list[Occupancy] = []
    index = 0
    while len(cubes) < MEASURED:
        clean = sample_cube(np.random.default_rng([SEED, index]), Recipe())[0]
        index += 1
        if clean.sum() > 100:
            cubes.append(clean)
    return cubes


def first_paragraph(function: Callable[..., Any]) -> str:
    """Of its docstring, on one line."""
    return " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())


def page(measured: dict[str, list[tuple[float, float]]]) -> str:
    """The text of ``corruptions.md``."""
    heads = " | ".join(f"{severity:g}" for severity in SEVERITIES)
    lines = [INTRODUCTION, f"| family | {heads} |", "|---|" + "---|" * len(SEVERITIES)]
    for name, rows in measured.items():
        lines.append(f"| [{name}](#{name}) | " + " | ".join(f"{c:.2f} ({iou:.2f})" for c, iou in rows) + " |")
    for name in measured:
        function = soften if name == "soften" else CORRUPTIONS.get(name, corrupt)
        lines += ["", f"## {name}", "", f"{IMITATES[name]} {first_paragraph(function)}", ""]
        lines.append(f"![{name}: two cubes, clean and at five severities](corruptions/{name}.png)")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DOCS)
    out = parser.parse_args().out
    (out / "corruptions").mkdir(parents=True, exist_ok=True)
    cubes, measured = clean_cubes(), dict[str, list[tuple[float, float]]]()
    for name in IMITATES:
        (out / "corruptions" / f"{name}.png").write_bytes(draw_family(name))
        measured[name] = measure(name, cubes)
        print(name, " ".join(f"{changed:.2f} ({iou:.2f})" for changed, iou in measured[name]))
    (out / "corruptions.md").write_text(page(measured), encoding="utf-8")


if __name__ == "__main__":
    main()
