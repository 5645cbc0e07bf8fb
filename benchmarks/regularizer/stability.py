"""What the regularizer and ``clean`` do with hostile numbers, and how far they are from float64.

Prints the table of ``docs/stability.md``; every row checks the behaviour that it states. Those about a single loss are
in ``losses.py``, those about sight lines in ``line_cases.py``.

    python -m benchmarks.regularizer.stability
    python -m benchmarks.regularizer.stability --short      float32 alone
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from unghost.cleaning.pipeline import clean, judge
from unghost.core.cameras import Cameras
from unghost.core.manifest import Manifest
from unghost.core.occupancy import OccupancyRule
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.losses import dsds_loss, stable_mean
from unghost.regularizer.visibility import ViewCounter

from ..options import BenchmarkOptions, parse
from ..progress import say
from .line_cases import LINE_CASES
from .losses import BRAIN, LOSS_CASES, SINGLE, TYPES, Case, largest, refuses, relative, smallest

BOX = np.array([[-1.0] * 3, [1.0] * 3])
PITCH = 0.0625
TARGET = -math.log1p(-0.1)  # by hand: up to which is filled by default


class Fixed:
    """A denoiser that says the same everywhere, or, with None, what it was shown."""

    kind = "numpy"
    manifest = Manifest("fixed")

    def __init__(self, value: float | None) -> None:
        self.value = value

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> Any:
        """Denoise."""
        return channels if self.value is None else np.full_like(channels, self.value)


def cameras(unit: float = 1.0) -> Cameras:
    pose = np.eye(4)[None, :3].repeat(2, axis=0)
    pose[1, :, 3] = 0.5 * unit
    return Cameras.create(pose, np.array([50.0] * 4), 100, 100)


def build(value: float | None, *, unit: float = 1.0, **settings: Any) -> DensityRegularizer:
    options = {"cubes": 2, "dsds_weight": 1.0, "visibility_weight": 1.0, "skip_empty": False, **settings}
    options.setdefault("field_pitch", PITCH * unit)
    return DensityRegularizer(Fixed(value), aabb=BOX * unit, **options)


def everywhere(positions: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
    """A field of one density."""
    return level.expand(len(positions))


def constant(value: float, dtype: torch.dtype) -> float:
    """Worst relative error of both losses and both halves on a field of one value."""
    errors = []
    exact = torch.tensor(value, dtype=dtype).double().item()
    depth = exact * PITCH
    for answer, expected in ((-1.0, depth), (1.0, max(TARGET - depth, 0.0))):
        level = torch.tensor(value, dtype=dtype, requires_grad=True)
        regularizer = build(answer, cameras=cameras())
        losses = regularizer(partial(everywhere, level=level))
        share = regularizer.report["unseen"] / regularizer.report["points"]
        total = losses["dsds"] + losses["visibility"]
        total.backward()
        assert torch.isfinite(total)
        assert level.grad is not None
        assert torch.isfinite(level.grad)
        errors += [relative(losses["dsds"].item(), expected), relative(losses["visibility"].item(), depth * share)]
    return max(errors)


def raises(value: float, dtype: torch.dtype) -> None:
    """The error counts and names; dropping counts."""

    def field(p: Any) -> Any:
        return torch.where(p[:, 0] > 0.5, value, 1.0).to(dtype)

    refuses(lambda: build(None)(field), ValueError, "; first")
    refuses(lambda: clean(field, BOX, denoiser=Fixed(None), resolution=16, backend="torch"), ValueError, "; first")
    dropping = build(None, drop_invalid=True)
    assert torch.isfinite(dropping(field)["dsds"])
    assert dropping.report["dropped"] > 0


def filled(positions: Any, dtype: Any) -> Any:
    """Ones of a numpy type."""
    return np.ones(len(positions), dtype)


def no_densities(dtype: torch.dtype) -> None:
    """Truth values, complex numbers, text: refused; ``clean`` alone, which needs no gradient, takes integers."""
    for kind in (torch.bool, torch.complex64, torch.int64):
        refuses(partial(build(None), partial(everywhere, level=torch.ones((), dtype=kind))), TypeError, f"got {kind}")
    for made in (np.bool_, np.complex64, np.str_):
        field = partial(filled, dtype=made)
        cleaning = partial(clean, field, BOX, denoiser=Fixed(None), resolution=16)
        refuses(cleaning, TypeError, "integers or floating-point")
    clean(lambda p: np.full(len(p), 3), BOX, denoiser=Fixed(None), resolution=16)


def elsewhere(dtype: torch.dtype) -> None:
    refuses(lambda: build(None)(lambda p: torch.empty(len(p), dtype=dtype, device="meta")), ValueError, "cpu, got meta")


def warns(level: torch.Tensor, text: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        build(0.0)(partial(everywhere, level=level))
    assert sum(text in str(warning.message) for warning in caught) == 1


def smooth(p: Any) -> Any:
    return 40.0 * torch.sigmoid(12.0 * (0.6 - p.norm(dim=-1)))


def rounded(p: Any, dtype: torch.dtype) -> Any:
    """The smooth field, its densities rounded to a type."""
    return smooth(p.double()).to(dtype)


def precision(dtype: torch.dtype) -> float:
    """Both losses of a smooth field whose densities are rounded to ``dtype``, against float64."""
    totals = []
    for kind in (dtype, torch.float64):
        losses = build(None, cameras=cameras())(partial(rounded, dtype=kind))
        totals.append(sum(loss.item() for loss in losses.values()))
    return relative(*totals)


def unit(factor: float) -> float:
    """The losses in a scene ``factor`` times as large, against the same scene in unit size."""
    ours = build(None, unit=factor, cameras=cameras(factor))(lambda p: smooth(p.double() / factor) / factor)
    theirs = build(None, cameras=cameras())(lambda p: smooth(p.double()))
    return max(relative(ours[name].item(), theirs[name].item()) for name in theirs)


def far_away() -> float:
    """A box of side 2 at 1e5: float32 positions lie on a lattice of 1/128."""
    middle = np.array([1e5, 0.0, 0.0])
    moved = DensityRegularizer(
        Fixed(None), aabb=BOX + middle, field_pitch=PITCH, cubes=2, dsds_weight=1.0, skip_empty=False
    )
    ours = moved(lambda p: smooth(p.double() - torch.from_numpy(middle)))["dsds"].item()
    return relative(ours, build(None)(lambda p: smooth(p.double()))["dsds"].item())


def cleaned(dtype: torch.dtype) -> float:
    """Scores of a smooth field whose densities are rounded to ``dtype``, against float64; the masks agree."""
    kinds = (dtype, torch.float64)
    ours, exact = (
        judge(partial(rounded, dtype=kind), BOX, denoiser=Fixed(None), resolution=32, backend="torch") for kind in kinds
    )
    assert (ours.mask().cells == exact.mask().cells).mean() > 0.999
    return float(np.abs(ours.score.astype(float) - exact.score).max())


def outside(dtype: torch.dtype) -> float:
    """An edge twice the box: 7/8 of the voxels outside, never asked, not in the mean."""
    regularizer = build(-1.0, edge_range=(2.0, 2.0))

    def field(p: Any) -> Any:
        assert (p.abs() <= 1).all()
        return torch.full((len(p),), 3.0, dtype=dtype)

    loss = regularizer(field)["dsds"].item()
    assert regularizer.report["outside"] == 2 * 32**3 * 7 // 8
    return relative(loss, 3.0 * PITCH)


def camera_inside(dtype: torch.dtype) -> float:
    """Cubes that hold both cameras' centres: as any other cube."""
    regularizer = build(-1.0, cameras=cameras(), edge_range=(1.0, 1.0))
    losses = regularizer(lambda p: torch.full((len(p),), 3.0, dtype=dtype))
    assert torch.isfinite(losses["visibility"])
    return relative(losses["dsds"].item(), 3.0 * PITCH)


