"""Recipes: what a set of training pairs is made of, as a validated, frozen record that reads from TOML."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..core.config import check_keys, from_dict, nearest, to_dict
from ..core.errors import InvalidArgument, InvalidFile, MissingFile
from .solids.primitives import FAMILIES

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

BUILTIN_FOLDER = Path(__file__).parent / "recipes"
SOURCES = ("procedural", "meshes", "csg")
SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Recipe:
    """Everything that, with a seed, decides each training pair.

    Ranges are ``(low, high)``; "log" means log-uniform. Shares are probabilities in [0, 1].

    Attributes:
        name: shown in provenance.
        source: ``"procedural"`` (signed distances), ``"meshes"`` (files) or ``"csg"`` (exact solids by boolean
            trees, see :mod:`.solids.csg`; needs manifold3d).
        edge_fraction: log, edge of a cube over the longest side of its object.
        families: primitive families to draw from; empty means all of them (``primitives.FAMILIES``).
        parts: log, how many solids one object has (rounded).
        part_extent: log, a solid's longest side over the unit of the composition.
        cavity_share: a solid is carved out rather than added.
        smooth_share: a solid is joined with a fillet.
        hollow_share: a solid is replaced by its own thin wall.
        bumpy_share: a solid's surface is displaced by a smooth pattern.
        on_share: the cube's centre lies on the surface, moved by up to ``center_jitter`` edges.
        near_share: the centre lies up to half an edge off the surface; what remains of
            ``1 - on_share - near_share`` lies 0.5 to 0.85 edges off (near-empty cubes).
        center_jitter: edges.
        empty_share: truly empty cubes.
        solid_share: the inside is filled (procedural and csg only; meshes need not be closed).
        shell_thickness: uniform, 1 marks the voxels that the surface crosses.
        max_dilation: 0 to this many dilations by one voxel, lower counts likelier.
        soft_share: the input is a soft opacity instead of bits.
        soft_dilation: 0 to this many further dilations of the clean cube of soft pairs: many a field spreads a
            surface over several voxels, and a label thinner than that would teach a network to delete it.
        clean_share: the input is the clean cube (severity 0).
        severity: range of the severity of all others, within [0, 1].
        severity_exponent: severity is ``low + (high - low) * u ** exponent``.
        licences: mesh licences that may be used.
        formats: mesh file endings, without the dot.
        split: the split of the mesh manifest.
        cubes_per_mesh: consecutive samples that share a mesh or boolean tree (so that a worker loads few).
        repair: meshes are repaired before they are cut (``repair.RepairOptions``): small holes closed, faces turned
            the same way, doubles dropped. Needs pymeshlab.
        remesh_edge: with ``repair``, they are also remeshed to edges of this length, their longest side being 1; 0
            keeps their triangles.

    Example:
        >>> Recipe.__name__
        'Recipe'
    """

    name: str = "procedural"
    source: str = "procedural"
    edge_fraction: tuple[float, float] = (0.01, 0.20)
    families: tuple[str, ...] = ()
    parts: tuple[int, int] = (1, 8)
    part_extent: tuple[float, float] = (0.04, 1.0)
    cavity_share: float = 0.15
    smooth_share: float = 0.2
    hollow_share: float = 0.15
    bumpy_share: float = 0.15
    on_share: float = 0.7
    near_share: float = 0.24
    center_jitter: float = 0.25
    empty_share: float = 0.04
    solid_share: float = 0.15
    shell_thickness: tuple[float, float] = (0.9, 1.15)
    max_dilation: int = 2
    soft_share: float = 0.5
    soft_dilation: int = 1
    clean_share: float = 0.1
    severity: tuple[float, float] = (0.02, 1.0)
    severity_exponent: float = 1.0
    licences: tuple[str, ...] = ("CC0-1.0", "MIT-0")
    formats: tuple[str, ...] = ("glb", "gltf", "obj", "ply", "stl")
    split: str = "train"
    cubes_per_mesh: int = 64
    repair: bool = False
    remesh_edge: float = 0.0

    def __post_init__(self) -> None:
        self._check_choices()
        for name in ("edge_fraction", "parts", "part_extent", "shell_thickness", "severity"):
            low, high = self._pair(name)
            least = 0.0 if name == "severity" else 1e-9
            if not (math.isfinite(high) and least <= low <= high):
                rule = "0 <= low <= high" if name == "severity" else "0 < low <= high"
                raise InvalidArgument(f"Recipe: {name} must be (low, high) with {rule}, got {(low, high)}")
        for name, ceiling in (("edge_fraction", 1.0), ("severity", 1.0)):
            if self._pair(name)[1] > ceiling:
                raise InvalidArgument(f"Recipe: {name} must not exceed {ceiling}, got {self._pair(name)}")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_share") and not 0.0 <= value <= 1.0:
                raise InvalidArgument(f"Recipe: {field.name} must lie in [0, 1], got {value}")
        if self.on_share + self.near_share > 1.0 + 1e-9:
            raise InvalidArgument(
                f"Recipe: on_share + near_share must be <= 1, got {self.on_share} + {self.near_share}"
            )
        for name, least in (("max_dilation", 0), ("soft_dilation", 0), ("cubes_per_mesh", 1), ("parts", 1)):
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if not isinstance(number, int) or isinstance(number, bool) or number < least:
                    raise InvalidArgument(f"Recipe: {name} must be whole and >= {least}, got {value!r}")
        if not self.severity_exponent > 0 or not 0 <= self.center_jitter <= 0.5:
            raise InvalidArgument(
                "Recipe: severity_exponent must be > 0 and center_jitter in [0, 0.5], "
                f"got {self.severity_exponent} and {self.center_jitter}"
            )

        if not (self.remesh_edge == 0 or (self.repair and 0.001 <= self.remesh_edge <= 0.5)):
            raise InvalidArgument(
                "Recipe: remesh_edge must be 0, or in [0.001, 0.5] where repair is true, "
                f"got {self.remesh_edge} with repair = {str(self.repair).lower()}"
            )

    def _pair(self, name: str) -> tuple[float, float]:
        value = getattr(self, name)
        numbers = isinstance(value, tuple) and all(isinstance(v, (int, float)) for v in value)
        if not numbers or len(value) != 2:
            raise InvalidArgument(f"Recipe: {name} must be two numbers (low, high), got {value!r}")
        return value[0], value[1]

    def _check_choices(self) -> None:
        if self.source not in SOURCES:
            raise InvalidArgument(f"Recipe: source must be one of {', '.join(SOURCES)}, got {self.source!r}")
        if self.split not in SPLITS:
            raise InvalidArgument(f"Recipe: split must be one of {', '.join(SPLITS)}, got {self.split!r}")
        check_keys(self.families, FAMILIES, caller="Recipe", what="families")

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, lists instead of tuples; :func:`recipe_from_mapping` reads it back."""
        return to_dict(self)


