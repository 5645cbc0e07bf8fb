"""Clean a trained field: ask it on a grid, let the denoiser vote, say what to keep. numpy only, no gradient."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.aabb import as_aabb, scene_extent
from ..core.arrays import is_tensor, to_numpy
from ..core.cameras import Cameras, warn_if_elsewhere, warn_if_turned_away
from ..core.channels import CROSSINGS, SUPPORT, TRANSMITTANCE, VIEW_COUNT
from ..core.config import override
from ..core.errors import InvalidArgument
from ..core.lattice import lattice_origin, look_up_cells
from ..core.manifest import Denoiser
from ..core.occupancy import OccupancyRule
from ..core.schedule import check_timestep
from ..core.sight_lines import SightLines
from ..core.sparse_points import SparsePoints, warn_if_not_in_view
from ..core.visibility.transmittance import TransmittanceMaps
from .denoiser_calls import check_denoiser
from .grid_channels import GridContext, evidence_lines, light_maps
from .grid_sampling import Survey, survey_field
from .keep_mask import KeepMask
from .photo_veto import PhotoVeto, apply_veto
from .post_processing import decide, limit_removal, optical_depth, removed_regions
from .queries import CHUNK, Backend, make_query
from .sliding_window import Progress, grow, shrink, vote

FloatGrid = NDArray[np.float32]

DEFAULT_RESOLUTION = 128
MOST_CELLS = 1 << 27
MUCH = 0.3  # share of the optical depth whose removal is worth a warning


@dataclass(frozen=True)
class CleanSettings:
    """How ``clean`` looks and decides.

    Attributes:
        field_pitch: side of the field's own cells, scene units; None if unknown: then the grid's.
        resolution: cells along the longest side; None for the field's own pitch, or 128 if that is unknown.
        rule: density to occupancy.
        strength: in [0, 1]: 0 removes nothing, 0.5 is the denoiser's advised threshold, 1 removes all that is occupied.
        budget: in (0, 1]: at most this share of the grid's optical depth is removed, faint cells included, those of
            the lowest score first. A cell counts for at most 4.6 (99 % of the light).
        level_weights: of the votes at the grid's own pitch, at twice that, at four times …; 0 skips a level.
        overlap: of neighbouring windows, in [0, 1).
        timestep: for the denoiser; None for its default.
        soft: show the denoiser opacities rather than bits (opacity rule only).
        faint: cells that are not occupied but hold more than this share of the rule's threshold are judged too; 1
            leaves them alone. One is removed if voted empty and not next to an occupied cell that stays.
        smallest: connected pieces that stay must have this many cells.
        fringe: occupied cells this near (in cells) to one that stays, stay: the soft skirt of a surface.
        speck: fewer connected cells than this, voted empty on something that stays, are kept.
        keep_boxes: ``(2, 3)`` boxes in which nothing is removed (thin or transparent things).
        skip_empty: do not send windows in which nothing is to be judged; never changes the mask.
        probe: the field is first asked once a block of this many cells along each side, and everywhere only in blocks
            that hold something and around those; 1 asks everywhere. What is thinner than a block and on its own may
            then be missed: it stays.
        drop_invalid: show NaN, infinite and negative densities as empty, leave their cells alone and count those met,
            instead of raising. Of splats: remove those with such values, which else stay unjudged.
        backend: what the callable takes, ``"numpy"`` or ``"torch"``; None to find out.
        chunk: most positions handed to the callable at once.

    Example:
        >>> CleanSettings(strength=0.3).strength
        0.3
    """

    field_pitch: float | None = None
    resolution: int | None = None
    rule: OccupancyRule = dataclasses.field(default_factory=OccupancyRule)
    strength: float = 0.5
    budget: float = 1.0
    level_weights: tuple[float, ...] = (1.0, 0.5)
    overlap: float = 0.5
    timestep: int | None = None
    soft: bool = True
    faint: float = 0.1
    smallest: int = 27
    speck: int = 8
    fringe: int = 1
    keep_boxes: tuple[Any, ...] = ()
    skip_empty: bool = True
    probe: int = 2
    drop_invalid: bool = False
    backend: Backend | None = None
    chunk: int = CHUNK

    def __post_init__(self) -> None:
        pitch, levels = self.field_pitch, self.level_weights
        rules: dict[str, tuple[bool, str]] = {
            "field_pitch": (pitch is None or (math.isfinite(pitch) and pitch > 0), "finite and > 0"),
            "resolution": (self.resolution is None or self.resolution >= 1, ">= 1"),
            "strength": (0.0 <= self.strength <= 1.0, "in [0, 1]"),
            "budget": (0.0 < self.budget <= 1.0, "in (0, 1]"),
            "level_weights": (
                len(levels) > 0 and all(math.isfinite(w) and w >= 0 for w in levels) and sum(levels) > 0,
                "finite, >= 0 and not all 0",
            ),
            "overlap": (0.0 <= self.overlap < 1.0, "in [0, 1)"),
            "faint": (0.0 < self.faint <= 1.0, "in (0, 1]"),
            "smallest": (self.smallest >= 0, ">= 0"),
            "speck": (self.speck >= 0, ">= 0"),
            "fringe": (self.fringe >= 0, ">= 0"),
            "probe": (self.probe >= 1, ">= 1"),
            "chunk": (self.chunk >= 1, ">= 1"),
        }
        for name, (holds, rule) in rules.items():
            if not holds:
                raise InvalidArgument(f"clean: {name} must be {rule}, got {getattr(self, name)!r}")
        if self.timestep is not None:
            check_timestep(self.timestep, caller="clean")
        boxes = tuple(as_aabb(box, caller="clean: keep_boxes").tolist() for box in self.keep_boxes)
        object.__setattr__(self, "keep_boxes", boxes)


def clean(
    density_fn: Callable[[Any], Any],
    aabb: ArrayLike,
    *,
    denoiser: Denoiser,
    cameras: Cameras | None = None,
    points: SparsePoints | None = None,
    veto: PhotoVeto | None = None,
    settings: CleanSettings | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> KeepMask:
    """Find out which density of a field is a ghost.

    The field is asked on a grid of cubic cells at its own pitch, most of empty space left out (``probe``).
    Overlapping windows of that grid, and of ones shrunk two times (the largest opacity of each block), go through
    the denoiser; a cell's score is the weighted mean of all that was predicted for it, and ``strength`` says below
    which score it is voted empty.
    Connected pieces then have the last word: see :func:`unghost.cleaning.post_processing.decide`.

    Args:
        density_fn: ``positions (M, 3) float32 -> density (M, 1) or (M,)`` >= 0 per scene unit; arrays or tensors.
            Unless ``backend`` says which, a torch module (or a method of one) gets tensors; any other callable is
            asked about one point with an array and, if that raises and torch is loaded, with a tensor.
        aabb: ``(2, 3)`` scene units: where to clean; the rest is left as it is.
        denoiser: kind ``"numpy"`` or ``"torch"``. One that asks for the surroundings gets them from the same grid.
        cameras: of the training photos, for a denoiser that asks who sees a cell (view counts, transmittances);
            without them that is unknown. A warning is raised if the denoiser does not ask.
        points: sparse points of the training photos, in the frame of ``cameras``, whose indices their observations
            use; for a denoiser that takes ``support`` and ``crossings``. Only points triangulated from the training
            photos alone may be used for anything that is scored.
        veto: training photos of ``cameras`` and a way to render them: where removal makes them worse, density is given
            back (:mod:`unghost.cleaning.photo_veto`).
        settings: see :class:`CleanSettings`; ``overrides`` replace single ones (``field_pitch`` foremost).
        progress: called with (windows done, windows in all), level by level.

    Returns:
        A :class:`KeepMask`. The field itself is not touched.

    Raises:
        ValueError: an impossible box; a grid of more than 2^27 cells; a density callable that returns the wrong
            shape, or NaN, infinite or negative values.

    Example:
        >>> from unghost import load_denoiser
        >>> denoiser = load_denoiser("default", backend="onnx")
        >>> def density_fn(p):  # a floor, and a floater above it
        ...     floor, floater = abs(p[:, 2] + 0.5) < 0.15, np.linalg.norm(p - 0.4, axis=1) < 0.2
        ...     return 50.0 * (floor | floater)
        >>> mask = clean(density_fn, [[-1, -1, -1], [1, 1, 1]], denoiser=denoiser, resolution=32)
        >>> mask.summary()["removed"] > 0, mask.keep(np.array([[0.0, 0.0, -0.5]])).tolist()
        (True, [True])
        >>> cleaned_fn = mask.apply(density_fn)
    """
    if veto is not None and cameras is None:
        raise InvalidArgument("clean: photos must come with cameras, got cameras=None")
    judgement = judge(
        density_fn,
        aabb,
        denoiser=denoiser,
        cameras=cameras,
        points=points,
        settings=settings,
        progress=progress,
        **overrides,
    )
    mask = judgement.mask()
    if veto is not None and cameras is not None:
        mask = apply_veto(mask, veto, density_fn, judgement.signed, cameras)
    _warn_if_much(mask)
    return mask


@dataclass(frozen=True)
class Judgement:
    """A field, scored: masks of any strength follow without asking the field or the denoiser again.

    Attributes:
        aabb: ``(2, 3)`` scene units.
        pitch: of the cells.
        score: ``(X, Y, Z)`` in [-1, 1], the mean prediction for each cell.
        settings: see :class:`CleanSettings`.
        advised: the denoiser's own threshold.

    Example:
        >>> from unghost.baselines.filters import Classical
        >>> def density_fn(p):  # a floor, and a floater above it
        ...     floor, floater = abs(p[:, 2] + 0.5) < 0.15, np.linalg.norm(p - 0.4, axis=1) < 0.2
        ...     return 50.0 * (floor | floater)
        >>> box, denoiser = [[-1, -1, -1], [1, 1, 1]], Classical("largest component")
        >>> judgement = judge(density_fn, box, denoiser=denoiser, resolution=32)
        >>> [judgement.mask(strength).summary()["removed"] > 0 for strength in (0.1, 0.9)]
        [False, True]
    """

    aabb: NDArray[np.float64]
    pitch: float
    score: NDArray[np.float32]
    settings: CleanSettings
    advised: float
    _survey: Survey
    _about: dict[str, Any]

    @property
    def signed(self) -> NDArray[np.float32]:
        """``(X, Y, Z)`` signed opacity of the cells."""
        return self._survey.signed

    def doubt(self, positions: Any) -> Any:
        """How much the denoiser doubts what is at ``positions (..., 3)``: ``(...)`` float32 in [0, 1].

        Arrays or tensors, as the positions are. 0 where it is sure of matter, 1 where it is sure of air, .5 where it
        was not asked or outside the box. Averaged along a ray by rendering weights (light that gets through counting
        .5), it tells which depths not to trust.
        """
        points = to_numpy(positions.detach().float() if is_tensor(positions) else positions).astype(np.float64)
        values = look_up_cells((1.0 - self.score) / 2.0, points, aabb=self.aabb, pitch=self.pitch, outside=0.5)
        if is_tensor(positions):
            import torch

            return torch.as_tensor(values.astype(np.float32), device=positions.device)
        return values.astype(np.float32)

    def mask(self, strength: float | None = None) -> KeepMask:
        """The mask at a strength in [0, 1]; None for that of the settings."""
        s = self.settings if strength is None else dataclasses.replace(self.settings, strength=strength)
        survey, shape = self._survey, self.score.shape
        threshold, part = threshold_of(s.strength, self.advised), survey.extent()
        removed, faint = (
            decide(
                survey.occupied[part],
                survey.judged[part],
                self.score[part],
                threshold=threshold,
                smallest=s.smallest,
                speck=s.speck,
                fringe=s.fringe,
            )
            if s.strength > 0
            else (np.zeros_like(survey.judged[part]),) * 2
        )
        removed, faint = removed & ~survey.protected[part], faint & ~survey.protected[part]
        depth, total = optical_depth(survey.signed[part]), float(optical_depth(survey.signed).sum())
        if s.budget < 1:
            going = limit_removal(removed | faint, self.score[part], depth, most=s.budget * total)
            removed, faint = removed & going, faint & going
        share = float(depth[removed | faint].sum()) / total if total else 0.0
        corner = [span.start * self.pitch for span in part]
        origin = lattice_origin(self.aabb, self.pitch, shape) + corner
        regions, region_count = removed_regions(removed, self.score[part], origin, self.pitch)
        keep = np.ones(shape, dtype=bool)
        keep[part] = ~(removed | faint)
        details = {
            "occupied": int(survey.occupied.sum()),
            "removed": int(removed.sum()),
            "faint_removed": int(faint.sum()),
            "depth_removed_share": share,
            "asked": survey.asked,
            "dropped": survey.dropped,
            "threshold": threshold,
            **self._about,
            "settings": dataclasses.asdict(s),
            "region_count": region_count,
            "regions": regions,
        }
        return KeepMask(self.aabb, self.pitch, keep, details)


def judge(
    density_fn: Callable[[Any], Any],
    aabb: ArrayLike,
    *,
    denoiser: Denoiser,
    cameras: Cameras | None = None,
    points: SparsePoints | None = None,
    settings: CleanSettings | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> Judgement:
    """The costly part of :func:`clean`, with its arguments: survey the field, score its cells.

    Example:
        >>> from unghost.baselines.filters import Classical
        >>> def density_fn(p):  # a floor, and a floater above it
        ...     floor, floater = abs(p[:, 2] + 0.5) < 0.15, np.linalg.norm(p - 0.4, axis=1) < 0.2
        ...     return 50.0 * (floor | floater)
        >>> box, denoiser = [[-1, -1, -1], [1, 1, 1]], Classical("largest component")
        >>> judgement = judge(density_fn, box, denoiser=denoiser, resolution=32)
        >>> judgement.score.shape
        (32, 32, 32)
    """
    s = override(settings or CleanSettings(), overrides, caller="clean")
    box = as_aabb(aabb, caller="clean")
    check_denoiser(denoiser, caller="clean")
    warn_if_turned_away(cameras, box, caller="clean")
    _warn_if_unused(cameras, points, denoiser)
    _check_points(points, cameras)
    warn_if_elsewhere(cameras, box, caller="clean")
    pitch, shape = grid_of(box, s)
    query = make_query(density_fn, place=box.mean(axis=0), backend=s.backend, chunk=s.chunk, caller="clean")
    survey = survey_field(
        query,
        box,
        pitch,
        shape,
        rule=s.rule,
        faint=s.faint,
        opaque_pitch=s.field_pitch or pitch,
        soft=s.soft,
        keep_boxes=s.keep_boxes,
        probe=s.probe,
        drop_invalid=s.drop_invalid,
        rows=s.chunk,
    )
    maps = light_maps(denoiser.manifest.channels, cameras, query, aabb=box, pitch=s.field_pitch or pitch)
    lines = evidence_lines(denoiser.manifest.channels, points, cameras, aabb=box, pitch=s.field_pitch or pitch)
    score, windows = _score(survey, denoiser, s, box, pitch, cameras, maps, lines, progress)
    about = {"windows": windows, "denoiser": denoiser.manifest.name}
    return Judgement(box, pitch, score, s, denoiser.manifest.removal_threshold, survey, about)


def _warn_if_unused(cameras: Cameras | None, points: SparsePoints | None, denoiser: Denoiser) -> None:
    names, channels = denoiser.manifest.name, set(denoiser.manifest.channels)
    if points is not None and not {SUPPORT, CROSSINGS} & channels:
        warnings.warn(
            f"clean: points are not used by the denoiser {names!r}; evidence uses them (--denoiser evidence)",
            stacklevel=4,
        )
    if cameras is not None and not {VIEW_COUNT, TRANSMITTANCE, SUPPORT, CROSSINGS} & channels:
        warnings.warn(
            f"clean: cameras are not used by the denoiser {names!r} (as by default and xs); views uses"
            " them (--denoiser views), but does worse than default where every ghost is visible to a training camera",
            stacklevel=4,
        )


def _warn_if_much(mask: KeepMask) -> None:
    share, everything = mask.details["depth_removed_share"], mask.details["settings"]["strength"] == 1
    if share > MUCH and not everything:
        warnings.warn(
            f"clean: {share:.0%} of the field's optical depth is removed; where that is fog which its own photos rely "
            "on, they get worse: look at a preview, set budget (at most this share is removed), or give the photos and "
            "a way to render them",
            stacklevel=4,
        )


def _check_points(points: SparsePoints | None, cameras: Cameras | None) -> None:
    if points is None:
        return
    if cameras is None:
        raise InvalidArgument("clean: points must come with cameras, got cameras=None")
    if len(points.camera) and int(points.camera.max()) >= len(cameras):
        raise InvalidArgument(
            f"clean: points must refer to the {len(cameras)} cameras, got camera {int(points.camera.max())}"
        )
    warn_if_not_in_view(points, cameras, caller="clean")


def grid_of(aabb: NDArray[np.float64], settings: CleanSettings) -> tuple[float, tuple[int, int, int]]:
    """Side and number of the grid's cells."""
    sides = aabb[1] - aabb[0]
    if settings.resolution is not None:
        pitch = float(sides.max()) / settings.resolution
    else:
        pitch = settings.field_pitch or float(sides.max()) / DEFAULT_RESOLUTION
    counts = np.maximum(np.ceil(sides / pitch - 1e-4), 1.0)
    if counts.prod() > MOST_CELLS:
        raise InvalidArgument(
            f"clean: aabb with sides {sides.tolist()} has {counts.prod():.3g} cells of side {pitch:g}, more than "
            f"{MOST_CELLS}: pass a smaller box, a larger field_pitch, or a resolution"
        )
    x, y, z = (int(count) for count in counts)
    return float(max(pitch, *(sides / counts))), (x, y, z)


