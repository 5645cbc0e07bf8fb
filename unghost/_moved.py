"""Old import paths: modules that moved in 0.2 are found under their old names, with a ``DeprecationWarning``."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "bench": "speed",
    "commands": "cli.prior",
    "commands_capture": "cli.captures",
    "commands_clean": "cli.cleaning",
    "commands_doubt": "cli.uncertainty",
    "commands_evaluate": "cli.evaluation",
    "commands_masks": "cli.masks",
    "commands_prior": "cli.training",
    "commands_recipes": "cli.recipes",
    "commands_sample": "cli.sampling",
    "core.cube_views": "core.visibility.view_counts",
    "core.distortion": "core.ray_distortion",
    "core.packing": "core.shards.packing",
    "core.sampled_distance": "core.distances.sampled",
    "core.signed_distance": "core.distances.signed",
    "core.transmittance": "core.visibility.transmittance",
    "data_recipes.augment": "data_recipes.corruptions.structured",
    "data_recipes.box_tree": "data_recipes.meshes.box_tree",
    "data_recipes.compose": "data_recipes.solids.compose",
    "data_recipes.crops": "data_recipes.meshes.crops",
    "data_recipes.csg": "data_recipes.solids.csg",
    "data_recipes.curate": "data_recipes.curation",
    "data_recipes.distances": "data_recipes.solids.distances",
    "data_recipes.draws": "data_recipes.solids.draws",
    "data_recipes.guard": "data_recipes.meshes.guard",
    "data_recipes.guard_worker": "data_recipes.meshes.worker",
    "data_recipes.harvest_config": "data_recipes.harvest.config",
    "data_recipes.harvest_context": "data_recipes.harvest.context",
    "data_recipes.harvest_labels": "data_recipes.harvest.labels",
    "data_recipes.harvest_resume": "data_recipes.harvest.resume",
    "data_recipes.harvest_rooms": "data_recipes.harvest.rooms",
    "data_recipes.mesh_collada": "data_recipes.meshes.collada",
    "data_recipes.mesh_files": "data_recipes.meshes.files",
    "data_recipes.mesh_gltf": "data_recipes.meshes.gltf",
    "data_recipes.mesh_objects": "data_recipes.meshes.objects",
    "data_recipes.mesh_ply": "data_recipes.meshes.ply",
    "data_recipes.mesh_reading": "data_recipes.meshes.reading",
    "data_recipes.mesh_sources": "data_recipes.meshes.sources",
    "data_recipes.mesh_text": "data_recipes.meshes.text",
    "data_recipes.narrow_band": "data_recipes.solids.narrow_band",
    "data_recipes.preview": "data_recipes.inspection.preview",
    "data_recipes.preview_page": "data_recipes.inspection.page",
    "data_recipes.primitives": "data_recipes.solids.primitives",
    "data_recipes.render": "data_recipes.inspection.drawing",
    "data_recipes.repair": "data_recipes.meshes.repair",
    "data_recipes.soften": "data_recipes.corruptions.softening",
    "data_recipes.statistics": "data_recipes.inspection.statistics",
    "data_recipes.thickness": "data_recipes.inspection.thickness",
    "data_recipes.undulations": "data_recipes.solids.undulations",
    "data_recipes.voxelize": "data_recipes.meshes.voxels",
    "demo_furniture": "scenes.labelled_room.furniture",
    "demo_ghosts": "scenes.labelled_room.ghosts",
    "demo_page": "demo.page",
    "demo_pictures": "demo.pictures",
    "demo_render": "scenes.volume_renderer",
    "demo_room": "scenes.labelled_room.room",
    "evaluation.birds_eye": "evaluation.captures.birds_eye",
    "evaluation.checks": "evaluation.metrics.checks",
    "evaluation.colmap": "evaluation.captures.colmap",
    "evaluation.comparison": "evaluation.scoring.comparison",
    "evaluation.conventions": "evaluation.scoring.conventions",
    "evaluation.curves": "evaluation.scoring.curves",
    "evaluation.difficulty": "evaluation.captures.difficulty",
    "evaluation.filters": "evaluation.metrics.filters",
    "evaluation.flip": "evaluation.metrics.ldr_flip",
    "evaluation.frames": "evaluation.captures.frames",
    "evaluation.geometry": "evaluation.metrics.geometry",
    "evaluation.intervals": "evaluation.scoring.intervals",
    "evaluation.mask_scores": "evaluation.metrics.masks",
    "evaluation.nerfbaselines_protocol": "integrations.nerfbaselines.protocol",
    "evaluation.nerfbaselines_spec": "integrations.nerfbaselines.spec",
    "evaluation.nerfstudio_folder": "evaluation.captures.nerfstudio",
    "evaluation.new_capture": "evaluation.captures.creation",
    "evaluation.captures.new_folder": "core.io",
    "evaluation.new_folder": "core.io",
    "evaluation.page": "evaluation.report.page",
    "evaluation.page_charts": "core.pages.charts",
    "evaluation.page_pictures": "evaluation.report.pictures",
    "evaluation.page_tables": "evaluation.report.tables",
    "evaluation.perceptual": "evaluation.metrics.perceptual",
    "evaluation.posing": "evaluation.captures.posing",
    "evaluation.protocol": "evaluation.scoring.protocol",
    "evaluation.pseudo": "evaluation.scoring.pseudo_truth",
    "evaluation.renders_folder": "evaluation.scoring.renders",
    "evaluation.similarity": "evaluation.metrics.similarity",
    "evaluation.sparsification": "evaluation.uncertainty.sparsification",
    "evaluation.splits": "evaluation.captures.splits",
    "evaluation.transforms_file": "evaluation.captures.transforms",
    "evaluation.views": "evaluation.scoring.views",
    "export.diffusion_graph": "export.onnx.diffusion_graph",
    "export.graph": "export.onnx.graph",
    "export.parity": "export.onnx.parity",
    "export.planar": "export.onnx.planar",
    "export.planar_context": "export.onnx.surroundings_branch",
    "export.quantize": "export.onnx.quantization",
    "export.to_onnx": "export.onnx.to_onnx",
    "export.unet_graph": "export.onnx.unet_graph",
    "fields.callables": "fields.adapters.callables",
    "fields.furniture": "scenes.furniture",
    "fields.instant_ngp": "fields.adapters.instant_ngp",
    "fields.msgpack_stream": "fields.adapters.msgpack_stream",
    "fields.nerf_pytorch": "fields.adapters.nerf_pytorch",
    "fields.scenes": "scenes.generator",
    "fields.sdf_density": "fields.adapters.sdf",
    "fields.solids": "scenes.solids",
    "fields.splat_ply": "splats.ply",
    "fields.splats": "splats.density",
    "fields.uncertainty": "baselines.bayes_rays",
    "grids": "fields.adapters.grids",
    "nerfstudio_method": "integrations.nerfstudio.method",
    "nerfstudio_model": "integrations.nerfstudio.model",
    "prior.allocator": "prior.training.allocator",
    "prior.batches": "prior.training.batches",
    "prior.blend": "prior.training.blend",
    "prior.config": "prior.training.config",
    "prior.context": "prior.networks.context",
    "prior.diffusion_network": "prior.diffusion.model",
    "prior.diffusion_training": "prior.diffusion.objective",
    "prior.distributed": "prior.training.distributed",
    "prior.ema": "prior.training.ema",
    "prior.evaluate": "prior.training.validation",
    "prior.network": "prior.networks.restoration",
    "prior.noised_denoiser": "prior.diffusion.noised",
    "prior.objective": "prior.training.objective",
    "prior.rewire": "prior.networks.rewire",
    "prior.sampling": "prior.diffusion.sampling",
    "prior.train": "prior.training.loop",
    "prior.trainer": "prior.training.run_state",
    "prior.unet": "prior.networks.unet",
    "prior.watch": "prior.training.watch",
    "regularizer.clean": "cleaning.pipeline",
    "regularizer.components": "cleaning.components",
    "regularizer.context": "cleaning.grid_channels",
    "regularizer.cube_context": "regularizer.cube_channels",
    "regularizer.decide": "cleaning.post_processing",
    "regularizer.denoise": "cleaning.denoiser_calls",
    "regularizer.keep_mask": "cleaning.keep_mask",
    "regularizer.photo_doubt": "evaluation.uncertainty.photometric",
    "regularizer.queries": "cleaning.queries",
    "regularizer.regularizer": "regularizer.density_regularizer",
    "regularizer.rivals": "baselines.losses",
    "regularizer.strength": "cleaning.strength",
    "regularizer.survey": "cleaning.grid_sampling",
    "regularizer.windows": "cleaning.sliding_window",
    "removal_preview": "cli.removal_preview",
    "splat_cleaning": "cleaning.splats",
}


class MovedModules(MetaPathFinder, Loader):
    """Finder and loader of modules that moved; consulted only for names that nothing else finds."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Spec of an old name, None for any other."""
        package, _, name = fullname.partition(".")
        return ModuleSpec(fullname, self) if package == __package__ and name in MOVED else None

    def create_module(self, spec: ModuleSpec) -> None:
        """The default module, which :meth:`exec_module` replaces."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the module at its new place under its old name."""
        old = module.__name__
        new = f"{__package__}.{MOVED[old.partition('.')[2]]}"
        warnings.warn(f"{old} moved to {new}; the old name goes in 0.3", DeprecationWarning, stacklevel=2)
        sys.modules[old] = import_module(new)


def install() -> None:
    """Append the finder to ``sys.meta_path``, once."""
    if not any(type(finder).__name__ == MovedModules.__name__ for finder in sys.meta_path):
        sys.meta_path.append(MovedModules())
