"""What the regularizer and ``clean`` do with hostile numbers, and how far they are from float64.

Prints the table of ``docs/stability.md``; every row checks the behaviour that it states.

    python benchmarks/stability.py
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from unghost.core.cameras import Cameras
from unghost.core.manifest import Manifest
from unghost.core.occupancy import OccupancyRule
from unghost.regularizer.clean import clean
from unghost.regularizer.losses import dsds_loss, stable_mean
from unghost.regularizer.regularizer import DensityRegularizer
from unghost.regularizer.rivals import free_space_loss, sparsity_loss, squash_density, total_variation_loss
from unghost.regularizer.visibility import ViewCounter

BOX = np.array([[-1.0] * 3, [1.0] * 3])
PITCH = 0.0625
TARGET = -math.log1p(-0.1)  # by hand: up to which is filled by default
LARGEST = float(np.finfo(np.float32).max)


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


def relative(measured: float, expected: float) -> float:
    return abs(measured - expected) / abs(expected) if expected else abs(measured)


def constant(value: float, dtype: torch.dtype = torch.float32) -> float:
    """Worst relative error of both losses and both halves on a field of one value."""
    errors = []
    exact = torch.tensor(value, dtype=dtype).double().item()
    depth = exact * PITCH
    for answer, expected in ((-1.0, depth), (1.0, max(TARGET - depth, 0.0))):
        level = torch.tensor(value, dtype=dtype, requires_grad=True)
        regularizer = build(answer, cameras=cameras())
        losses = regularizer(lambda p, level=level: level.expand(len(p)))
        share = regularizer.report["unseen"] / regularizer.report["points"]
        total = losses["dsds"] + losses["visibility"]
        total.backward()
        assert torch.isfinite(total)
        assert level.grad is not None
        assert torch.isfinite(level.grad)
        errors += [relative(losses["dsds"].item(), expected), relative(losses["visibility"].item(), depth * share)]
    return max(errors)


def raises(value: float) -> None:
    """The error counts and names; dropping counts."""

    def field(p: Any) -> Any:
        return torch.where(p[:, 0] > 0.5, torch.full_like(p[:, 0], value), torch.ones_like(p[:, 0]))

    for run in (
        lambda: build(None)(field),
        lambda: clean(lambda p: field(torch.from_numpy(p)), BOX, denoiser=Fixed(None), resolution=16),
    ):
        message = ""
        try:
            run()
        except ValueError as error:
            message = str(error)
        assert "; first" in message, f"{value} was accepted, or its error does not say where: {message!r}"
    dropping = build(None, drop_invalid=True)
    assert torch.isfinite(dropping(field)["dsds"])
    assert dropping.report["dropped"] > 0


def warns(level: torch.Tensor, text: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        build(0.0)(lambda positions: level.expand(len(positions)))
    assert any(text in str(warning.message) for warning in caught)


def smooth(p: Any) -> Any:
    return 40.0 * torch.sigmoid(12.0 * (0.6 - p.norm(dim=-1)))


def precision(dtype: torch.dtype) -> float:
    """Both losses of a smooth field whose densities are rounded to ``dtype``, against float64."""
    totals = []
    for kind in (dtype, torch.float64):
        losses = build(None, cameras=cameras())(lambda p, kind=kind: smooth(p.double()).to(kind))
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


def outside() -> float:
    """An edge twice the box: 7/8 of the voxels outside, never asked, not in the mean."""
    regularizer = build(-1.0, edge_range=(2.0, 2.0))

    def field(p: Any) -> Any:
        assert (p.abs() <= 1).all()
        return torch.full((len(p),), 3.0)

    loss = regularizer(field)["dsds"].item()
    assert regularizer.report["outside"] == 2 * 32**3 * 7 // 8
    return relative(loss, 3.0 * PITCH)


def camera_inside() -> float:
    """Cubes that hold both cameras' centres: as any other cube."""
    regularizer = build(-1.0, cameras=cameras(), edge_range=(1.0, 1.0))
    losses = regularizer(lambda p: torch.full((len(p),), 3.0))
    assert torch.isfinite(losses["visibility"])
    return relative(losses["dsds"].item(), 3.0 * PITCH)


