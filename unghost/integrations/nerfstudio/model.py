"""nerfacto with the regularizer on: all that differs from nerfstudio's own model is two more losses.

Imports nerfstudio 1.1.5 and torch; the regularizer and the denoiser wait for the first training step.
``unghost/integrations/nerfstudio/method.py`` makes a method of it: ``ns-train unghost-nerfacto``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument
from .pitch import hash_pitch


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
    unghost_field_pitch: float | None = None
    """Side of a cell that opacities are measured over, scene units; None for that of the finest hash level."""
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
        """nerfacto's; the cameras that it will be regularized with are noted here."""
        pipeline = training_callback_attributes.pipeline
        if pipeline is not None:
            self.regularize(pipeline.datamanager.train_dataset.cameras)
        from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

        def note(step: int) -> None:
            self.trained_steps = step

        callbacks: list[Any] = super().get_training_callbacks(training_callback_attributes)
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        return [*callbacks, TrainingCallback(where_to_run=before, update_every_num_iters=1, func=note)]

    def regularize(self, cameras: Any) -> None:
        """Regularize from now on, knowing these cameras (nerfstudio's, of the training photos)."""
        from ...denoisers import load_denoiser
        from ...regularizer.density_regularizer import DensityRegularizer

        c = self.config
        name = c.unghost_denoiser
        denoiser = load_denoiser(name, backend=None if "." in name else "torch")
        if denoiser.kind == "torch":
            denoiser = denoiser.to(self.device)
        aabb, pitch = self.scene_box.aabb.double().cpu().numpy(), c.unghost_field_pitch
        own = hash_pitch(c.max_res, aabb, contracted=not c.disable_scene_contraction)
        self.regularizer = DensityRegularizer(
            denoiser,
            aabb=aabb,
            cameras=cameras_of(cameras),
            field_pitch=own if pitch is None else pitch,
            cubes=c.unghost_cubes,
            dsds_weight=c.unghost_dsds_weight,
            visibility_weight=c.unghost_visibility_weight,
        )

    def density_fields(self) -> list[Any]:
        """The field's density and each proposal network's, once."""
        return [self.field.density_fn, *dict.fromkeys(self.density_fns)]

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, Any]:
        """nerfacto's losses, and ``unghost_dsds`` and ``unghost_visibility`` at the steps whose turn it is."""
        losses: dict[str, Any] = super().get_loss_dict(outputs, batch, metrics_dict)
        step, c = self.trained_steps, self.config
        if self.training and self.regularizer is not None and step >= c.unghost_start and step % c.unghost_every == 0:
            self.regularizer.step = step  # what is drawn depends on the step; the importance grid begins anew
            for name, value in self.regularizer(self.density_fields()).items():
                losses[f"unghost_{name}"] = value.float()
        return losses
