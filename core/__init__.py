"""The conventions of the project, one module each, and HTML pages. numpy only (``pages`` needs Jinja2 to render)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .lazy import attach

if TYPE_CHECKING:
    from .aabb import as_aabb as as_aabb
    from .aabb import contains as contains
    from .aabb import scene_extent as scene_extent
    from .arrays import Array as Array
    from .arrays import is_tensor as is_tensor
    from .arrays import namespace as namespace
    from .arrays import to_numpy as to_numpy
    from .arrays import upcast as upcast
    from .arrays import widest as widest
    from .cameras import Cameras as Cameras
    from .cameras import distort as distort
    from .cameras import largest_radius as largest_radius
    from .cameras import undistort as undistort
    from .cameras import warn_if_turned_away as warn_if_turned_away
    from .channels import CHANNEL_NAMES as CHANNEL_NAMES
    from .channels import LEAST_KNOWN as LEAST_KNOWN
    from .channels import OPTIONAL_CHANNELS as OPTIONAL_CHANNELS
    from .channels import POOLED as POOLED
    from .channels import REPEAT as REPEAT
    from .channels import TRANSMITTANCE as TRANSMITTANCE
    from .channels import UNKNOWN as UNKNOWN
    from .channels import check_channels as check_channels
    from .channels import coarse_channel as coarse_channel
    from .channels import coincident_weights as coincident_weights
    from .channels import encode_known as encode_known
    from .channels import encode_share as encode_share
    from .channels import encode_surroundings as encode_surroundings
    from .channels import encode_view_count as encode_view_count
    from .channels import full_channel as full_channel
    from .channels import pool_surroundings as pool_surroundings
    from .channels import stack_channels as stack_channels
    from .channels import surroundings_lattice as surroundings_lattice
    from .channels import with_unknown as with_unknown
    from .config import check_keys as check_keys
    from .config import from_dict as from_dict
    from .config import nearest as nearest
    from .config import override as override
    from .config import to_dict as to_dict
    from .errors import InvalidArgument as InvalidArgument
    from .errors import InvalidFile as InvalidFile
    from .errors import InvalidType as InvalidType
    from .errors import MissingExtra as MissingExtra
    from .errors import MissingFile as MissingFile
    from .errors import UnghostError as UnghostError
    from .errors import needs_extra as needs_extra
    from .file_kinds import FileKind as FileKind
    from .file_kinds import file_kind as file_kind
    from .file_kinds import not_readable as not_readable
    from .frames import RESOLUTION as RESOLUTION
    from .frames import CubeFrame as CubeFrame
    from .frames import cube_lattices as cube_lattices
    from .frames import random_rotations as random_rotations
    from .frames import unit_lattice as unit_lattice
    from .interpolate import corner_weights as corner_weights
    from .interpolate import interpolate_grid as interpolate_grid
    from .interpolate import lower_nodes as lower_nodes
    from .interpolate import trilinear_corners as trilinear_corners
    from .lattice import cell_centers as cell_centers
    from .lattice import cell_pitch as cell_pitch
    from .lattice import cells_within as cells_within
    from .lattice import lattice_axes as lattice_axes
    from .lattice import lattice_origin as lattice_origin
    from .lattice import look_up_cells as look_up_cells
    from .manifest import METADATA_KEY as METADATA_KEY
    from .manifest import Denoiser as Denoiser
    from .manifest import Manifest as Manifest
    from .metrics import METRICS as METRICS
    from .metrics import Metric as Metric
    from .metrics import format_value as format_value
    from .metrics import get_metric as get_metric
    from .occupancy import DECISION as DECISION
    from .occupancy import DEFAULT_OPACITY_THRESHOLD as DEFAULT_OPACITY_THRESHOLD
    from .occupancy import EMPTY as EMPTY
    from .occupancy import OCCUPIED as OCCUPIED
    from .occupancy import OccupancyRule as OccupancyRule
    from .occupancy import check_density as check_density
    from .occupancy import check_density_shape as check_density_shape
    from .occupancy import occupancy_from_signed as occupancy_from_signed
    from .occupancy import opacity_from_density as opacity_from_density
    from .occupancy import opacity_from_signed as opacity_from_signed
    from .occupancy import signed_from_occupancy as signed_from_occupancy
    from .occupancy import signed_from_opacity as signed_from_opacity
    from .occupancy import warn_if_constant as warn_if_constant
    from .ray_distortion import distortion as distortion
    from .results import build_results as build_results
    from .results import commit as commit
    from .results import json_ready as json_ready
    from .results import versions as versions
    from .results import write_results as write_results
    from .schedule import TIMESTEPS as TIMESTEPS
    from .schedule import alphas_cumprod as alphas_cumprod
    from .schedule import check_timestep as check_timestep
    from .schedule import flip_log_odds as flip_log_odds
    from .schedule import strided_timesteps as strided_timesteps
    from .schedule import timestep_from_severity as timestep_from_severity
    from .sight_lines import SightLines as SightLines
    from .sparse_points import SparsePoints as SparsePoints
    from .sparse_points import warn_if_not_in_view as warn_if_not_in_view

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".aabb": ["as_aabb", "contains", "scene_extent"],
        ".arrays": ["Array", "is_tensor", "namespace", "to_numpy", "upcast", "widest"],
        ".cameras": ["Cameras", "distort", "largest_radius", "undistort", "warn_if_turned_away"],
        ".channels": [
            "CHANNEL_NAMES",
            "LEAST_KNOWN",
            "OPTIONAL_CHANNELS",
            "POOLED",
            "REPEAT",
            "TRANSMITTANCE",
            "UNKNOWN",
            "check_channels",
            "coarse_channel",
            "coincident_weights",
            "encode_known",
            "encode_share",
            "encode_surroundings",
            "encode_view_count",
            "full_channel",
            "pool_surroundings",
            "stack_channels",
            "surroundings_lattice",
            "with_unknown",
        ],
        ".config": ["check_keys", "from_dict", "nearest", "override", "to_dict"],
        ".errors": [
            "InvalidArgument",
            "InvalidFile",
            "InvalidType",
            "MissingExtra",
            "MissingFile",
            "UnghostError",
            "needs_extra",
        ],
        ".file_kinds": ["FileKind", "file_kind", "not_readable"],
        ".frames": ["CubeFrame", "RESOLUTION", "cube_lattices", "random_rotations", "unit_lattice"],
        ".interpolate": ["corner_weights", "interpolate_grid", "lower_nodes", "trilinear_corners"],
        ".lattice": ["cell_centers", "cell_pitch", "cells_within", "lattice_axes", "lattice_origin", "look_up_cells"],
        ".manifest": ["Denoiser", "METADATA_KEY", "Manifest"],
        ".metrics": ["METRICS", "Metric", "format_value", "get_metric"],
        ".occupancy": [
            "DECISION",
            "DEFAULT_OPACITY_THRESHOLD",
            "EMPTY",
            "OCCUPIED",
            "OccupancyRule",
            "check_density",
            "check_density_shape",
            "occupancy_from_signed",
            "opacity_from_density",
            "opacity_from_signed",
            "signed_from_occupancy",
            "signed_from_opacity",
            "warn_if_constant",
        ],
        ".ray_distortion": ["distortion"],
        ".results": ["build_results", "commit", "json_ready", "versions", "write_results"],
        ".schedule": [
            "TIMESTEPS",
            "alphas_cumprod",
            "check_timestep",
            "flip_log_odds",
            "strided_timesteps",
            "timestep_from_severity",
        ],
        ".sight_lines": ["SightLines"],
        ".sparse_points": ["SparsePoints", "warn_if_not_in_view"],
    },
)