def recipe_from_mapping(values: Mapping[str, Any]) -> Recipe:
    """A recipe from plain keys and values (TOML or JSON), lists becoming tuples.

    Raises:
        ValueError: a key no recipe has (the known ones are listed), or a value of the wrong type.

    Example:
        >>> recipe_from_mapping({"name": "mine", "soft_share": 0.0}).soft_share
        0.0
    """
    return from_dict(Recipe, values)


def builtin_recipes() -> list[str]:
    """Names of the recipes that come with the package.

    Example:
        >>> sorted(builtin_recipes())
        ['csg', 'meshes', 'procedural', 'rooms']
    """
    return sorted(path.stem for path in BUILTIN_FOLDER.glob("*.toml"))


def load_recipe(path_or_name: str | Path) -> Recipe:
    """Read a TOML recipe by path, or a built-in one by name.

    Raises:
        FileNotFoundError: neither a file nor a built-in name.
        ValueError: not TOML, or not a valid recipe.

    Example:
        >>> recipe = load_recipe("procedural")
        >>> recipe.name, recipe.soft_share > 0
        ('procedural', True)
    """
    path = Path(path_or_name)
    if str(path_or_name) in builtin_recipes():
        path = BUILTIN_FOLDER / f"{path_or_name}.toml"
    if not path.is_file():
        names = builtin_recipes()
        hint = nearest([str(path_or_name)], names)
        raise MissingFile(
            f"load_recipe: {path_or_name} is neither a file nor a built-in recipe{hint} ({', '.join(names)})"
        )
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidFile(f"load_recipe: {path} is not TOML ({error})") from None
    return recipe_from_mapping(values)
