"""What `clean` costs: speed against error of its settings, empty space, and memory against the number of cameras.

    python -m benchmarks.cleaning.cost

Demo rooms that neither a threshold nor a picture has seen, every ghost labelled; a row for each setting that is
changed from the defaults. Then the same room in a box twice as long whose other half is empty, with and without
skipping; and the most memory that a fresh process holds while it cleans, or takes a step of score distillation, with
more and more cameras. Writes docs/results/cleaning.json.
"""

from __future__ import annotations

import multiprocessing
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from unghost import load_denoiser
from unghost.cleaning.pipeline import clean
from unghost.core.cameras import Cameras
from unghost.core.results import build_results, write_results
from unghost.demo.run import score
from unghost.denoisers import shipped_names
from unghost.fields.adapters.grids import cell_centers, grid_density_fn
from unghost.scenes.labelled_room.room import AABB, SHAPE, Room, build_room

from ..options import BenchmarkOptions, parse
from ..progress import say, wrote
from ..timing import median_seconds

SETTINGS: dict[str, dict[str, Any]] = {
    "cells only": {"level_weights": (1.0,)},
    "twice the cell only": {"level_weights": (0.0, 1.0)},
    "up to four times the cell": {"level_weights": (1.0, 0.5, 0.25)},
    "no overlap": {"overlap": 0.0},
    "overlap .25": {"overlap": 0.25},
    "overlap .75": {"overlap": 0.75},
    "bits": {"soft": False},
}


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to time.

    Attributes:
        seeds: of the rooms.
        repeats: of the empty-space rows, of which the median is taken.
        settings: rows of settings changed from the defaults.
        cameras: how many, of each memory row.
    """

    SHORT: ClassVar[dict[str, Any]] = {"seeds": (30,), "repeats": 1, "settings": tuple(SETTINGS)[:5], "cameras": (10,)}

    seeds: tuple[int, ...] = (30, 31, 32)
    repeats: int = 3
    settings: tuple[str, ...] = tuple(SETTINGS)
    cameras: tuple[int, ...] = (10, 100, 1000)


def setting_row(method: str, name: str, rooms: list[Room], threads: int, **settings: Any) -> dict[str, Any]:
    """Mean scores of the rooms and the median of the seconds."""
    denoiser, found, seconds = load_denoiser(name, threads=threads), [], []
    for room in rooms:
        begun = time.perf_counter()
        mask = clean(grid_density_fn(room.density, AABB), AABB, denoiser=denoiser, field_pitch=room.pitch, **settings)
        seconds.append(time.perf_counter() - begun)
        found.append(
            score(room, np.asarray(mask.keep(cell_centers(AABB, SHAPE)))) | {"windows": mask.details["windows"]}
        )
    keys = ("floater_recall", "floater_precision", "surface_kept", "iou_before", "iou", "windows")
    row = {"method": method, "denoiser": name, "seconds": statistics.median(seconds)}
    row |= {key: float(np.mean([scores[key] for scores in found])) for key in keys}
    say(f"{method:28s} {row['floater_recall']:.3f} removed, {row['surface_kept']:.3f} kept, {row['seconds']:.1f} s")
    return row


def empty_rows(room: Room, options: Options) -> list[dict[str, Any]]:
    """A room, without skipping what is empty, and in a box twice as long of which it fills one half."""
    denoiser, field = load_denoiser(threads=options.threads), grid_density_fn(room.density, AABB)
    box = np.array(AABB)
    longer = np.stack([box[0], [2 * box[1, 0] - box[0, 0], *box[1, 1:]]])
    every: dict[str, Any] = {"skip_empty": False, "probe": 1}
    ways = {
        "the room": (box, {}),
        "the room, nothing skipped": (box, every),
        "a box twice as long": (longer, {}),
        "a box twice as long, nothing skipped": (longer, every),
    }
    rows: list[dict[str, Any]] = []
    places, kept = cell_centers(AABB, SHAPE), dict[str, Any]()
    for method, (aabb, settings) in ways.items():

        def work(aabb: Any = aabb, settings: Any = settings) -> Any:
            return clean(field, aabb, denoiser=denoiser, field_pitch=room.pitch, **settings)

        seconds, mask = median_seconds(work, options.repeats)
        kept[method] = np.asarray(mask.keep(places))
        rows.append(
            {
                "method": method,
                "seconds": seconds,
                "times_the_room": seconds / rows[0]["seconds"] if rows else 1.0,
                "windows": mask.details["windows"],
                "asked": mask.details["asked"],
                "cells_that_differ": float((kept[method] != kept["the room"]).mean()),
            }
        )
        last = rows[-1]
        say(
            f"{method}: {seconds:.2f} s, {last['windows']} windows, {last['cells_that_differ']:.2%} of the cells differ"
        )
    return rows


def ring(count: int) -> Cameras:
    """Cameras in a room, looking out in a circle."""
    angles = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    poses, middle = np.zeros((count, 3, 4)), np.asarray(AABB).mean(axis=0)
    back = np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], back.shape)
    poses[:, :, 0], poses[:, :, 1], poses[:, :, 2], poses[:, :, 3] = np.cross(up, back), up, back, middle
    return Cameras.create(poses, np.array([500.0, 500.0, 320.0, 240.0]), 640, 480)


def _most_memory(what: str, count: int, pipe: Any) -> None:
    """In a process of its own: megabytes held at most, beyond what was held before."""
    room = build_room(30)
    field, denoiser, cameras = grid_density_fn(room.density, AABB), load_denoiser("views", threads=2), ring(count)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # forget the peak so far
    before = _peak_megabytes()
    if what == "clean":
        clean(field, AABB, denoiser=denoiser, field_pitch=room.pitch, cameras=cameras)
    else:
        from unghost.regularizer.density_regularizer import DensityRegularizer

        from ..regularizer.grid_field import GridField

        torch_field = GridField(room.density, room.pitch)
        regularizer = DensityRegularizer(denoiser, aabb=AABB, cameras=cameras, field_pitch=room.pitch)
        for _ in range(3):
            sum(regularizer(torch_field).values()).backward()  # type: ignore[union-attr]
    pipe.send(_peak_megabytes() - before)


def _peak_megabytes() -> float:
    """The most memory that this process has held (Linux)."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