def camera_plane() -> None:
    points = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0, 1], [0, 0, -1e-300], [0, 0, -1e30], [0, 0, -1]])
    assert ViewCounter(cameras().select([0]))(points).tolist() == [0, 0, 0, 1, 1, 1]


def uniform_cube(value: float, answer: float) -> float:
    expected = value * PITCH if answer < 0 else max(TARGET - value * PITCH, 0.0)
    loss = build(answer)(lambda p: torch.full((len(p),), value, dtype=torch.float32))["dsds"].item()
    mask = clean(lambda p: np.full(len(p), value), BOX, denoiser=Fixed(answer), resolution=16)
    assert mask.cells.all() != (value > 0 and answer < 0)
    return relative(loss, expected)


def timestep(step: int) -> float:
    loss = build(None, timestep=step)(lambda p: torch.full((len(p),), 1.5))["dsds"].item()
    clean(lambda p: np.full(len(p), 3.0), BOX, denoiser=Fixed(None), resolution=16, timestep=step)
    return relative(loss, 1.5 * PITCH)  # opacity .09: shown as -.82, hence pushed out


def nothing() -> None:
    losses = build(None, cubes=0, visibility_samples=0, cameras=cameras())(smooth)
    assert [loss.item() for loss in losses.values()] == [0.0, 0.0]
    empty = torch.zeros(0, 1, 32, 32, 32)
    assert stable_mean(dsds_loss(empty, empty, target_density=1.0)).item() == 0.0


def half_gradient() -> None:
    """float16 densities: the gradient of one voxel in a million lies below float16's smallest number."""
    level = torch.full((1 << 20,), 2.0, dtype=torch.float16, requires_grad=True)
    stable_mean(dsds_loss(level, -torch.ones(len(level)), target_density=1.0)).backward()
    assert (level.grad == torch.tensor(2.0**-20, dtype=torch.float16)).all()
    level.grad = None
    (0.01 * stable_mean(dsds_loss(level, -torch.ones(len(level)), target_density=1.0))).backward()
    assert (level.grad == 0).all()


def huge_sum() -> float:
    """The paper's rule, raw densities: the sum overflows float32, the mean does not."""
    regularizer = build(-1.0, rule=OccupancyRule.paper())
    loss = regularizer(lambda p: torch.full((len(p),), LARGEST))["dsds"].item()
    return relative(loss, LARGEST)


def squash(how: Any) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda density: squash_density(density, threshold=0.01, how=how)


def rival(loss: Callable[[torch.Tensor], torch.Tensor], largest: float = LARGEST) -> float:
    """Densities of all magnitudes in float32 against float64; gradients are finite."""
    magnitudes = [0.0, 1e-45, 1e-30, 1e-3, 1.0, 30.0, 1e10, largest]
    generator = np.random.default_rng(0)
    single = torch.from_numpy(generator.choice(magnitudes, (6, 6, 6)).astype(np.float32)).requires_grad_()
    double = single.detach().double().requires_grad_()
    found, exact = loss(single), loss(double)
    stable_mean(found).backward()
    assert torch.isfinite(single.grad).all()
    difference = (found.detach().double() - exact.detach()).abs()
    return float((difference / exact.detach().abs().clamp(min=torch.finfo(torch.float32).tiny)).max())


@dataclass(frozen=True)
class Case:
    """One row: what goes in, what happens, and the check, which may return a relative error."""

    given: str
    behaviour: str
    check: Callable[[], float | None]


