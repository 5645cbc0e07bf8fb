"""What the regularizer costs: a step of score distillation, and the question which points no camera sees.

    python -m benchmarks.regularizer.cost CAPTURE
    python -m benchmarks.regularizer.cost --short       the rows that need no capture, with little to do

A step: 40 cubes of 32^3 of a fixed field (a room as a trilinear grid), with the shipped priors and with the paper's
U-Net (random weights: its time does not depend on them) in the same harness; the field's own answers are timed apart.
Visibility: 131,072 points in the box of a capture's cameras (its real, distorted lenses): every camera's exact test,
the way of nerfstudio's published visibility field (pinholes, float32, 50 cameras at a time in one batched matrix
product; our own writing of it), and ours with and without the cells that settle most points. Filling: holes torn into
a room (``filling.py``). What a step of our own field's training costs with it, on the capture's photos
(``overhead.py``). Writes docs/results/regularizer.json.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from unghost import load_denoiser
from unghost.core.cameras import Cameras
from unghost.core.manifest import Manifest
from unghost.core.results import build_results, write_results
from unghost.denoisers import shipped_names
from unghost.evaluation.captures.loading import load_capture
from unghost.prior.checkpoint import TorchDenoiser
from unghost.prior.networks.registry import build_network
from unghost.prior.networks.unet import UNetConfig
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.view_grid import ViewGrid
from unghost.regularizer.visibility import ViewCounter
from unghost.scenes.labelled_room.room import AABB, build_room

from ..options import CAPTURE, NOT_GIVEN, BenchmarkOptions, given, parse
from ..progress import say, wrote
from ..timing import median_seconds
from .filling import fill_row
from .grid_field import GridField
from .overhead import STEPS, WARM, overhead_rows

FILLING = ("default", "views")
UNET = "the paper's U-Net"


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to time.

    Attributes:
        capture: folder of a capture: whose cameras to count.
        repeats: of which the median is taken; the U-Net's step is run twice.
        points: whose visibility is counted.
        cubes: of a step.
        fill_steps: of an optimiser, of holes torn into a room.
        overhead_steps: of the own field's training before and while it is timed.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "repeats": 1,
        "points": 8192,
        "cubes": 2,
        "fill_steps": 1,
        "overhead_steps": (2, 2),
    }
    DATA: ClassVar[dict[str, str]] = {"capture": CAPTURE}
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ("capture",)

    capture: tyro.conf.Positional[Path] = NOT_GIVEN
    repeats: int = 9
    points: int = 131_072
    cubes: int = 40
    fill_steps: int = 300
    overhead_steps: tuple[int, int] = (WARM, STEPS)


def step_rows(options: Options) -> list[dict[str, Any]]:
    """A step of score distillation, forward and backward, by denoiser."""
    scene, rows = build_room(0), []
    room = GridField(scene.density, scene.pitch)
    denoisers: dict[str, Any] = {
        name: load_denoiser(name, backend="onnx", threads=options.threads) for name in shipped_names()
    }
    unet = build_network(UNetConfig())
    denoisers[UNET] = TorchDenoiser(unet, Manifest("unet", family="diffusion", default_timestep=50))
    cameras = load_capture(options.capture).cameras if given(options.capture) else None
    for name, denoiser in denoisers.items():
        rows.append(step_row(name, denoiser, room, options.cubes, 1 if name == UNET else options.repeats))
        if cameras is not None and len(denoiser.manifest.channels) > 1:  # the views of each voxel are counted, too
            told = step_row(name, denoiser, room, options.cubes, options.repeats, cameras)
            rows.append(told | {"method": f"{told['method']}, {len(cameras)} cameras", "cameras": len(cameras)})
        last = rows[-1]
        say(f"{last['method']}: {last['seconds']:.3f} s a step, {last['seconds_of_queries']:.3f} s of it the field's")
    return rows


def step_row(
    name: str, denoiser: Any, room: GridField, cubes: int, repeats: int, cameras: Cameras | None = None
) -> dict[str, Any]:
    """One denoiser; the field's forward and its share of the backward are timed without it, too."""
    regularizer = DensityRegularizer(
        denoiser,
        aabb=AABB,
        field_pitch=room.pitch,
        cubes=cubes,
        skip_empty=False,
        cameras=cameras,
        visibility_weight=0.0,
    )
    asked: list[torch.Tensor] = []

    def noted(positions: torch.Tensor) -> torch.Tensor:
        if torch.is_grad_enabled():  # what is asked for the channels' sake is not the field's share of the step
            asked.append(positions)
        density: torch.Tensor = room(positions)
        return density

    def step() -> None:
        room.zero_grad()
        asked.clear()
        regularizer(noted)["dsds"].backward()

    def queries() -> None:
        room.zero_grad()
        torch.cat([room(positions) for positions in asked]).mean().backward()

    seconds, _ = median_seconds(step, repeats)
    alone, _ = median_seconds(queries, repeats)
    return {
        "method": f"dsds step, {name}",
        "cubes": regularizer.settings.cubes,
        "seconds": seconds,
        "seconds_of_queries": alone,
        "seconds_beside": seconds - alone,
    }


