"""Other people's fields as density callables: grids, signed distances, instant-ngp, nerf-pytorch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .callables import numpy_density_fn as numpy_density_fn
    from .callables import occupancy_density_fn as occupancy_density_fn
    from .callables import transformed_density_fn as transformed_density_fn
    from .grids import grid_density_fn as grid_density_fn
    from .grids import load_grid as load_grid
    from .grids import save_grid as save_grid
    from .instant_ngp import CELLS as CELLS
    from .instant_ngp import SHORTEST_STEP as SHORTEST_STEP
    from .instant_ngp import load_instant_ngp as load_instant_ngp
    from .instant_ngp import morton_index as morton_index
    from .nerf_pytorch import NerfPytorchField as NerfPytorchField
    from .nerf_pytorch import load_nerf_pytorch as load_nerf_pytorch
    from .sdf import laplace_density as laplace_density
    from .sdf import sdf_density_fn as sdf_density_fn

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".callables": ["numpy_density_fn", "occupancy_density_fn", "transformed_density_fn"],
        ".grids": ["grid_density_fn", "load_grid", "save_grid"],
        ".instant_ngp": ["CELLS", "SHORTEST_STEP", "load_instant_ngp", "morton_index"],
        ".nerf_pytorch": ["NerfPytorchField", "load_nerf_pytorch"],
        ".sdf": ["laplace_density", "sdf_density_fn"],
    },
)
