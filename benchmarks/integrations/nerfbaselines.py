"""Does nerfbaselines find and use this project's protocols? Run by ``make nerfbaselines`` in an environment of its own.

    make nerfbaselines        (a virtual environment of its own: nerfbaselines 1.2.12 and what it needs)

A scene that can be computed (a wall, half of which the training cameras saw) is rendered through nerfbaselines' own
code by a toy method, stored in its format, scored by its command line, and compared with this project's functions.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unghost.core.cameras import Cameras
from unghost.core.results import build_results, write_results
from unghost.evaluation.scoring.depths import ray_depth
from unghost.evaluation.scoring.engine import score_scene
from unghost.evaluation.scoring.pseudo_truth import PseudoTruth, make_pseudo_truth
from unghost.evaluation.scoring.views import Renders, Truth
from unghost.integrations.nerfbaselines.protocol import MASKS_VARIABLE, PROTOCOLS, MaskedProtocol

from ..options import BenchmarkOptions, give_up, parse
from ..progress import say, wrote

WIDTH, HEIGHT, FOCAL, WALL = 64, 48, 64.0, 4.0
SHIFTS = (2.0, 2.6, 9.0)  # of the evaluation cameras; the last sees nothing that was seen
NEAR = 1e-5  # nerfbaselines rounds its means to 5 places


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to check: every protocol, or the one of the convention ``proper`` if short."""


def cameras(shifts: tuple[float, ...]) -> Cameras:
    poses = np.tile(np.eye(4), (len(shifts), 1, 1))
    poses[:, 0, 3] = shifts
    return Cameras.create(poses, np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT)


class Toy:
    """A method that gives what it was told."""

    def __init__(self, colours: np.ndarray, depth: np.ndarray) -> None:
        self.colours, self.depth, self.turn = colours, depth, 0

    def get_info(self) -> dict[str, object]:
        """What nerfbaselines asks of every method."""
        return {"method_id": "toy", "supported_camera_models": frozenset(("pinhole",)), "num_iterations": 1}

    def render(self, camera: object, *, options: object = None) -> dict[str, np.ndarray]:
        """The next view."""
        self.turn += 1
        return {"color": self.colours[self.turn - 1], "depth": self.depth[self.turn - 1]}

    def save(self, path: str) -> None:
        """Something to take a checksum of."""
        (Path(path) / "toy.txt").write_text("toy", encoding="utf-8")


def scene() -> tuple[PseudoTruth, np.ndarray, np.ndarray, np.ndarray]:
    """Pseudo ground truth; photos and colours uint8; depth as float16, which is what nerfbaselines stores."""
    rng = np.random.default_rng(0)
    views = cameras(SHIFTS)
    exact = ray_depth(np.full((len(SHIFTS), HEIGHT, WIDTH), WALL), views)
    truth = make_pseudo_truth(views, cameras((0.0, 0.2)), exact, names=[f"frames/{n}.png" for n in range(len(SHIFTS))])
    photos = rng.integers(0, 256, (len(SHIFTS), HEIGHT, WIDTH, 3), dtype=np.uint8)
    colours = np.clip(photos + rng.normal(scale=12, size=photos.shape), 0, 255).astype(np.uint8)
    depth = (exact * rng.uniform(0.97, 1.03, exact.shape)).astype(np.float16).astype(np.float32)
    depth[:, :6] = 1000.0  # removed: too far to count
    return truth, photos, colours, depth


