"""Give a harvest other sparse points: the rows with many and with few points in the reference measurement.

    python -m benchmarks.denoise.point_sets out/harvest-val --to out/harvest-val-many --points 3000 10000
    python -m benchmarks.denoise.point_sets out/harvest-val --to out/harvest-val-few --points 300 700 --noise 0.7 \
--wrong 0.03

The fields are not fitted again (:mod:`unghost.data_recipes.harvest.evidence`). Writes a folder of shards; what is in it
is not made again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import tyro

from unghost.data_recipes.harvest.evidence import replace_evidence
from unghost.scenes.sparse_points import MatchingConfig

from ..options import HARVEST, MESHES, NOT_GIVEN, BenchmarkOptions, parse
from ..progress import say, wrote


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """Which shards, and which points.

    Attributes:
        source: folder of harvested shards.
        to: folder for the copies.
        points: lowest and highest number of points of a set.
        noise: standard deviation of a keypoint, pixels of the matched photos.
        wrong: share of wrong points.
        contrast, repeatability: of :class:`~unghost.scenes.sparse_points.MatchingConfig`; as easy as the harvest has
            them, so that as many points come out as were asked for.
        meshes: folder of meshes that the harvest had.
    """

    DATA: ClassVar[dict[str, str]] = {"source": HARVEST, "meshes": MESHES}

    source: tyro.conf.Positional[Path] = NOT_GIVEN
    to: Path = NOT_GIVEN
    points: tuple[float, float] = (3000.0, 10_000.0)
    noise: float = 0.5
    wrong: float = 0.01
    contrast: float = 0.003
    repeatability: float = 0.6
    meshes: Path | None = None


def main(options: Options) -> None:
    """Copy every shard."""
    matching = MatchingConfig(
        points=options.points,
        noise=(options.noise,) * 2,
        wrong=(options.wrong,) * 2,
        contrast=(options.contrast,) * 2,
        repeatability=(options.repeatability,) * 2,
    )
    count = replace_evidence(options.source, options.to, matching=matching, mesh_root=options.meshes, log=say)
    say(f"{count} shards")
    wrote(options.to)


if __name__ == "__main__":
    main(parse(Options, __doc__))