def camera_plane() -> None:
    points = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0, 1], [0, 0, -1e-300], [0, 0, -1e30], [0, 0, -1]])
    assert ViewCounter(cameras().select([0]))(points).tolist() == [0, 0, 0, 1, 1, 1]


def uniform_cube(value: float, answer: float, dtype: torch.dtype) -> float:
    def field(p: Any) -> Any:
        return torch.full((len(p),), value, dtype=dtype)

    depth = field([0]).double().item() * PITCH
    loss = build(answer)(field)["dsds"].item()
    mask = clean(field, BOX, denoiser=Fixed(answer), resolution=16, backend="torch")
    assert mask.cells.any() == mask.cells.all() != (value > 0 and answer < 0)
    return relative(loss, depth if answer < 0 else max(TARGET - depth, 0.0))


def timestep(step: int, dtype: torch.dtype) -> float:
    def field(p: Any) -> Any:
        return torch.full((len(p),), 0.625, dtype=dtype)

    loss = build(None, timestep=step)(field)["dsds"].item()
    clean(field, BOX, denoiser=Fixed(None), resolution=16, timestep=step, backend="torch")
    return relative(loss, 0.625 * PITCH)  # opacity .04: shown as -.93, hence pushed out


def nothing() -> None:
    losses = build(None, cubes=0, visibility_samples=0, cameras=cameras())(smooth)
    assert not any(loss.item() for loss in losses.values())
    empty = torch.zeros(0, 1, 32, 32, 32)
    assert stable_mean(dsds_loss(empty, empty, target_density=1.0)).item() == 0.0


