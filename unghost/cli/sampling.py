"""The verb that draws from a diffusion prior. Heavy imports wait for the verb."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from ..core.errors import InvalidArgument, needs_extra
from ..core.progress import progress_bar

if TYPE_CHECKING:
    from numpy.typing import NDArray

COLUMNS = 6  # of the sheet
GAP = 4  # pixels between its pictures


def sample(
    model: Positional[Path],
    out: Path,
    count: int = 12,
    steps: int = 100,
    seed: int = 0,
    edge_fraction: float = 0.1,
    eta: float = 1.0,
    batch_size: int = 16,
    device: str = "cpu",
) -> None:
    """Draw unconditional cubes from a diffusion prior; writes them and pictures of them as surfaces.

    Args:
        model: a model.safetensors trained with objective epsilon, x0 or bernoulli.
        out: folder for cubes.npz, sheet.png and one picture a cube.
        count: cubes.
        steps: calls of the network for each; 1000 is the whole of the chain.
        seed: cube i depends on (seed, i) alone.
        edge_fraction: of the scene's extent, that the cubes are to look like.
        eta: 1 is ancestral, 0 deterministic (DDIM); 1 alone for objective bernoulli.
        batch_size: cubes at a time.
        device: as torch names it.
    """
    with needs_extra("torch", caller="sample"):
        import torch

        from ..prior.checkpoint import load_model
        from ..prior.diffusion.model import DiffusionNet
        from ..prior.diffusion.sampling import sample_cubes
    denoiser = load_model(model, device=torch.device(device))
    if not isinstance(denoiser.network, DiffusionNet):
        raise InvalidArgument(
            f"sample: {model} is of family {denoiser.manifest.family!r}; only 'diffusion' can be sampled"
        )
    calls = steps * -(-count // max(batch_size, 1))
    with progress_bar(calls, unit="step") as bar:
        cubes = sample_cubes(
            denoiser.network,
            count=count,
            edge_fraction=edge_fraction,
            seed=seed,
            steps=steps,
            eta=eta,
            batch_size=batch_size,
            on_step=lambda step, x0: bar.update(),
        )
    signed = cubes[:, 0].numpy()
    facts = {
        "seed": seed,
        "steps": steps,
        "eta": eta,
        "edge_fraction": edge_fraction,
        "objective": denoiser.network.config.objective,
        "model": denoiser.manifest.name,
    }
    write_samples(out, signed, facts)
    share = float((signed > 0).mean())
    print(f"{count} cubes, {share:.1%} of the voxels occupied; look at {out / 'sheet.png'}")


def write_samples(out: Path, signed: NDArray[Any], facts: dict[str, Any]) -> None:
    """``cubes.npz``, ``cube-000.png`` …, ``sheet.png`` in a folder.

    Args:
        out: made if it is not there.
        signed: x0 ``(N, R, R, R)`` in [-1, 1], N >= 1; occupied above 0.
        facts: written beside the cubes as JSON text.
    """
    import json

    import numpy as np

    from ..core.occupancy import DECISION
    from ..data_recipes.inspection.drawing import png_bytes

    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        out / "cubes.npz", signed=signed.astype(np.float32), occupancy=signed > DECISION, facts=json.dumps(facts)
    )
    pictures = [draw_cube(cube > DECISION) for cube in signed]
    for index, picture in enumerate(pictures):
        (out / f"cube-{index:03d}.png").write_bytes(png_bytes(picture))
    (out / "sheet.png").write_bytes(png_bytes(sheet(pictures)))


def draw_cube(occupancy: NDArray[Any]) -> NDArray[Any]:
    """``(R, R, R)`` bool as a surface, ``(W, W, 3)`` uint8, turned to the side that shows most of it."""
    import numpy as np

    from ..data_recipes.inspection.drawing import SURFACE, best_turn, render_cube

    opacity = occupancy.astype(np.float32)
    turned = np.rot90(opacity, best_turn(opacity, opacity))
    return render_cube(turned, np.broadcast_to(np.array(SURFACE, np.float32), (*turned.shape, 3)))


def sheet(pictures: list[NDArray[Any]]) -> NDArray[Any]:
    """Square pictures of one size, left to right in rows of six, on white."""
    import numpy as np

    width, columns = len(pictures[0]), min(COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    canvas = np.full((rows * (width + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for index, picture in enumerate(pictures):
        row, column = divmod(index, columns)
        top, left = row * (width + GAP), column * (width + GAP)
        canvas[top : top + width, left : left + width] = picture
    return canvas
