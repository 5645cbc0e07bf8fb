"""nerfstudio's own nerfacto, with the regularizer on and without, for some steps on the CPU: does the plug-in work?

    make nerfstudio        (a virtual environment of its own: nerfstudio 1.1.5 and what it needs to import)

A synthetic room is photographed, written as a nerfstudio data set and read by nerfstudio's own dataparser (which
turns, moves and scales the poses). Then `NerfactoModel` (``implementation="torch"``) and ours are trained alike, from
the same seed. Checked on the way: our cameras see nerfstudio's rays in nerfstudio's pixels; every density function,
the proposal networks' too, is regularized and gets a gradient. This is no measure of quality: a nerfacto needs
thousands of steps. Writes docs/results/nerfstudio.json.

LPIPS, which nerfacto holds for its evaluation, wants torchvision and a download: an empty module stands in its place.
"""

from __future__ import annotations

import importlib.util
import json
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from unghost.core.results import build_results, write_results
from unghost.scenes.generator import PhotographedScene, photograph, random_scene

from ..options import BenchmarkOptions, give_up, parse
from ..progress import say, wrote

if TYPE_CHECKING:
    from nerfstudio.models.nerfacto import NerfactoModelConfig

HEAVY = (
    "unghost.regularizer.density_regularizer",
    "onnxruntime",
)  # must not be loaded with the plug-in
CUBES = 6  # of the paper's 40: a CPU asks three fields about each voxel
BEND = {"k1": 0.03, "k2": -0.01, "p1": 0.001, "p2": -0.002}  # told to nerfstudio for the check of conventions alone


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to train.

    Attributes:
        steps: of each of the two models.
        rays: a step.
        photos: of the room.
        width: of the photos, 4 : 3.
    """

    SHORT: ClassVar[dict[str, Any]] = {"steps": 12, "rays": 64, "photos": 6, "width": 48}

    steps: int = 60
    rays: int = 1024
    photos: int = 24
    width: int = 128


def without_lpips() -> None:
    """Put an empty module in the place of LPIPS, which wants a download."""
    import torchmetrics.image.lpip

    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = lambda **_: torch.nn.Identity()


def loaded_by_import() -> list[str]:
    """Those of ``HEAVY`` that importing the plug-in has loaded."""
    import unghost.integrations.nerfstudio.model  # noqa: F401

    return [name for name in HEAVY if name in sys.modules]


def write_data_set(shot: PhotographedScene, folder: Path, **lens: float) -> Path:
    """Photos and a transforms.json, as a phone app would leave them."""
    (folder / "images").mkdir(parents=True)
    from PIL import Image

    frames = []
    for index, (image, pose) in enumerate(zip(shot.images, shot.cameras.camera_to_world)):
        name = f"images/frame_{index + 1:05d}.png"
        Image.fromarray((image * 255).round().astype(np.uint8)).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]})
    fx, fy, cx, cy = shot.cameras.intrinsics[0].tolist()
    height, width = shot.images.shape[1:3]
    meta = {"camera_model": "OPENCV", "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height, **lens}
    (folder / "transforms.json").write_text(json.dumps({**meta, "frames": frames}), encoding="utf-8")
    return folder


def parsed(folder: Path) -> Any:
    """nerfstudio's reading of it: every photo for training."""
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    config = NerfstudioDataParserConfig(data=folder, downscale_factor=1, eval_mode="all")
    return config.setup().get_dataparser_outputs(split="train")


def pixel_error(cameras: Any) -> float:
    """Largest distance in pixels between where nerfstudio shot a ray and where our cameras see its points."""
    from unghost.integrations.nerfstudio.model import cameras_of

    ours, generator = cameras_of(cameras), torch.Generator().manual_seed(0)
    worst = 0.0
    for index in range(len(ours)):
        pixels = torch.rand(64, 2, generator=generator) * torch.tensor([ours.height, ours.width])  # row, column
        rays = cameras.generate_rays(camera_indices=index, coords=pixels)
        points = (rays.origins + 1.7 * rays.directions).double().numpy()
        seen = ours.project(index, points)[0]
        worst = max(worst, float(np.abs(seen.reshape(-1, 2) - pixels.flip(-1).numpy()).max()))
    return worst


def train(config: NerfactoModelConfig, data: Any, images: torch.Tensor, steps: int, rays: int) -> dict[str, Any]:
    """A row: what became of the losses, how long a step takes, what is left where no photo looks."""
    torch.manual_seed(0)
    model = config.setup(scene_box=data.scene_box, num_train_data=len(images), metadata=data.metadata)
    model.train()
    if hasattr(model, "regularize"):
        model.regularize(data.cameras)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2, eps=1e-15)
    generator, history = torch.Generator().manual_seed(1), list[dict[str, float]]()
    plain, extra = list[float](), list[float]()  # seconds of steps without and with our losses
    for step in range(steps):
        begun = time.perf_counter()
        model.step = model.trained_steps = step
        chosen = torch.stack([torch.randint(0, side, (rays,), generator=generator) for side in images.shape[:3]], 1)
        bundle = data.cameras.generate_rays(camera_indices=chosen[:, :1], coords=chosen[:, 1:] + 0.5)
        outputs = model(bundle)
        batch = {"image": images[chosen[:, 0], chosen[:, 1], chosen[:, 2]]}
        losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
        ours = "unghost_dsds" in losses
        (extra if ours else plain).append(time.perf_counter() - begun)
        if ours:
            history.append({name: float(value) for name, value in losses.items() if name.startswith("unghost")})
            if not all(np.isfinite(list(history[-1].values()))):
                raise SystemExit(f"step {step}: {history[-1]}")
    row: dict[str, Any] = {
        "steps": steps,
        "rays": rays,
        "rgb_loss": float(losses["rgb_loss"]),
        "milliseconds": 1e3 * statistics.median(plain[3:]),
        "opacity_unseen": unseen(model, data),
    }
    if history:
        row |= {
            "milliseconds_regularized": 1e3 * statistics.median(extra[1:]),
            "regularized_steps": len(history),
            "first": history[0],
            "last": history[-1],
            "fields": gradients(model),
            "contraction_error": contraction_error(model, data),
        }
        row |= step_cost(model)
    return row


