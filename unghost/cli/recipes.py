"""The verbs that make data: cubes with structured corruptions, cubes of fitted fields, a look at them.

Heavy imports wait for the verb.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from ..core.errors import InvalidArgument
from ..data_recipes.harvest.config import HarvestConfig
from .options import given, options_of

if TYPE_CHECKING:
    HarvestOptions = HarvestConfig
else:
    HarvestOptions = options_of(HarvestConfig, leave_out=("kinds", "shares"))


def curate(
    recipe: Positional[str],
    out: Path,
    count: Annotated[int, arg(aliases=["-n", "--n"])] = 20_000,
    seed: int = 0,
    workers: int = 1,
    mesh_root: Path | None = None,
    engine: Literal["local", "ray"] = "local",
    shard_length: int = 8192,
) -> None:
    """Make training pairs from a recipe: cubes of procedural solids, booleans or meshes, and their corruptions.

    Args:
        recipe: procedural, csg or meshes, which are built in, or a .toml file.
        out: folder for the shards, for one run at a time. The same call goes on there after a kill, which costs the
            shard that was being made and changes no byte.
        count: pairs.
        seed: pair i depends on (seed, i) alone.
        workers: processes; the bytes do not depend on it.
        mesh_root: folder with the meshes and their manifest.csv (path, split, licence), for recipes that read meshes.
            A mesh that cannot be used is passed over and named at the end.
        engine: where the workers run; ray uses the cluster of RAY_ADDRESS, or else starts one on this machine.
        shard_length: pairs a shard, 41 kB each on disk and in memory.
    """
    from ..data_recipes.curation import curate as make
    from ..data_recipes.recipe import load_recipe

    shards = make(
        load_recipe(recipe),
        out,
        count=count,
        seed=seed,
        workers=workers,
        mesh_root=mesh_root,
        engine=engine,
        shard_length=shard_length,
        progress=True,
        log=print,
    )
    print(f"{count} pairs in {len(shards)} shard{'s' if len(shards) > 1 else ''} under {out}")


def harvest(
    out: Path,
    scenes: int = 16,
    seed: int = 0,
    first: int = 0,
    workers: int = 1,
    fit: bool = True,
    kinds: tuple[str, ...] = (),
    mesh_root: Path | None = None,
    engine: Literal["local", "ray"] = "local",
    options: Annotated[HarvestOptions, arg(name="")] = HarvestOptions(),  # noqa: B008 (frozen)
) -> None:
    """Fit radiance fields to few photos of synthetic scenes; cut out cubes beside the truth.

    Every cube comes with its surroundings, its frame, and how many photos saw each voxel.

    Args:
        out: folder for the shards, one a scene, for one run at a time. The same call goes on there after a kill,
            which costs the scenes that were under way, one a worker.
        scenes: how many; each takes minutes of one core.
        seed: scene i depends on (seed, i) alone.
        first: number of the first scene.
        workers: processes, each at a scene of its own.
        fit: fit fields; without it, cubes are of perfect fields with synthetic corruption (quick).
        kinds: of field, NAME or NAME=SHARE: dense, hash, mlp; dense and hash if not given. mlp is meant to be
            held out: harvest it apart, with another seed, for evaluation.
        mesh_root: a folder of meshes with its manifest.csv; some of its train split stand in the scenes then.
        engine: where the workers run; ray uses the cluster of RAY_ADDRESS, whose machines must share the folder, or
            else starts one on this machine.
    """
    from ..data_recipes.harvest.run import harvest as make

    chosen = given(options)
    if kinds:
        chosen["kinds"], chosen["shares"] = zip(*map(_named_share, kinds))
    config = HarvestConfig(**chosen)
    pairs = make(
        out,
        scenes=scenes,
        seed=seed,
        first=first,
        workers=workers,
        config=config,
        fit=fit,
        mesh_root=mesh_root,
        progress=True,
        log=print,
        engine=engine,
    )
    print(f"{pairs} pairs under {out}")


def _named_share(spec: str) -> tuple[str, float]:
    """``NAME`` or ``NAME=SHARE``."""
    name, separator, number = spec.partition("=")
    try:
        return name, float(number) if separator else 1.0
    except ValueError:
        raise InvalidArgument(
            f"harvest: --kinds must be NAME or NAME=SHARE, the share a number, got {spec!r}"
        ) from None


def preview(
    folder: Positional[Path], out: Path | None = None, cubes: int = 24, seed: int = 0, against: Path | None = None
) -> None:
    """Draw a page of what is in a shard: cubes as surfaces, histograms, statistics, sources and licences.

    Args:
        folder: a shard, or a folder of shards.
        out: the page, one HTML file with all its pictures; FOLDER-preview.html beside the folder if not given.
        cubes: how many to draw.
        seed: of the choice of cubes.
        against: another shard or folder; the page states how unlike the two are.
    """
    from ..data_recipes.inspection.preview import write_preview

    page, facts = write_preview(folder, out=out, cubes=cubes, seed=seed, against=against)
    print(
        f"{facts['total']} cubes in {facts['shards']} shard{'s' if facts['shards'] > 1 else ''}, "
        f"IoU of input and truth {facts['iou']['mean']:.3f}; look at {page}"
    )
    if against is not None:
        found = facts["against"]
        chance = "" if found["floor"] is None else f" (two halves of one set: {found['floor']:.3f})"
        print(f"distance to {against}: {found['distance']:.3f}{chance}")