def evaluate(
    folder: Path, protocol: type[MaskedProtocol], maps: PseudoTruth, arrays: tuple[np.ndarray, ...], root: Path
) -> dict[str, object]:
    """Render through nerfbaselines, score by its command, and beside it directly."""
    import nerfbaselines
    from nerfbaselines.evaluation import build_evaluation_protocol, render_all_images

    photos, colours, depth = arrays
    visible = maps.visible(occlusion=False)
    name = protocol().get_name()
    poses = maps.eval_cameras.camera_to_world.astype(np.float32) * np.array([1, -1, -1, 1], dtype=np.float32)
    dataset = nerfbaselines.new_dataset(
        cameras=nerfbaselines.new_cameras(
            poses=poses,
            intrinsics=maps.eval_cameras.intrinsics.astype(np.float32),
            camera_models=np.zeros(len(poses), dtype=np.int32),
            image_sizes=np.tile(np.array([WIDTH, HEIGHT], dtype=np.int32), (len(poses), 1)),
            nears_fars=np.tile(np.array([0.1, 10.0], dtype=np.float32), (len(poses), 1)),
        ),
        image_paths=[str(root / each) for each in maps.names],
        image_paths_root=str(root),
        images=list(photos),
        mask_paths=[str(root / each) for each in maps.names],
        mask_paths_root=str(root),
        masks=[np.where(each, 255, 0).astype(np.uint8) for each in visible],
        metadata={"color_space": "srgb", "evaluation_protocol": name, "name": "wall", "id": "wall"},
    )
    info = {"method": "toy", "num_iterations": 1, "dataset_metadata": dataset["metadata"]}
    found = build_evaluation_protocol(name)
    for _ in render_all_images(
        Toy(colours, depth), dataset, str(folder / "predictions"), nb_info=info, evaluation_protocol=found
    ):
        pass
    command = [str(Path(sys.executable).with_name("nerfbaselines")), "evaluate", str(folder / "predictions")]
    done = subprocess.run(
        [*command, "--output", str(folder / "results.json")], capture_output=True, text=True, timeout=300, check=False
    )
    if done.returncode:
        raise SystemExit(done.stdout[-3000:] + done.stderr[-3000:])
    theirs = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    renders = Renders(colours.astype(np.float32) / 255, depth)
    if maps and os.environ.get(MASKS_VARIABLE):
        truth = maps.truth(photos.astype(np.float32) / 255, occlusion=False)
    else:
        truth = Truth(photos.astype(np.float32) / 255, visible)
    ours = score_scene(renders, truth, maps.extent, convention=protocol.convention).means()
    pairs = {key: (theirs["metrics"][key], ours[key]) for key in theirs["metrics"] if key in ours}
    apart = max(abs(first - second) / max(1.0, abs(second)) for first, second in pairs.values())
    if apart > NEAR or theirs["evaluation_protocol"] != name:
        raise SystemExit(f"{name}: nerfbaselines says {pairs}, under {theirs['evaluation_protocol']}")
    return {
        "method": name,
        "convention": protocol.convention,
        **{key: first for key, (first, _) in pairs.items()},
        "largest_difference": apart,
        "masks": bool(os.environ.get(MASKS_VARIABLE)),
    }


def whole_metrics(photos: np.ndarray, colours: np.ndarray, maps: PseudoTruth) -> dict[str, float]:
    """nerfbaselines' own PSNR and SSIM of images blanked by a mask, and our convention of its name."""
    from nerfbaselines import metrics

    masks = maps.visible(occlusion=False)[:2]
    first, second = (each[:2].astype(np.float32) / 255 * masks[..., None] for each in (colours, photos))
    depth = np.ones(masks.shape)
    found = score_scene(
        Renders(colours[:2].astype(np.float32) / 255, depth),
        Truth(photos[:2].astype(np.float32) / 255, masks),
        maps.extent,
        convention="nerfbaselines",
    ).means()
    return {
        "psnr_apart": abs(float(np.mean(metrics.psnr(metrics.mse(first, second)))) - found["psnr"]),
        "ssim_apart": abs(float(np.mean(metrics.ssim(second, first))) - found["ssim"]),
    }


def main() -> None:
    options = parse(Options, __doc__)
    if importlib.util.find_spec("nerfbaselines") is None:
        give_up(Options, "needs nerfbaselines in an environment of its own: make nerfbaselines")
    maps, photos, colours, depth = scene()
    rows, chosen = [], [each for each in PROTOCOLS if each.convention == "proper" or not options.short]
    with tempfile.TemporaryDirectory() as scratch:
        maps.save(Path(scratch) / "masks.npz")
        for index, protocol in enumerate(chosen):
            if protocol.convention == "proper":  # from here on they need the cameras
                os.environ[MASKS_VARIABLE] = str(Path(scratch) / "masks.npz")
            folder = Path(scratch) / str(index)
            folder.mkdir()
            rows.append(evaluate(folder, protocol, maps, (photos, colours, depth), Path(scratch) / "images"))
            say(str(rows[-1]))
    import nerfbaselines

    registered = sorted(each for each in nerfbaselines.get_supported_evaluation_protocols() if "unghost" in each)
    extra = {
        "nerfbaselines": importlib.metadata.version("nerfbaselines"),
        "registered": registered,
        "same_formula": whole_metrics(photos, colours, maps),
    }
    results = build_results(rows, command="make nerfbaselines", seeds=[0], **extra)
    write_results(options.out / "nerfbaselines.json", results)
    wrote(options.out / "nerfbaselines.json")


if __name__ == "__main__":
    main()
