"""Choose thresholds and calibration of shipped models anew, and everything that follows from them.

    python -m benchmarks.release.recalibrate                                        every shipped model
    python -m benchmarks.release.recalibrate evidence --calibrate HARVEST HARVEST

For each model: its threshold on the rooms of `ship.py` (and its calibration, if it has one or `--calibrate` names
harvested shards), its files, and threshold_NAME.json. Then demo.json of the demo, and the model cards.
To be run after a change of `clean`, of a model, or of what `ship.py` chooses from.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import tyro

from unghost.demo.run import run_demo
from unghost.denoisers import WEIGHTS, shipped_names
from unghost.export.container import precision_of
from unghost.export.runtime import read_manifest

from ..options import HARVEST, SHORT_RESULTS, BenchmarkOptions, give_up, parse
from ..progress import say, wrote
from . import model_cards, ship


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to choose anew.

    Attributes:
        models: names of shipped models; all if left out.
        calibrate: folders of harvested shards that were not trained on, for models that are calibrated.
        kept: share of the surface of the rooms that must stay.
        rooms: seeds of the rooms.
        candidates: thresholds to try at most.
        weights: where the shipped models are.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "models": ("xs",),
        "rooms": (10,),
        "candidates": 2,
        "weights": SHORT_RESULTS / "weights",
    }
    DATA: ClassVar[dict[str, str]] = {"calibrate": HARVEST}
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ("calibrate",)

    models: tyro.conf.Positional[tuple[str, ...]] = ()
    calibrate: tuple[Path, ...] | None = None
    kept: float = 0.985
    rooms: tuple[int, ...] = (10, 11, 12, 13)
    candidates: int = len(ship.CANDIDATES)
    weights: Path = WEIGHTS


def shipping(options: Options, name: str, folder: Path) -> ship.Options:
    """How a model is shipped again, from a copy of its checkpoint.

    Raises:
        SystemExit: it is calibrated, and there are no shards to do that again.
    """
    manifest = read_manifest(WEIGHTS / f"{name}.onnx")
    calibrated = "calibration" in manifest.training
    if calibrated and not options.calibrate:
        give_up(Options, f"{name} is calibrated: needs --calibrate, {HARVEST}")
    checkpoint = folder / f"{name}.safetensors"
    shutil.copyfile(WEIGHTS / checkpoint.name, checkpoint)
    named = options.calibrate if calibrated or (options.calibrate and options.models) else ()
    return ship.Options(
        checkpoint,
        name,
        half=precision_of(manifest) == "fp16",
        rooms=options.rooms,
        kept=options.kept,
        candidates=options.candidates,
        calibrate=tuple(named or ()),
        weights=options.weights,
        out=options.out,
        threads=options.threads,
    )


def main() -> None:
    options = parse(Options, __doc__)
    names = options.models or tuple(shipped_names())
    unknown = sorted(set(names) - set(shipped_names()))
    if unknown:
        give_up(Options, f"no shipped model {', '.join(unknown)}; there are {', '.join(shipped_names())}")
    with tempfile.TemporaryDirectory() as scratch:
        for name in names:
            say(f"[{name}]")
            ship.ship(shipping(options, name, Path(scratch)))
        run_demo(Path(scratch, "demo"))
        shutil.copyfile(Path(scratch, "demo", "result.json"), options.out / "demo.json")
    if options.weights == WEIGHTS:
        model_cards.main()
    wrote(options.out / "demo.json", *(options.out / f"threshold_{name}.json" for name in names))


if __name__ == "__main__":
    main()
