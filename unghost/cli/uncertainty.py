"""The verb that says which pixels of anyone's renders the training photos contradict."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from ..core.errors import InvalidArgument, InvalidFile, needs_extra

KIND = "uncertainty"


def doubt(
    renders: Positional[Path],
    gt: Path,
    train_renders: Path,
    eval_split: str | None = None,
    train_split: str | None = None,
    downscale: float = 1.0,
    depth_along: Literal["ray", "axis"] = "ray",
    normalize: bool = True,
    tolerance: float = 0.05,
    slack: float = 0.0,
    replace: bool = False,
) -> None:
    """Say which pixels not to trust, by the photos that were trained on; needs renders with depth, but no field.

    Writes RENDERS/uncertainty, a .npy a view (0: the photos that see the point have its colour; 1: none sees it) and a
    picture for people. `unghost evaluate` then scores the method as a curve over coverage.

    Args:
        renders: folder of the evaluation views: colour pictures, and depth maps in depth/ or maps.npz.
        gt: a capture (transforms.json): the photos and all cameras.
        train_renders: folder with the depth maps of the training views, rendered by the same field.
        eval_split: the sweep that was rendered; eval, test or val unless given.
        train_split: the sweep that was trained on; train unless given.
        downscale: photo pixels per pixel of the renders, along each axis.
        depth_along: what the depths are measured along: the pixel's ray, or the camera's optical axis.
        normalize: the depths are in units in which the farthest camera coordinate is 1, not the file's.
        tolerance: how far behind a photo's depth a point is still seen by it, and how far from it on either side still
            the same surface, as a share of it.
        slack: the same in the units of the depths, on top: two cells of the field's grid, if it has one.
        replace: uncertainty maps that are there already.
    """
    import numpy as np

    from ..evaluation.captures.loading import load_capture
    from ..evaluation.captures.splits import EVAL_NAMES, TRAIN_NAMES, choose_split
    from ..evaluation.scoring.depths import ray_depth
    from ..evaluation.scoring.renders import read_map, read_method
    from ..evaluation.scoring.views import pad_views
    from ..evaluation.uncertainty.photometric import UNSEEN, photo_doubt

    capture = load_capture(gt, downscale=downscale, normalize=normalize)
    views = capture.split(choose_split(capture.splits, eval_split, EVAL_NAMES, "doubt: --eval-split"))
    taught = capture.split(choose_split(capture.splits, train_split, TRAIN_NAMES, "doubt: --train-split"))
    names, photo_names = ([capture.names[index] for index in part] for part in (views, taught))
    cameras, photo_cameras = capture.cameras.select(views), capture.cameras.select(taught)
    _check_free(renders, replace)
    method = read_method(renders.resolve().name, renders, names, cameras.shapes)
    depth = _there(method.renders.depth, renders)
    photo_depth = _there(read_map(train_renders, "depth", photo_names, photo_cameras.shapes), train_renders)
    if depth_along == "axis":
        depth, photo_depth = ray_depth(depth, cameras), ray_depth(photo_depth, photo_cameras)
    padded = photo_doubt(
        method.renders.colours,
        depth,
        cameras,
        photos=pad_views([capture.images([index])[0] for index in taught], photo_cameras.canvas, 0.0),
        photo_depth=photo_depth,
        photo_cameras=photo_cameras,
        tolerance=tolerance,
        slack=slack,
    )
    found = [values[cameras.window(index)] for index, values in enumerate(padded)]
    short = [Path(name).name for name in names]
    for name, values in zip(short if len(set(short)) == len(short) else names, found):
        _write((renders / KIND / name).with_suffix(".npy"), values)
    every = np.concatenate([values.ravel() for values in found])
    seen = every[every < UNSEEN]
    median = f"; a doubt of {np.median(seen):.3f} in the median where one does" if seen.size else ""
    print(
        f"{len(names)} views, {len(photo_names)} photos: {seen.size / every.size:.3f} of the pixels show what one of "
        f"them sees{median}\n{renders / KIND}"
    )


def _there(depth: Any, folder: Path) -> Any:
    if depth is None:
        raise InvalidFile(f"doubt: {folder} holds no depth maps (depth/NAME.npy, or maps.npz with depth)")
    return depth


def _check_free(renders: Path, replace: bool) -> None:
    """Somebody's own uncertainties are not written over."""
    for kind in ("confidence", KIND):
        folder = renders / kind
        if folder.is_dir() and any(folder.iterdir()) and (kind != KIND or not replace):
            advice = "say --replace" if kind == KIND else "move it away"
            raise InvalidArgument(f"doubt: {folder} is there already; {advice}")


def _write(path: Path, values: Any) -> None:
    import numpy as np

    with needs_extra("eval", caller="doubt"):
        from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values)
    bright = np.round(255 * np.sqrt(np.clip(values, 0, 1))).astype(np.uint8)  # small differences are to be seen
    Image.fromarray(bright).save(path.with_suffix(".png"))