def memory_rows(cameras: tuple[int, ...]) -> list[dict[str, Any]]:
    """Each in a fresh process."""
    rows: list[dict[str, Any]] = []
    context = multiprocessing.get_context("spawn")
    for what in ("clean", "dsds and visibility step"):
        for count in cameras:
            ours, theirs = context.Pipe()
            process = context.Process(target=_most_memory, args=(what, count, theirs))
            process.start()
            megabytes = ours.recv()
            process.join()
            rows.append({"method": f"memory, {what}", "cameras": count, "peak_megabytes": megabytes})
            say(f"{what}, {count} cameras: {megabytes:.0f} MB")
    return rows


def main() -> None:
    options = parse(Options, __doc__)
    rooms = [build_room(seed) for seed in options.seeds]
    setting_row("warm-up", "default", rooms[:1], options.threads)
    rows = [setting_row(f"clean, {name}", name, rooms, options.threads) for name in shipped_names()]
    rows.append(setting_row("clean, views, 40 cameras", "views", rooms, options.threads, cameras=ring(40)))
    for name in options.settings:
        rows.append(setting_row(f"clean, {name}", "default", rooms, options.threads, **SETTINGS[name]))
    rows += [*empty_rows(rooms[0], options), *memory_rows(options.cameras)]
    results = build_results(rows, command=options.command(), seeds=options.seeds, threads=options.threads)
    write_results(options.out / "cleaning.json", results)
    wrote(options.out / "cleaning.json")


if __name__ == "__main__":
    main()
