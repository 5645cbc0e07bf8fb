"""nerfacto with the regularizer on: all that differs from nerfstudio's own model is three more losses.

Imports nerfstudio 1.1.5 and torch; the regularizer and the denoiser wait for the first training step.
``unghost/integrations/nerfstudio/method.py`` makes a method of it: ``ns-train unghost-nerfacto``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument
from ...core.sparse_points import SparsePoints
from .pitch import hash_pitch, surface_cells


@dataclass
class UnghostNerfactoModelConfig(NerfactoModelConfig):  # type: ignore[misc]
    """nerfacto's options, and those of the regularizer."""

    _target: type = field(default_factory=lambda: UnghostNerfactoModel)
    unghost_start: int = 1000
    """Step of the first regularized one: the photos speak first."""
    unghost_every: int = 10
    """Regularize every so many steps."""
    unghost_cubes: int = 40
    """Cubes of 32^3 a regularized step (40: the paper)."""
    unghost_dsds_weight: float = 0.1
    """Of the score distillation; 0 switches it off."""
    unghost_visibility_weight: float = 1.0
    """Of the density where no photo looks; 0 switches it off."""
    unghost_sight_line_weight: float = 0.03
    """Of the opacity on sight lines from training cameras to sparse points; 0: no sparse points are used at all."""
    unghost_end_point_weight: float = 0.01
    """Of the transparency about those points; 0 switches it off."""
    unghost_sight_line_reach: float = 1.0
    """How many times the scene box sight lines may go out to, 1 to 2^20."""
    unghost_points: Path | None = None
    """COLMAP model with points, or a folder that holds one; None for one beside the photos, if there is one."""
    unghost_field_pitch: float | None = None
    """Side of a cell that opacities are measured over, scene units; None: of the finest level at which the hash table
    holds a scene's surfaces."""
    unghost_denoiser: str = "default"
    """A shipped prior, or a model.safetensors."""


def cameras_of(cameras: Any) -> Cameras:
    """nerfstudio's cameras as ours: the same poses; images of any size are scaled to the first one's.

    Only what a frustum test needs survives: intrinsics relative to the image, distortion k1 to k4, p1, p2, and which
    are fisheyes (nerfstudio's are OPENCV_FISHEYE).

    Args:
        cameras: ``nerfstudio.cameras.cameras.Cameras`` of one dimension, perspective ones or fisheyes.

    Raises:
        ValueError: a camera of another kind.
    """
    from nerfstudio.cameras.cameras import CameraType

    kinds = np.asarray(cameras.camera_type.cpu()).ravel()
    if not np.isin(kinds, (CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value)).all():
        found = sorted(set(kinds.tolist()))
        raise InvalidArgument(f"cameras_of: cameras must be perspective ones or fisheyes, got camera_type {found}")
    width, height = (side.reshape(-1).double().cpu().numpy() for side in (cameras.width, cameras.height))
    scale = np.stack([width[0] / width, height[0] / height] * 2, axis=1)
    lens = np.stack([getattr(cameras, name).reshape(-1).double().cpu().numpy() for name in ("fx", "fy", "cx", "cy")], 1)
    bend = cameras.distortion_params
    return Cameras.create(
        cameras.camera_to_worlds.double().cpu().numpy(),
        lens * scale,
        int(width[0]),
        int(height[0]),
        None if bend is None else bend.double().cpu().numpy(),
        kinds == CameraType.FISHEYE.value,
    )


class UnghostNerfactoModel(NerfactoModel):  # type: ignore[misc]
    """nerfacto, its field and its proposal networks regularized alike.

    Cubes lie in the scene box (nerfstudio's ``aabb``, about the cameras); the field's own contraction is part of its
    density function, so positions stay in the dataparser's world. Without training cameras (a model that no pipeline
    trains) nothing is added.
    """

    config: UnghostNerfactoModelConfig
    regularizer: Any = None
    trained_steps: int = 0

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """nerfacto's; the cameras and points that it will be regularized with are noted here."""
        pipeline = training_callback_attributes.pipeline
        if pipeline is not None:
            dataset = pipeline.datamanager.train_dataset
            self.regularize(dataset.cameras, dataset.image_filenames)
        from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

        def note(step: int) -> None:
            self.trained_steps = step

        callbacks: list[Any] = super().get_training_callbacks(training_callback_attributes)
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        return [*callbacks, TrainingCallback(where_to_run=before, update_every_num_iters=1, func=note)]

    def regularize(self, cameras: Any, photos: Sequence[str | Path] = ()) -> None:
        """Regularize from now on, knowing these cameras (nerfstudio's, of the training photos) and their files.

        Without files there are no sparse points, so no sight lines.
        """
        from ...denoisers import load_denoiser
        from ...regularizer.density_regularizer import DensityRegularizer

        c = self.config
        name = c.unghost_denoiser
        denoiser = load_denoiser(name, backend=None if "." in name else "torch")
        if denoiser.kind == "torch":
            denoiser = denoiser.to(self.device)
        aabb, pitch = self.scene_box.aabb.double().cpu().numpy(), c.unghost_field_pitch
        cells = min(c.max_res, surface_cells(c.log2_hashmap_size))
        own = hash_pitch(cells, aabb, contracted=not c.disable_scene_contraction)
        known = cameras_of(cameras)
        self.regularizer = DensityRegularizer(
            denoiser,
            aabb=aabb,
            cameras=known,
            points=self.sparse_points(known, photos),
            field_pitch=own if pitch is None else pitch,
            cubes=c.unghost_cubes,
            dsds_weight=c.unghost_dsds_weight,
            visibility_weight=c.unghost_visibility_weight,
            sight_line_weight=c.unghost_sight_line_weight,
            end_point_weight=c.unghost_end_point_weight,
            sight_line_reach=c.unghost_sight_line_reach,
        )

    def sparse_points(self, cameras: Cameras, photos: Sequence[str | Path]) -> SparsePoints | None:
        """Points that these cameras observed, in nerfstudio's trained world; one line of the log says which."""
        c = self.config
        if c.unghost_sight_line_weight == 0 or not photos:
            return None
        from nerfstudio.utils.rich_utils import CONSOLE

        from .points import load_training_points

        found = load_training_points(photos, cameras, model=c.unghost_points)
        CONSOLE.log(f"unghost: {'no sight lines' if found.points is None else 'sight lines'}: {found.about}")
        return found.points

    def density_fields(self) -> list[Any]:
        """The field's density and each proposal network's, once."""
        return [self.field.density_fn, *dict.fromkeys(self.density_fns)]

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, Any]:
        """nerfacto's losses, and at the steps whose turn it is ``unghost_dsds``, ``_visibility``, ``_sight_lines``."""
        losses: dict[str, Any] = super().get_loss_dict(outputs, batch, metrics_dict)
        step, c = self.trained_steps, self.config
        if self.training and self.regularizer is not None and step >= c.unghost_start and step % c.unghost_every == 0:
            self.regularizer.step = step  # what is drawn depends on the step; the importance grid begins anew
            for name, value in self.regularizer(self.density_fields()).items():
                losses[f"unghost_{name}"] = value.float()
        return losses
