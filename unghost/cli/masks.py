"""The verb that says which pixels of an evaluation sweep show something that the training photos saw."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from ..core.errors import InvalidFile, needs_extra


def _depth_maps(path: Path, key: str) -> Any:
    """``(n, H, W)`` from a .npy, or from ``key`` of an .npz."""
    import numpy as np

    if not path.is_file():
        raise InvalidFile(f"masks: no file {path}")
    try:
        loaded = np.load(path, allow_pickle=False)
        values = loaded if isinstance(loaded, np.ndarray) else loaded[key]
    except KeyError:
        raise InvalidFile(f"masks: {path} holds {', '.join(loaded.files)}, but no {key!r}") from None
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise InvalidFile(f"masks: {path} is no .npy or .npz of numbers ({type(error).__name__})") from None
    if values.ndim != 3:
        raise InvalidFile(f"masks: {path} must hold depth (views, height, width), got shape {values.shape}")
    return values


def masks(
    capture: Positional[Path],
    depth: Path,
    out: Path,
    eval_split: str = "eval",
    train_split: str = "train",
    train_depth: Path | None = None,
    tolerance: float = 0.05,
    min_views: int = 1,
    downscale: float = 8.0,
    depth_along: Literal["ray", "axis"] = "ray",
    normalize: bool = True,
) -> None:
    """Visibility masks of the two-trajectory protocol, from depth and cameras alone.

    Args:
        capture: folder with transforms.json, its photos, and the sweeps (splits.json or nerfstudio's lists).
        depth: .npy, or .npz with "depth": (n, H, W) of the evaluation views, in the capture's (normalised) units; inf
            for no surface. From a field trained on all photos, or exact. Views that differ in size: each in the upper
            left corner of (H, W), inf beside it.
        out: folder for a white-on-black PNG a view, and masks.npz with all counts.
        eval_split: the sweep that is scored.
        train_split: the sweep that was trained on.
        train_depth: the same of the training views: a point that they have in view but something hides does not count.
        tolerance: relative, of that comparison.
        min_views: training views that must see a pixel's point.
        downscale: photo pixels per pixel of the depth maps, along each axis.
        depth_along: what the depth is measured along: the pixel's ray, or the camera's optical axis.
        normalize: the depth is in units in which the farthest camera coordinate is 1, not the file's: nerfstudio's
            units if its dataparser does not turn the scene (--orientation-method none).
    """
    import numpy as np

    with needs_extra("eval", caller="masks"):
        from PIL import Image

    from ..evaluation.captures.loading import load_capture
    from ..evaluation.scoring.depths import ray_depth
    from ..evaluation.scoring.pseudo_truth import make_pseudo_truth

    posed = load_capture(capture, downscale=downscale, normalize=normalize)
    views, taught = posed.split(eval_split), posed.split(train_split)
    cameras, train_cameras = posed.cameras.select(views), posed.cameras.select(taught)
    maps = _depth_maps(depth, "depth")
    beside = None if train_depth is None else _depth_maps(train_depth, "depth")
    if depth_along == "axis":
        maps = ray_depth(maps, cameras)
        beside = None if beside is None else ray_depth(beside, train_cameras)
    names = [posed.names[index] for index in views]
    details = {"depth": depth.name, "eval_split": eval_split, "train_split": train_split}
    truth = make_pseudo_truth(
        cameras, train_cameras, maps, train_depth=beside, tolerance=tolerance, names=names, details=details
    )
    visible = truth.visible(occlusion=beside is not None, minimum_views=min_views)
    out.mkdir(parents=True, exist_ok=True)
    truth.save(out / "masks.npz")
    seen = [mask[cameras.window(index)] for index, mask in enumerate(visible)]
    for name, mask in zip(names, seen):
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(out / f"{name.replace('/', '_')}.mask.png")
    coverage = np.array([mask.mean() for mask in seen])
    print(
        f"{len(views)} views, coverage {coverage.mean():.3f} (worst {coverage.min():.3f}, {names[coverage.argmin()]})"
    )
    print(f"{out / 'masks.npz'}, and a PNG a view")