def huge_sum(dtype: torch.dtype) -> float:
    """The paper's rule, raw densities: the sum overflows float32, the mean does not."""
    regularizer = build(-1.0, rule=OccupancyRule.paper())
    loss = regularizer(lambda p: torch.full((len(p),), largest(dtype), dtype=dtype))["dsds"].item()
    return relative(loss, largest(dtype))


FINITE = "finite losses and gradients"
CASES = [
    Case("density 0 everywhere", FINITE, lambda t: constant(0.0, t)),
    Case("the smallest subnormal densities", FINITE, lambda t: constant(smallest(t), t)),
    Case("density 1e-30", FINITE, lambda t: constant(1e-30, t), BRAIN),
    Case("density 2", FINITE, lambda t: constant(2.0, t)),
    Case("density 1e30", FINITE, lambda t: constant(1e30, t), BRAIN),
    Case("the largest density (3.4e38; 65504)", FINITE, lambda t: constant(largest(t), t)),
    Case("the same under the paper's rule (raw densities)", FINITE, huge_sum),
    Case(
        "density NaN",
        "`ValueError` with count and first position; `drop_invalid=True` leaves them out and counts",
        lambda t: raises(math.nan, t),
    ),
    Case("density inf", "the same", lambda t: raises(math.inf, t)),
    Case("density −1", "the same", lambda t: raises(-1.0, t)),
    Case(
        "densities that are truth values, complex or text",
        "`TypeError` with the dtype; integers too, but for `clean`, which needs no gradient",
        no_densities,
        SINGLE,
    ),
    Case("densities on another device than the positions", "`ValueError` with both", elsewhere),
    Case(
        "the same density at every place of the box",
        "`UserWarning`, once: does the callable use its positions?",
        lambda t: warns(torch.tensor(2.0, dtype=t, requires_grad=True), "does it use its positions"),
    ),
    Case(
        "densities without a gradient where one is wanted",
        "`UserWarning`, once: detached, frozen, under `no_grad`?",
        lambda t: warns(torch.tensor(2.0, dtype=t), "without a gradient"),
    ),
    Case(
        "a smooth field", "half precision is upcast to float32: the error is the rounding of the densities", precision
    ),
    Case("`clean` of a smooth field", "as above; largest difference of a score in [−1, 1]", cleaned),
    Case("scene unit × 1e6", "the same losses (opacity rule)", lambda _: unit(1e6), SINGLE),
    Case("scene unit × 1e-6", "the same losses (opacity rule)", lambda _: unit(1e-6), SINGLE),
    Case(
        "a box 1e5 units from the origin",
        "positions are float32: rounded to 1/128 unit there; move the scene",
        lambda _: far_away(),
        SINGLE,
    ),
    Case("a cube sticking out of the box (7/8 of it)", "shown as empty there, never asked, not in the mean", outside),
    Case("a camera centre inside a cube", "as any other cube", camera_inside),
    Case(
        "points on or behind the camera plane",
        "unseen; exactly on the plane, at the centre too, is unseen",
        lambda _: camera_plane(),
        SINGLE,
    ),
    Case("an all-empty cube, answer empty", "loss 0, nothing removed", lambda t: uniform_cube(0.0, -1.0, t)),
    Case("an all-empty cube, answer full", "filled up to w; `clean` never adds", lambda t: uniform_cube(0.0, 1.0, t)),
    Case("an all-full cube, answer full", "loss 0, nothing removed", lambda t: uniform_cube(1e4, 1.0, t)),
    Case(
        "an all-full cube, answer empty",
        "all of it pushed out, all of it removed",
        lambda t: uniform_cube(1e4, -1.0, t),
    ),
    Case("t = 0", FINITE, lambda t: timestep(0, t)),
    Case("t = 999", FINITE, lambda t: timestep(999, t)),
    Case("a batch of 0: no cubes, no points", "exactly 0", lambda _: nothing(), SINGLE),
    *LOSS_CASES,
    *LINE_CASES,
]

HEAD = ("| input | behaviour | float32 | float16 | bfloat16 |", "|---|---|---|---|---|")


def measured(case: Case, dtype: torch.dtype) -> str:
    """One cell of the table; a dash where there is no number, or the case is not about that dtype."""
    error = case.check(dtype) if dtype in case.types else None
    return "–" if error is None else f"{error:.1e}"


def row_of(case: Case, types: Sequence[torch.dtype]) -> str:
    """One row of the table; runs its checks in ``types``."""
    cells = [measured(case, dtype) if dtype in types else "–" for dtype in TYPES]
    return f"| {' | '.join([case.given, case.behaviour, *cells])} |"


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to check: every row, in float32 alone if short; nothing is written."""


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    warnings.filterwarnings("ignore", message=".*density_fn returned")  # constant fields, on purpose
    say("\n".join(HEAD))
    for case in CASES:
        say(row_of(case, SINGLE if options.short else TYPES))
    say(f"\n{len(CASES)} rows hold; they belong into docs/stability.md")


if __name__ == "__main__":
    main()
