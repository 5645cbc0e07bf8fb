"""This project's conventions as evaluation protocols of nerfbaselines (1.2.12), which looks them up by its entry point.

A protocol scores one image at a time and averages afterwards. It takes its masks from the dataset (nerfbaselines'
``masks``: what counts), or, if the environment variable ``UNGHOST_MASKS`` names one, from the ``masks.npz`` of
``unghost masks``, matched by name; only the latter has the cameras and the pseudo depth that conventions with a depth
limit ask for. Depth is the prediction's: nerfbaselines' ``evaluate`` reads colours alone, so it is then fetched from
``depth/`` beside them.

nerfbaselines is needed for rendering only; nothing of it is imported before.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, InvalidFile
from ...evaluation.scoring.conventions import DEPTH_KEYS, NORMAL_KEYS, SceneExtent, get_convention
from ...evaluation.scoring.engine import score_scene
from ...evaluation.scoring.pseudo_truth import PseudoTruth, load_pseudo_truth
from ...evaluation.scoring.renders import match_names
from ...evaluation.scoring.views import Renders, Truth

MASKS_VARIABLE = "UNGHOST_MASKS"
NOT_TO_BE_HAD = ("lpips",)  # nerfbaselines has its own network and no way to ask for its map


class MaskedProtocol:
    """One convention as a protocol; subclasses say which.

    Attributes:
        convention: its name.
    """

    convention = "visible_only"

    def __init__(self) -> None:
        self.rule = get_convention(self.convention)
        path = os.environ.get(MASKS_VARIABLE)
        self.stored: PseudoTruth | None = load_pseudo_truth(path) if path else None

    def get_name(self) -> str:
        """What nerfbaselines stores: ``unghost-visible-only`` and so on."""
        return "unghost-" + self.convention.replace("_", "-")

    def render(self, method: Any, dataset: Any, *, options: Any = None) -> Any:
        """As nerfbaselines' own protocol renders one view."""
        from nerfbaselines.evaluation import DefaultEvaluationProtocol

        return DefaultEvaluationProtocol().render(method, dataset, options=options)

    def evaluate(self, predictions: Mapping[str, NDArray[Any]], dataset: Mapping[str, Any]) -> dict[str, float]:
        """Scores of one image.

        Args:
            predictions: ``color (H, W, 3)`` uint8, or floating point in [0, 1]; ``depth`` and ``accumulation (H, W)``.
            dataset: of nerfbaselines, with one image.

        Returns:
            The convention's metrics; those that are undefined (no pixel counts) or not to be had are left out.
            ``images_scored``: 1, or 0 if no pixel counts.

        Raises:
            ValueError: not one image, another size, or a map missing that the convention needs (named).
        """
        if len(dataset["images"]) != 1:
            raise InvalidArgument(f"{self.get_name()}: evaluate takes one image, got {len(dataset['images'])}")
        if dataset.get("metadata", {}).get("color_space", "srgb") != "srgb":
            raise InvalidArgument(
                f"{self.get_name()}: colours must be sRGB, got {dataset['metadata']['color_space']!r}"
            )
        photo = _colours(dataset["images"][0])
        name = _name(dataset)
        depth, accumulation = predictions.get("depth"), predictions.get("accumulation")
        if depth is None and self.rule.depth_limit is not None:
            depth = _stored_depth(dataset, name)
        renders = Renders(
            _colours(predictions["color"])[None], _one(depth), _one(accumulation)
        )  # a view of its own scene
        truth, extent = self._truth(photo[None], dataset, name)
        row = score_scene(renders, truth, extent, convention=self.convention, keys=self._keys(renders, truth)).images[0]
        scores = {key: float(row[key]) for key in self.rule.keys if row[key] is not None}
        return {**scores, "images_scored": float(row["pixels"] > 0)}

    def accumulate_metrics(self, metrics: Iterable[Mapping[str, float]]) -> dict[str, float]:
        """Means over the images where a metric is defined; ``images_scored`` is their number."""
        values: dict[str, list[float]] = {}
        for each in metrics:
            for key, value in each.items():
                values.setdefault(key, []).append(float(value))
        means = {key: float(np.mean(found)) for key, found in values.items()}
        return means | {"images_scored": float(sum(values.get("images_scored", [])))}

    def _truth(self, photo: NDArray[Any], dataset: Mapping[str, Any], name: str) -> tuple[Truth, SceneExtent | None]:
        if self.stored is None:
            masks = dataset.get("masks")
            visible = None if masks is None else _mask(masks[0])[None]
            return Truth(photo, visible, names=(name,)), None
        maps = self.stored
        (chosen,) = match_names("masks", maps.names, (name,), where=MASKS_VARIABLE, whole=False)
        index = maps.names.index(chosen)
        view = (slice(index, index + 1), *maps.eval_cameras.window(index))
        visible = maps.visible(occlusion=maps.seen_open is not None)[view]
        cameras = maps.eval_cameras.select([index])
        depth, normals = maps.depth[view], maps.normals[view]
        return Truth(photo, visible, depth, normals, cameras, (name,)), maps.extent

    def _keys(self, renders: Renders, truth: Truth) -> tuple[str, ...]:
        geometry = (*DEPTH_KEYS, *NORMAL_KEYS)
        known = renders.depth is not None and truth.depth is not None
        return tuple(key for key in self.rule.keys if key not in NOT_TO_BE_HAD and (known or key not in geometry))