def nerfstudio_count(cameras: Cameras, points: torch.Tensor) -> torch.Tensor:
    """Homogeneous points through 50 camera matrices at a time, 4,096 points at a time, lenses straight."""
    poses = torch.eye(4).repeat(len(cameras), 1, 1)
    poses[:, :3] = torch.from_numpy(cameras.camera_to_world).float()
    world_to_camera = torch.linalg.inv(poses)
    fx, fy, cx, cy = torch.from_numpy(cameras.intrinsics).float().T[:, :, None]
    total = torch.zeros(len(points), dtype=torch.int64)
    for start in range(0, len(points), 4096):
        part = torch.nn.functional.pad(points[start : start + 4096], (0, 1), value=1.0)
        for first in range(0, len(cameras), 50):
            batch = slice(first, first + 50)
            seen = torch.bmm(world_to_camera[batch], part.T.expand(len(world_to_camera[batch]), 4, -1))
            x, y, z = seen[:, 0], seen[:, 1], seen[:, 2]
            u, v = fx[batch] * x / -z + cx[batch], -fy[batch] * y / -z + cy[batch]
            inside = (z < 0) & (u >= 0) & (u < cameras.width) & (v >= 0) & (v < cameras.height)
            total[start : start + 4096] += inside.sum(dim=0)
    return total


def visibility_rows(options: Options) -> list[dict[str, Any]]:
    """Seconds for all points, tests a second, and how many answers differ from the exact ones."""
    cameras = load_capture(options.capture).cameras
    box = np.array([[-1.0] * 3, [1.0] * 3])
    points = np.random.default_rng(0).uniform(box[0], box[1], (options.points, 3))
    single, cached = torch.from_numpy(points).float(), ViewCounter(cameras, aabb=box)
    ways: dict[str, Callable[[], NDArray[Any]]] = {
        "every camera, exact": lambda: cameras.view_count(points),
        "nerfstudio's way": lambda: nerfstudio_count(cameras, single).numpy(),
        "ours, camera by camera": lambda: ViewCounter(cameras)(points),
        "ours, cells, built each time": lambda: ViewCounter(cameras, aabb=box)(points),
        "ours, cells": lambda: cached(points),
    }
    for levels in (1, 2, 4):
        ways[f"ours, cells of 1/{8 << (levels - 1)}, built each time"] = functools.partial(
            lambda levels: np.asarray(ViewGrid(cameras, box, min_views=1, levels=levels).count(points)), levels
        )
    for levels in (1, 2, 3, 4):  # a cell in which cameras disagree counts as seen
        grid = ViewGrid(cameras, box, min_views=1, levels=levels)
        ways[f"cells of 1/{8 << (levels - 1)} alone"] = functools.partial(
            lambda grid: grid.look_up(points)[0] != 0, grid
        )
    truth, rows = cameras.view_count(points) > 0, list[dict[str, Any]]()
    for name, way in ways.items():
        seconds, found = median_seconds(way, options.repeats)
        rows.append(
            {
                "method": f"visibility, {name}",
                "points": options.points,
                "cameras": len(cameras),
                "seconds": seconds,
                "tests_per_second": options.points * len(cameras) / seconds,
                "disagreement": float(((found > 0) != truth).mean()),
            }
        )
        say(
            f"{name}: {seconds * 1e3:.1f} ms, {rows[-1]['tests_per_second'] / 1e6:.0f} M tests/s, "
            f"{rows[-1]['disagreement']:.2%} differ"
        )
    return rows


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    rows = [*(visibility_rows(options) if given(options.capture) else []), *step_rows(options)]
    rows += [fill_row(name, steps=options.fill_steps, target=target) for target in (None, 0.9) for name in FILLING]
    if given(options.capture):
        warm, steps = options.overhead_steps
        rows += overhead_rows(options.capture, "default", threads=options.threads, warm=warm, steps=steps)
    results = build_results(rows, command=options.command(), seeds=[0], threads=options.threads)
    write_results(options.out / "regularizer.json", results)
    wrote(options.out / "regularizer.json")


if __name__ == "__main__":
    main()
