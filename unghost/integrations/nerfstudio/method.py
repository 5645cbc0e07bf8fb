"""The entry point of nerfstudio 1.1.5: ``ns-train unghost-nerfacto --data …``.

Its training is nerfacto's, but for pose optimisation, which is off: a prior on geometry and moving cameras pull at
each other, and scores need the poses as they are.

Written against nerfstudio 1.1.5's sources; what has been run is the model
(``benchmarks/integrations/nerfstudio.py``): the trainer imports more (torchvision, gsplat, …) than the machines that
test this project can have.
"""

from __future__ import annotations

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from .model import UnghostNerfactoModelConfig

RAYS = 4096


def _optimizer(rate: float = 1e-2, steps: int = 200_000) -> dict[str, object]:
    return {
        "optimizer": AdamOptimizerConfig(lr=rate, eps=1e-15),
        "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=steps),
    }


METHOD = MethodSpecification(
    config=TrainerConfig(
        method_name="unghost-nerfacto",
        steps_per_eval_batch=500,
        steps_per_save=2000,
        max_num_iterations=30_000,
        mixed_precision=True,
        pipeline=VanillaPipelineConfig(
            datamanager=ParallelDataManagerConfig(
                dataparser=NerfstudioDataParserConfig(), train_num_rays_per_batch=RAYS, eval_num_rays_per_batch=RAYS
            ),
            model=UnghostNerfactoModelConfig(
                eval_num_rays_per_chunk=1 << 15,
                average_init_density=0.01,
                camera_optimizer=CameraOptimizerConfig(mode="off"),
            ),
        ),
        optimizers={
            "proposal_networks": _optimizer(),
            "fields": _optimizer(),
            "camera_opt": _optimizer(1e-3, 5000),
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="nerfacto with ghosts pushed out by a learned prior over local geometry (unghost).",
)