class WholeImage(MaskedProtocol):
    """Every pixel counts."""

    convention = "whole_image"


class VisibleOnly(MaskedProtocol):
    """The pixels of the dataset's masks count."""

    convention = "visible_only"


class Proper(MaskedProtocol):
    """This project's masks and metrics; needs ``UNGHOST_MASKS`` and depth."""

    convention = "proper"


class PaperText(MaskedProtocol):
    """As the paper describes it; needs ``UNGHOST_MASKS`` and depth."""

    convention = "paper_text"


class PaperCode(MaskedProtocol):
    """As the paper's published scripts do it; needs ``UNGHOST_MASKS`` and depth."""

    convention = "paper_code"


PROTOCOLS = (WholeImage, VisibleOnly, Proper, PaperText, PaperCode)


def _colours(image: NDArray[Any]) -> NDArray[Any]:
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[-1] not in (3, 4):
        raise InvalidFile(f"unghost's protocols: an image must have shape (H, W, 3), got {array.shape}")
    if array.dtype == np.uint8:
        array = array.astype(np.float32) / np.float32(255)
    if array.shape[-1] == 4 and (array[..., 3] < 1).any():
        raise InvalidFile("unghost's protocols: an image has transparent pixels; put it on a background first")
    return array[..., :3]


def _mask(mask: NDArray[Any]) -> NDArray[np.bool_]:
    array = np.asarray(mask)
    if array.dtype == np.bool_:
        return array
    return np.asarray(array >= (128 if array.dtype == np.uint8 else 0.5), dtype=np.bool_)


def _one(values: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if values is None else np.asarray(values)[None]


def _name(dataset: Mapping[str, Any]) -> str:
    """The image's path within its dataset."""
    path, root = Path(dataset["image_paths"][0]), dataset.get("image_paths_root")
    if root is not None and path.is_absolute() and path.is_relative_to(root):
        path = path.relative_to(root)
    return path.as_posix()


def _stored_depth(dataset: Mapping[str, Any], name: str) -> NDArray[np.float32] | None:
    """What ``nerfbaselines render`` wrote beside the colours: int32 height and width, then float16; 0 is nothing."""
    root = dataset.get("image_paths_root")
    if root is None:
        return None
    path = Path(root).parent / "depth" / PurePosixPath(name).with_suffix(".bin")
    if not path.is_file():
        return None
    raw = path.read_bytes()
    height, width = struct.unpack("<ii", raw[:8]) if len(raw) >= 8 else (0, 0)
    if height < 1 or width < 1 or len(raw) != 8 + 2 * height * width:
        raise InvalidFile(f"unghost's protocols: {path} is no depth map of nerfbaselines, or is truncated")
    depth = np.frombuffer(raw, dtype="<f2", offset=8).reshape(height, width).astype(np.float32)
    return np.where(depth == 0, np.float32(np.inf), depth)
