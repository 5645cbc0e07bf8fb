"""The verbs that make a capture for the two-trajectory protocol, and hand one on to nerfstudio."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from ..core.errors import InvalidArgument, MissingExtra
from ..core.progress import StagedProgress
from ..core.sparse_points import LEAST_ANGLE, MOST_ERROR
from ..evaluation.captures.posing import OVERLAP, PosingSettings
from .options import given, options_of

if TYPE_CHECKING:
    PosingOptions = PosingSettings
else:
    PosingOptions = options_of(PosingSettings)


def capture(
    train: Positional[Annotated[Path, arg(metavar="TRAIN")]],
    evaluation: Positional[Annotated[Path, arg(metavar="EVALUATION")]],
    out: Path,
    frames: int = 100,
    plot: Path | None = None,
    options: Annotated[PosingOptions, arg(name="")] = PosingOptions(),  # noqa: B008 (frozen)
) -> None:
    """Make a capture from two videos (or two folders of photos): one to train on, one to be scored on.

    The sharpest frames are kept, both sweeps are posed together by COLMAP (on the CPU; 2 x 100 frames take half an
    hour or more on two cores), and the folder can be read by unghost and by stock nerfstudio. After a crash or Ctrl-C
    the same call goes on from what was computed, which is beside OUT.

    Args:
        train: video or folder of photos to train on.
        evaluation: the same, of another walk through the same scene, to be scored on.
        out: new folder: images, transforms.json (with nerfstudio's file lists), splits.json, capture.json, sparse/0.
        frames: kept of each sweep at most: the sharpest of each of so many equal stretches.
        plot: PNG for a bird's-eye view of both sweeps.
    """
    from ..evaluation.captures.creation import make_capture

    settings = PosingSettings(**given(options))
    if plot is not None:
        _check_plot(plot, "capture")
    with StagedProgress("photo", leave=True) as bars:

        def progress(stage: str, done: int, total: int) -> None:
            bars(done, total, stage=stage, unit={"pairs": "pair", "joining": "step"}.get(stage, "photo"))

        try:
            told = make_capture(train, evaluation, out, frames=frames, settings=settings, progress=progress)
        except KeyboardInterrupt:
            print(f"what was computed is kept beside {out}: the same call goes on from there", file=sys.stderr)
            raise
    for sweep in ("train", "eval"):
        each = told[sweep]
        print(f"{sweep}: {each['seen']} pictures in {each['source']}, {each['kept']} kept, {each['posed']} posed")
    if told["unposed"]:
        print(f"without a pose, and left out: {', '.join(told['unposed'])}")
    print(f"poses by {told['mapping']}")
    print(f"reprojection error {told['reprojection_error']:.2f} pixels, {told['points']} points")
    posed, _ = _read(out, None, "error", None)
    _report(posed, *_sweeps(posed, None, None), plot)
    print(f"{out}: ns-train nerfacto --data {out}")


def convert(
    capture: Positional[Annotated[Path, arg(metavar="CAPTURE")]],
    out: Path | None = None,
    train_split: str | None = None,
    eval_split: str | None = None,
    every: int | None = None,
    splits: Path | None = None,
    photos: Path | None = None,
    missing: Literal["error", "drop"] = "error",
    link: bool = False,
    plot: Path | None = None,
) -> None:
    """Say how hard a capture's evaluation is and, with --out, write it as stock nerfstudio reads it.

    Reads transforms.json folders (the released Nerfbusters captures with their frame_1_... names too),
    transforms_train.json and its siblings, and COLMAP models. Writes photos, poses, and the train, val and test lists
    that override nerfstudio's --eval-mode; masks, depths and points that transforms.json names go along.

    Args:
        capture: folder with transforms.json, or with a COLMAP model in sparse/0 and photos in images.
        out: new folder to write; without it, nothing is written but what --plot asks for.
        train_split: the sweep to train on: "train" unless told otherwise; "all" is every photo.
        eval_split: the sweep to be scored on: "eval", else "test" or "val", unless told otherwise.
        every: in place of eval_split: hold out every so many-th photo of train_split (8 is what most papers do).
        splits: JSON file of sweeps, {"name": ["images/a.jpg", ...], ...}, in place of what the capture says.
        photos: folder that holds the photos, if they are not where the capture says; smaller copies will do.
        missing: "drop" leaves photos out that are not there, and counts them.
        link: symbolic links to the photos instead of copies.
        plot: PNG for a bird's-eye view of both sweeps.
    """
    from ..evaluation.captures.difficulty import every_nth
    from ..evaluation.captures.nerfstudio import write_nerfstudio
    from ..evaluation.captures.splits import TRAIN_NAMES, choose_split

    if plot is not None:
        _check_plot(plot, "convert")
    if every is not None and eval_split is not None:
        raise InvalidArgument("convert: --every takes its photos from the training sweep: leave --eval-split out")
    if every is not None and every < 2:
        raise InvalidArgument(f"convert: --every must be >= 2, got {every}")
    posed, told = _read(capture, splits, missing, photos)
    print("\n".join(told), end="\n" if told else "")
    if every is None:
        train, evaluation = _sweeps(posed, train_split, eval_split)
    else:
        whole = posed.split(choose_split(posed.splits, train_split, TRAIN_NAMES, "--train-split"))
        taught, held_out = every_nth(len(whole), n=every)
        train, evaluation = whole[taught], whole[held_out]
    both = len({*train.tolist(), *evaluation.tolist()})
    print(f"{len(train)} photos to train on, {len(evaluation)} to be scored on, {len(posed) - both} in neither")
    if both < len(train) + len(evaluation):
        print(f"{len(train) + len(evaluation) - both} photos are in both sweeps: they were trained on")
    _report(posed, train, evaluation, plot, held_out=every)
    if out is not None:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            write_nerfstudio(posed, out, train=train, evaluation=evaluation, photos="link" if link else "copy")
        print("".join(f"{each.message}\n" for each in caught), end="")
        print(f"{out}: ns-train nerfacto --data {out}")


def points(
    capture: Positional[Path],
    photos_of: str = "train",
    out: Path | None = None,
    splits: Path | None = None,
    matching: Literal["exhaustive", "sequential"] = "exhaustive",
    overlap: int = OVERLAP,
    most_error: float = MOST_ERROR,
    least_angle: float = LEAST_ANGLE,
    longest_side: int = 1600,
    seed: int = 0,
    threads: int = 0,
) -> None:
    """Triangulate sparse points from the photos of one sweep alone, with the poses that the capture has.

    Two dozen photos take under a minute on two cores. Nothing of other photos is read, so the points may be used to
    train what is then scored on another sweep.

    Args:
        capture: folder with transforms.json or a COLMAP model, and photos.
        photos_of: the sweep; all for every photo.
        out: new folder for the COLMAP model; CAPTURE/sparse/unghost-SWEEP if not given.
        splits: JSON of the sweeps, as for convert.
        matching: exhaustive matches every pair, whatever their number; sequential is for hundreds of photos that stand
            in the order in which they were taken.
        overlap: of sequential matching: each photo is matched with so many next ones, and those 2, 4, 8, ... further.
        most_error: points with a larger mean reprojection error are dropped (pixels of the stored photos).
        least_angle: points whose rays all meet under a smaller angle are dropped (degrees).
        longest_side: features are looked for in photos shrunk to this many pixels. Smaller is faster.
        seed: of COLMAP's random choices.
        threads: 0 for one per core.
    """
    from ..evaluation.captures.loading import load_capture
    from ..evaluation.captures.points import points_folder
    from ..evaluation.captures.triangulation import triangulate

    posed = load_capture(capture, splits=splits)
    chosen = posed.split(photos_of)
    target = out or points_folder(capture, photos_of)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InvalidArgument(f"points: {target} is there already: remove it, or choose another --out")
    dropped: list[str] = []
    with StagedProgress("photo", leave=True) as bars:

        def progress(stage: str, done: int, total: int) -> None:
            bars(done, total, stage=stage, unit={"pairs": "pair", "points": "step"}.get(stage))

        found = triangulate(
            posed,
            chosen,
            out=target,
            matching=matching,
            overlap=overlap,
            most_error=most_error,
            least_angle=least_angle,
            longest_side=longest_side,
            seed=seed,
            threads=threads,
            progress=progress,
            log=dropped.append,
        )
    print("\n".join(dropped))
    print(f"{len(found)} points, {len(found.point)} observations by {len(chosen)} photos of {photos_of}: {target}")


def _check_plot(path: Path, verb: str) -> None:
    """Before minutes are spent: the picture can be drawn."""
    import importlib.util

    if path.suffix.lower() != ".png":
        raise InvalidArgument(f"{verb}: --plot must end in .png, got {path}")
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtra(f"{verb}: --plot needs matplotlib: pip install unghost[capture]")


def _read(folder: Path, splits: Path | None, missing: str, photos: Path | None) -> tuple[Any, list[str]]:
    """The capture as it is stored, and what reading it gave to say."""
    from ..evaluation.captures.loading import load_capture

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        posed = load_capture(folder, downscale=1, normalize=False, splits=splits, missing=missing, photos=photos)
    return posed, [str(each.message) for each in caught]


def _sweeps(posed: Any, train: str | None, evaluation: str | None) -> tuple[Any, Any]:
    from ..evaluation.captures.splits import EVAL_NAMES, TRAIN_NAMES, choose_split

    return (
        posed.split(choose_split(posed.splits, train, TRAIN_NAMES, "--train-split")),
        posed.split(choose_split(posed.splits, evaluation, EVAL_NAMES, "--eval-split")),
    )


def _report(posed: Any, train: Any, evaluation: Any, plot: Path | None, *, held_out: int | None = None) -> None:
    """Print the difficulty, and draw the sweeps if asked to; ``held_out``: the evaluation is every so many-th photo."""
    from ..evaluation.captures.birds_eye import draw_birds_eye
    from ..evaluation.captures.difficulty import difficulty_rows, difficulty_text

    taught, scored = posed.cameras.select(train), posed.cameras.select(evaluation)
    rows = difficulty_rows(taught, scored)
    heading = "the other sweep" if held_out is None else f"every {held_out}th training photo"
    if held_out is not None:
        rows = [{**rows[0], "method": heading}]
    print(difficulty_text(rows))
    if plot is not None:
        beside = 8 if held_out is None else None
        title = posed.folder.resolve().name
        draw_birds_eye(plot, taught, scored, title=title, heading=f"scored on {heading}", n=beside)
        print(plot)