def step_cost(model: Any, calls: int = 3) -> dict[str, float]:
    """Milliseconds that the regularizer adds to a step with the paper's 40 cubes on all three fields, and at rest."""
    from unghost.regularizer.density_regularizer import DensityRegularizer

    first, seconds = model.regularizer, []
    full = DensityRegularizer(first.denoiser, aabb=first.aabb, cameras=first.cameras, field_pitch=first.pitch)
    for _ in range(calls):
        begun = time.perf_counter()
        sum(full(model.density_fields()).values()).backward()  # type: ignore[union-attr]
        seconds.append(time.perf_counter() - begun)
    model.zero_grad()
    return {"cubes": full.settings.cubes, "milliseconds_of_them": 1e3 * statistics.median(seconds)}


@torch.no_grad()
def contraction_error(model: Any, data: Any) -> float:
    """Largest relative difference between a density that we ask for and the one that nerfstudio renders with.

    Beside the box too: there nerfacto's contraction must be part of what is asked. Of all three fields.
    """
    bundle = data.cameras.generate_rays(camera_indices=0)[::16, ::16].flatten()
    ends = torch.linspace(0.05, 6.0, 25).expand(len(bundle), 25)[..., None]
    samples = bundle.get_ray_samples(bin_starts=ends[:, :-1], bin_ends=ends[:, 1:])
    places = samples.frustums.get_positions()
    if not (places.abs() > 1.5).any():
        raise SystemExit("contraction_error: no sample lies beyond the box")
    worst = 0.0
    for density_fn in model.density_fields():
        rendered, asked = density_fn.__self__.get_density(samples)[0], density_fn(places)
        worst = max(worst, float(((asked - rendered).abs() / rendered.abs().clamp_min(1e-6)).max()))
    return worst


def gradients(model: Any) -> int:
    """How many density functions get a gradient from the regularizer alone."""
    losses = model.regularizer(model.density_fields())
    model.zero_grad()
    (losses["dsds"] + losses["visibility"]).backward()
    owners = [fn.__self__ for fn in model.density_fields()]
    return sum(any(p.grad is not None and bool(p.grad.any()) for p in owner.parameters()) for owner in owners)


@torch.no_grad()
def unseen(model: Any, data: Any) -> float:
    """Mean opacity over 1/100 of the box's side at points that no training camera sees."""
    from unghost.integrations.nerfstudio.model import cameras_of
    from unghost.regularizer.visibility import ViewCounter

    low, high = data.scene_box.aabb.double().numpy()
    points = np.random.default_rng(0).uniform(low, high, size=(20_000, 3))
    points = points[ViewCounter(cameras_of(data.cameras))(points) == 0]
    density = model.field.density_fn(torch.from_numpy(points).float())
    return float((-torch.expm1(-density * float((high - low).max()) / 100)).mean())


def main() -> None:
    options = parse(Options, __doc__)
    if importlib.util.find_spec("nerfstudio") is None:
        give_up(Options, "needs nerfstudio in an environment of its own: make nerfstudio")
    without_lpips()
    loaded = loaded_by_import()
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    from unghost.integrations.nerfstudio.model import UnghostNerfactoModelConfig

    torch.set_num_threads(options.threads)
    rng = np.random.default_rng(3)
    shot = photograph(rng, random_scene(rng), count=options.photos, width=options.width, height=options.width * 3 // 4)
    with tempfile.TemporaryDirectory() as scratch:
        bent = pixel_error(parsed(write_data_set(shot, Path(scratch) / "bent", **BEND)).cameras)
        data = parsed(write_data_set(shot, Path(scratch) / "room"))
    say(f"rays against our cameras: {pixel_error(data.cameras):.1e} pixels, {bent:.1e} with distortion")
    small: dict[str, Any] = {"implementation": "torch", "log2_hashmap_size": 15, "average_init_density": 0.01}
    ours = UnghostNerfactoModelConfig(**small, unghost_start=0, unghost_every=5, unghost_cubes=CUBES)
    images, rows = torch.from_numpy(shot.images), []
    for name, config in (("nerfacto", NerfactoModelConfig(**small)), ("unghost-nerfacto", ours)):
        rows.append({"method": name, **train(config, data, images, options.steps, options.rays)})
        say(json.dumps(rows[-1]))
    about = {name: version(name) for name in ("nerfstudio", "nerfacc", "torch", "viser", "tyro", "protobuf")}
    results = build_results(
        rows,
        command=options.command(),
        seeds=[0],
        installed=about,
        pixel_error=pixel_error(data.cameras),
        pixel_error_bent=bent,
        loaded_by_import=loaded,
    )
    write_results(options.out / "nerfstudio.json", results)
    wrote(options.out / "nerfstudio.json")


if __name__ == "__main__":
    main()