FINITE = "finite losses and gradients"
CASES = [
    Case("density 0 everywhere", FINITE, lambda: constant(0.0)),
    Case("subnormal densities (1e-45)", FINITE, lambda: constant(1e-45)),
    Case("density 1e-30", FINITE, lambda: constant(1e-30)),
    Case("density 2", FINITE, lambda: constant(2.0)),
    Case("density 1e30", FINITE, lambda: constant(1e30)),
    Case("density 3.4e38, the largest float32", FINITE, lambda: constant(LARGEST)),
    Case("the same under the paper's rule (raw densities)", FINITE, huge_sum),
    Case("density NaN", "`ValueError` with count and first position; `drop_invalid=True` leaves them out and counts",
         lambda: raises(math.nan)),
    Case("density inf", "the same", lambda: raises(math.inf)),
    Case("density −1", "the same", lambda: raises(-1.0)),
    Case("the same density at every place of the box", "`UserWarning`, once: does the callable use its positions?",
         lambda: warns(torch.tensor(2.0, requires_grad=True), "does it use its positions")),
    Case("densities without a gradient where one is wanted", "`UserWarning`, once: detached, frozen, under `no_grad`?",
         lambda: warns(torch.tensor(2.0), "without a gradient")),
    Case("float32 densities of a smooth field", FINITE, lambda: precision(torch.float32)),
    Case("float16 densities", "upcast to float32; the error is the rounding of the densities themselves",
         lambda: precision(torch.float16)),
    Case("bfloat16 densities", "the same", lambda: precision(torch.bfloat16)),
    Case("float16 densities, gradient", "a voxel's share of a mean over a million, times a weight, can underflow to 0 "
         "in float16: scale the loss (`GradScaler`) or give densities in float32", half_gradient),
    Case("scene unit × 1e6", "the same losses (opacity rule)", lambda: unit(1e6)),
    Case("scene unit × 1e-6", "the same losses (opacity rule)", lambda: unit(1e-6)),
    Case("a box 1e5 units from the origin", "positions are float32: rounded to 1/128 unit there; move the scene",
         far_away),
    Case("a cube sticking out of the box (7/8 of it)", "shown as empty there, never asked, not in the mean", outside),
    Case("a camera centre inside a cube", "as any other cube", camera_inside),
    Case("points on or behind the camera plane", "unseen; exactly on the plane, at the centre too, is unseen",
         camera_plane),
    Case("an all-empty cube, answer empty", "loss 0, nothing removed", lambda: uniform_cube(0.0, -1.0)),
    Case("an all-empty cube, answer full", "filled up to w; `clean` never adds", lambda: uniform_cube(0.0, 1.0)),
    Case("an all-full cube, answer full", "loss 0, nothing removed", lambda: uniform_cube(1e4, 1.0)),
    Case("an all-full cube, answer empty", "all of it pushed out, all of it removed", lambda: uniform_cube(1e4, -1.0)),
    Case("t = 0", FINITE, lambda: timestep(0)),
    Case("t = 999", FINITE, lambda: timestep(999)),
    Case("a batch of 0: no cubes, no points", "exactly 0", nothing),
    Case("total variation, densities 0 to 3.4e38", "finite, in float64; gradient 0 where nothing changes",
         lambda: rival(total_variation_loss)),
    Case("sparsity, densities 0 to 3.4e38", "between 0 and 1; small densities keep their digits (`expm1`)",
         lambda: rival(lambda d: sparsity_loss(d, length=0.05))),
    Case("free-space prior, densities 0 to 3.4e38", "between 1/2 and 1", lambda: rival(free_space_loss)),
    Case("densities squashed by a clamp", "between −1 and 1", lambda: rival(squash("clamp"))),
    Case("densities squashed by a sigmoid", "between −1 and 1.005", lambda: rival(squash("sigmoid"))),
]  # fmt: skip

HEAD = ("| input | behaviour | relative error against float64 |", "|---|---|---|")


def table(cases: list[Case]) -> list[str]:
    """Rows of the table; runs every check."""
    rows = []
    for case in cases:
        error = case.check()
        rows.append(f"| {case.given} | {case.behaviour} | {'–' if error is None else f'{error:.1e}'} |")
    return [*HEAD, *rows]


if __name__ == "__main__":
    warnings.filterwarnings("ignore", message=".*density_fn returned")  # constant fields, on purpose
    print("\n".join(table(CASES)))