def threshold_of(strength: float, advised: float) -> float:
    """Score below which a cell is voted empty: -1 at strength 0, ``advised`` at 0.5, just above 1 at 1."""
    if strength <= 0.5:
        return -1.0 + 2.0 * strength * (advised + 1.0)
    return advised + 2.0 * (strength - 0.5) * (1.0 + 1e-6 - advised)


def _score(
    survey: Survey,
    denoiser: Denoiser,
    s: CleanSettings,
    aabb: NDArray[np.float64],
    pitch: float,
    cameras: Cameras | None,
    maps: TransmittanceMaps | None,
    lines: SightLines | None,
    progress: Progress | None,
) -> tuple[FloatGrid, int]:
    """Weighted mean of the levels' votes, and the windows it took."""
    origin, names = lattice_origin(aabb, pitch, survey.signed.shape), denoiser.manifest.channels
    timestep = denoiser.manifest.default_timestep if s.timestep is None else s.timestep
    total = np.zeros(survey.signed.shape, dtype=np.float32)
    windows = 0
    for level, weight in enumerate(s.level_weights):
        if weight == 0:
            continue
        factor = 2**level
        judged = shrink(survey.judged.astype(np.float32), factor) > 0
        signed = shrink(survey.signed, factor)
        votes, sent = vote(
            signed,
            judged,
            denoiser=denoiser,
            timestep=timestep,
            edge_fraction=denoiser.manifest.resolution * factor * pitch / scene_extent(aabb),
            overlap=s.overlap,
            skip_empty=s.skip_empty,
            progress=progress,
            context=GridContext(
                names, signed, origin=origin, pitch=factor * pitch, cameras=cameras, maps=maps, lines=lines
            ),
        )
        total += np.float32(weight / sum(s.level_weights)) * grow(votes, factor, total.shape)
        windows += sent
    return total, windows
