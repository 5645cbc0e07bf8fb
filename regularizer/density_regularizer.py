"""The two lines of a training loop: losses on any density callable."""

from __future__ import annotations

import functools
import warnings
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.config import override
from ..core.errors import InvalidArgument, InvalidType, MissingExtra

try:
    import torch
    from torch import Tensor
except ImportError as error:  # pragma: no cover - exercised in a subprocess
    raise MissingExtra("unghost.regularizer.density_regularizer needs torch: pip install unghost[torch]") from error

from ..cleaning.denoiser_calls import check_denoiser, run_denoiser
from ..cleaning.grid_channels import evidence_lines, viewing_cameras
from ..cleaning.pitch_estimation import PitchEstimate
from ..cleaning.queries import field_device
from ..core.aabb import as_aabb, scene_extent
from ..core.arrays import to_numpy, upcast, widest
from ..core.cameras import Cameras, warn_if_turned_away
from ..core.manifest import Denoiser
from ..core.occupancy import EMPTY, opacity_from_density, warn_if_constant
from ..core.schedule import check_timestep
from ..core.sight_lines import MARGIN_CELLS, SightLines
from ..core.sparse_points import SparsePoints, warn_if_not_in_view
from .cube_channels import FollowedRays, complete_channels, cube_surroundings
from .cubes import CubeBatch, draw_cubes, wide_dtype
from .losses import (
    cube_parts,
    cubewise_mean,
    dsds_loss,
    end_point_loss,
    sight_line_loss,
    stable_mean,
    visibility_loss,
)
from .pitch import FieldPitch, PitchSource, SkipWatch
from .proposals import ImportanceGrid
from .settings import SURE, RegularizerSettings
from .tensor_queries import DensityFn, query_tensors
from .visibility import ViewCounter, grow_box, visibility_points

LINES_MOVE = 0.2  # change of the logarithm of the pitch after which sight lines are traced anew
MOST_LINE_CELLS = 192  # along the longest side of the grid on which sight lines and points outvote each other
LOSSES = ("dsds", "visibility", "sight_lines")
POINTS_PER_CELL = 4  # asked of the field to fill the importance grid at the first call


class DensityRegularizer:
    """Adds a learned prior over local geometry, and a visibility prior, to the loss of any radiance field.

    Each call draws cubes of the scene where there is matter, asks the field for their densities, lets the
    denoiser say what should be there (one step, no gradient through it), and returns the DSDS loss (the
    paper, eq. 2); penalises density where no camera looks (eq. 3); and, given the sparse points of the
    structure-from-motion model, density on sight lines between cameras and the points that they observed.

    Departures from the paper: under the opacity rule (the default) the losses act on the optical depth
    ``density * pitch`` rather than on the density, so the weights do not depend on the scene's unit, and a voxel
    counts as occupied by its opacity; voxels of which the denoiser is not sure are left alone.
    ``RegularizerSettings.paper()`` restores raw densities, bits, one threshold and tau = w = 0.01.
    A cube without one occupied voxel is not sent to the denoiser: all of it counts as empty (m = 1), so faint
    density there is still pushed out. Voxels outside the box are shown as empty and left out of the loss.

    Losses are means over the voxels (points) in the box, times their weight; those of several fields are added.

    Args:
        denoiser: kind ``"numpy"`` or ``"torch"``. One that asks for the surroundings costs as many positions again.
        aabb: ``(2, 3)``, scene units: where to clean.
        cameras: of the training photos; None for no visibility loss; who sees a place is unknown then.
        depth_maps: ``(cameras, height, width)`` of theirs (a list where they differ in size), along the optical axis,
            inf for nothing: the visibility loss then counts only cameras from which nothing hides a point (the paper:
            every camera that has it in view).
        points: of the training photos, in the frame of ``cameras``, whose indices its observations use; None for no
            sight-line loss. For anything that is scored, triangulated from the training photos alone.
        field_pitch: side of the field's own cells in scene units, or a function of cube centres ``(N, 3)``
            that gives it as ``(N,)`` (a contracted field); None to estimate it from the first field, with at most
            200,000 densities at acting calls 0, 1, 2, 4, 8, … (:func:`unghost.cleaning.estimate_pitch`).
        device: where positions are created; None for the device of the field's parameters, else the CPU.
        settings: see :class:`RegularizerSettings`; ``overrides`` replace single ones.

    Attributes:
        grid: the importance grid.
        pitch: side of the field's cells that is used, scene units; of a function, its median.
        pitch_estimate: where ``pitch`` comes from; None if it was given, or before the first call.
        step: calls so far; cubes of step s depend on (seed, s) and the grid alone.
        report: counts of the last call: cubes, skipped_empty, denoised, voxels, outside, dropped, points, unseen,
            lines.
        totals: the same since the start, and observations_outside.

    Example:
        >>> from unghost import load_denoiser
        >>> level = torch.full((), 20.0, requires_grad=True)  # stands for a field's parameters
        >>> def density_fn(positions):
        ...     return level * (positions.norm(dim=-1) < 0.5)
        >>> regularizer = DensityRegularizer(load_denoiser(), aabb=[[-1] * 3, [1] * 3], field_pitch=0.05, cubes=2)
        >>> losses = regularizer(density_fn)
        >>> sum(losses.values()).backward()  # add them to your photometric loss
        >>> sorted(losses), bool(torch.isfinite(level.grad))
        (['dsds', 'sight_lines', 'visibility'], True)
    """

    def __init__(
        self,
        denoiser: Denoiser,
        *,
        aabb: ArrayLike,
        cameras: Cameras | None = None,
        depth_maps: NDArray[np.floating] | Sequence[NDArray[np.floating]] | None = None,
        points: SparsePoints | None = None,
        field_pitch: FieldPitch = None,
        device: torch.device | str | None = None,
        settings: RegularizerSettings | None = None,
        **overrides: Any,
    ) -> None:
        self.settings = override(settings or RegularizerSettings(), overrides, caller="DensityRegularizer")
        self.aabb = as_aabb(aabb, caller="DensityRegularizer")
        self.denoiser = check_denoiser(denoiser, caller="DensityRegularizer")
        s, self.device, self.cameras = self.settings, device, cameras
        self._pitch, self._watch = PitchSource(field_pitch, self.aabb), SkipWatch(self.settings.rule, self.aabb)
        self.threshold = denoiser.manifest.removal_threshold if s.threshold is None else s.threshold
        self.fill_threshold = max(self.threshold, SURE) if s.fill_threshold is None else s.fill_threshold
        if self.fill_threshold < self.threshold:
            raise InvalidArgument(
                f"DensityRegularizer: fill_threshold must be >= threshold={self.threshold}, got {self.fill_threshold}"
            )
        self.grid = ImportanceGrid(self.aabb, resolution=s.grid_resolution, decay=s.grid_decay)
        self._views: ViewCounter | None = None
        if depth_maps is not None and cameras is None:
            raise InvalidArgument("DensityRegularizer: depth_maps must come with cameras, got cameras=None")
        if cameras is not None and len(cameras):
            warn_if_turned_away(cameras, self.aabb, caller="DensityRegularizer")
            reach = grow_box(self.aabb, s.visibility_reach)
            self._views = ViewCounter(cameras, min_views=s.min_views, aabb=reach, depth_maps=depth_maps)
        self._points = points
        self.lines = self._sight_lines_of(points)
        self._evidence = self._evidence_of(points)
        self._viewing = viewing_cameras(cameras, denoiser.manifest.channels)
        self._rays = FollowedRays(denoiser.manifest.channels, cameras, self.aabb, every=s.light_steps)
        self._seen: dict[str, Any] = {}  # cubes, skipped, lowest and highest density of the first field
        self.step = 0
        self.report: Counter[str] = Counter()
        self.totals: Counter[str] = Counter()

    def __call__(self, density_fn: DensityFn | Sequence[DensityFn]) -> dict[str, Tensor]:
        """The weighted losses of one step.

        Args:
            density_fn: ``positions (M, 3) float32 tensor -> density (M, 1) or (M,)``, differentiable; or a list of
                them, the main field first (proposal networks must be cleaned too). All see the same cubes.

        Returns:
            ``{"dsds": …, "visibility": …, "sight_lines": …}``: scalars (float64, so that no finite density overflows),
            exactly zero where switched off, and at the steps between (``every``).

        Raises:
            TypeError, ValueError: what a callable returned is no tensor, of the wrong shape, NaN, infinite, negative.
        """
        fields: list[Any] = (
            list(density_fn) if isinstance(density_fn, (Sequence, torch.nn.ModuleList)) else [density_fn]
        )
        if not fields:
            raise InvalidArgument("DensityRegularizer: density_fn must be a callable or a non-empty list of them")
        for field in fields:
            if not callable(field):
                raise InvalidType(f"DensityRegularizer: density_fn must be callable, got {type(field).__name__}")
        device = torch.device(self.device if self.device is not None else field_device(fields[0]) or "cpu")
        self.report = Counter()
        acts = self.step % self.settings.every == 0
        if acts and self._needs_pitch():
            self._refresh_pitch(fields[0], device)
        if not acts:
            losses = {name: torch.zeros((), dtype=wide_dtype(device), device=device) for name in LOSSES}
        else:
            losses = {
                "dsds": self._dsds(fields, device),
                "visibility": self._visibility(fields, device),
                "sight_lines": self._sight_lines(fields, device),
            }
        self.totals.update(self.report)
        self.step += 1
        return losses

    def _sight_lines_of(self, points: SparsePoints | None) -> SightLines | None:
        """Lines in the box that the visibility loss reaches, and beyond; the loss may ask the field anywhere there."""
        if points is None:
            return None
        if self.cameras is None:
            raise InvalidArgument("DensityRegularizer: points must come with cameras, got cameras=None")
        if len(points.camera) and int(points.camera.max()) >= len(self.cameras):
            raise InvalidArgument(
                f"DensityRegularizer: points must refer to the {len(self.cameras)} cameras, "
                f"got camera {int(points.camera.max())}"
            )
        warn_if_not_in_view(points, self.cameras, caller="DensityRegularizer")
        lines = self._build_lines(points, self.cameras)
        if not len(lines):
            warnings.warn(
                f"DensityRegularizer: the sight-line loss is 0, as no line is left of {len(points)} points with "
                f"{len(points.point)} observations: points need tracks, and rays from different places in the box",
                stacklevel=4,
            )
        return lines

    def _build_lines(self, points: SparsePoints, cameras: Cameras) -> SightLines:
        box = grow_box(self.aabb, self.settings.visibility_reach)
        pitch = max(self.pitch, scene_extent(box) / MOST_LINE_CELLS)
        reach = max(self.settings.sight_line_reach / self.settings.visibility_reach, 1.0)
        return SightLines.build(points, cameras, aabb=box, pitch=pitch, field_pitch=self.pitch, reach=reach)

    def _evidence_of(self, points: SparsePoints | None) -> SightLines | None:
        """Lines on a grid of the field's own pitch over the box, for a denoiser that sees support and crossings."""
        names = self.denoiser.manifest.channels
        return evidence_lines(names, points, self.cameras, aabb=self.aabb, pitch=self.pitch)

    def observe(self, positions: Any, values: Any, *, kind: Literal["density", "weight"] = "density") -> None:
        """Tell the importance grid what you rendered anyway; never needed, always cheap.

        Args:
            positions: ``(..., 3)`` array or tensor, scene units; those outside the box are dropped and counted.
            values: ``(...)`` or ``(..., 1)``: densities per scene unit, or accumulation weights in [0, 1].
            kind: which of the two.
        """
        if kind not in ("density", "weight"):
            raise InvalidArgument(f"DensityRegularizer.observe: kind must be 'density' or 'weight', got {kind!r}")
        amounts, points = _as_float64(values), _as_float64(positions)
        if kind == "density" and self.settings.rule.kind == "opacity":
            valid = np.where(np.isfinite(amounts) & (amounts >= 0), amounts, 0.0)
            amounts = np.where(valid == amounts, opacity_from_density(valid, self.pitch), amounts)
        self.totals["observations_outside"] += self.grid.observe(points, amounts)

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs: step, grid values, which cells were observed, the estimated pitch."""
        return {
            "step": self.step,
            "values": self.grid.values.copy(),
            "observed": self.grid.observed.copy(),
            "pitch": self._pitch.state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`; one that has no pitch yet leaves it to be estimated."""
        if np.shape(state["values"]) != self.grid.values.shape:
            raise InvalidArgument(
                f"DensityRegularizer.load_state_dict: values must have shape {self.grid.values.shape}, "
                f"got {np.shape(state['values'])}"
            )
        self.step = int(state["step"])
        self.grid.values, self.grid.observed = np.array(state["values"], float), np.array(state["observed"], bool)
        if "pitch" in state:
            self._pitch.load(state["pitch"])

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, self.step, stream])

    @property
    def pitch(self) -> float:
        """Side of the field's cells that is used, scene units; 1/128 of the longest side until it is estimated."""
        return self._pitch.nominal

    @property
    def pitch_estimate(self) -> PitchEstimate | None:
        """Where ``pitch`` comes from; None if it was given, or before the first call."""
        return self._pitch.estimate

    def _needs_pitch(self) -> bool:
        """Whether any loss that is on depends on it: the paper's do not."""
        s, by_opacity = self.settings, self.settings.rule.kind == "opacity"
        cubes = by_opacity or s.edge_range is None or len(self.denoiser.manifest.channels) > 1
        views = self._views is not None and s.visibility_weight > 0 and s.visibility_samples > 0
        lines = self.lines is not None and s.sight_lines > 0 and max(s.sight_line_weight, s.end_point_weight) > 0
        return (s.dsds_weight > 0 and s.cubes > 0 and cubes) or (views and by_opacity) or lines

    def _refresh_pitch(self, field: DensityFn, device: torch.device) -> None:
        """Estimate an unknown pitch where it is due; sight lines end a number of cells before their points."""

        @torch.no_grad()
        def query(places: NDArray[Any]) -> NDArray[Any]:
            s, positions = self.settings, torch.as_tensor(places, dtype=torch.float32, device=device)
            density, valid = query_tensors(field, positions, chunk=s.chunk, drop_invalid=s.drop_invalid)
            return to_numpy(torch.where(valid, widest(density), torch.full_like(widest(density), torch.nan)))

        before = self.pitch
        self._pitch.refresh(query, self._rng(5))
        if self._points is not None and self.cameras is not None and abs(np.log(self.pitch / before)) > LINES_MOVE:
            self.lines = self._build_lines(self._points, self.cameras)
            self._evidence = self._evidence_of(self._points)

    def _query(self, field: DensityFn, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Densities ``(M,)`` at ``(M, 3)``, in chunks, and which of them are valid (all, unless dropping)."""
        values, valid = query_tensors(
            field, positions, chunk=self.settings.chunk, drop_invalid=self.settings.drop_invalid
        )
        self.report["dropped"] += int((~valid).sum())
        return values, valid

    def _bootstrap(self, field: DensityFn, device: torch.device) -> None:
        """Fill a grid that has seen nothing by asking the field in every cell."""
        points = self.grid.cell_points(self._rng(2), POINTS_PER_CELL)
        positions = torch.as_tensor(points, dtype=torch.float32, device=device)
        with torch.no_grad():
            density, valid = self._query(field, positions)
        self._refresh(positions[valid], density[valid], self.pitch)
        lowest, highest = (float(value) for value in torch.aminmax(density))
        warn_if_constant(lowest, highest, len(density), caller="DensityRegularizer")

    def _refresh(self, positions: Tensor, density: Tensor, pitch: Tensor | float) -> None:
        """Opacities (or, under the density rule, densities) into the grid."""
        if self.settings.rule.kind == "opacity":
            density = opacity_from_density(widest(density.detach()), pitch)
        self.grid.observe(positions, density.detach())

    def _dsds(self, fields: list[DensityFn], device: torch.device) -> Tensor:
        s = self.settings
        if s.dsds_weight == 0 or s.cubes == 0:
            return torch.zeros((), dtype=wide_dtype(device), device=device)
        if not self.grid.observed.any():
            self._bootstrap(fields[0], device)
        cubes = draw_cubes(
            self.grid,
            self._rng(0),
            s,
            field_pitch=self._pitch.of_cubes,
            resolution=self.denoiser.manifest.resolution,
            device=device,
        )
        self.report.update(cubes=s.cubes, voxels=cubes.inside.numel(), outside=int((~cubes.inside).sum()))
        losses = [self._dsds_of_field(field, cubes, index) for index, field in enumerate(fields)]
        if s.skip_empty:
            self._watch.note(**self._seen, pitch=self.pitch)
        return torch.stack(losses).sum() * s.dsds_weight

    def _dsds_of_field(self, field: DensityFn, cubes: CubeBatch, index: int) -> Tensor:
        """Mean over the voxels in the box, unweighted."""
        if bool(cubes.inside.all()):  # nearly always: then nothing need be gathered and scattered
            values, valid = self._query(field, cubes.positions.flatten(0, 3))
            density, used = values.reshape(cubes.inside.shape), valid.reshape(cubes.inside.shape)
        else:
            values, valid = self._query(field, cubes.positions[cubes.inside])
            density = values.new_zeros(cubes.inside.shape).masked_scatter(cubes.inside, values)
            used = cubes.inside.clone().masked_scatter(cubes.inside, valid)
        if index == 0:
            self._refresh(*cubes.thinned(density.detach(), used))
        x0_pred = self._predict(density.detach(), cubes, field, index)
        factor = cubes.pitch if self.settings.rule.kind == "opacity" else torch.ones_like(cubes.pitch)
        loss = functools.partial(
            dsds_loss,
            target_density=self.settings.target_density(),
            threshold=self.threshold,
            fill_threshold=self.fill_threshold,
        )
        return cubewise_mean(loss, density, x0_pred, factor, used)

    def _predict(self, density: Tensor, cubes: CubeBatch, field: DensityFn, index: int) -> Tensor:
        """``x0_pred (N, R, R, R)`` float32; all empty for cubes that were not worth asking about."""
        s = self.settings
        x0_pred = torch.full_like(density, EMPTY, dtype=torch.float32)
        asked, channels = self._shown(density, cubes)
        skipped = int((~asked).sum())
        self.report.update(denoised=len(asked) - skipped, skipped_empty=skipped)
        if index == 0 and s.skip_empty:
            lowest, highest = (float(value) for value in torch.aminmax(density))
            self._seen = {"cubes": len(asked), "skipped": skipped, "lowest": lowest, "highest": highest}
        if not bool(asked.any()):
            return x0_pred
        if len(self.denoiser.manifest.channels) > 1:

            def ask(places: Tensor) -> Tensor:
                return self._query(field, places)[0]

            channels = complete_channels(
                self.denoiser.manifest.channels,
                channels,
                cubes,
                asked,
                viewing=self._viewing,
                maps=self._rays.through(ask, index=index, step=self.step, pitch=self.pitch, like=density),
                lines=self._evidence,
                surroundings=lambda: cube_surroundings(ask, cubes, asked, aabb=self.aabb, rule=s.rule, soft=s.soft),
            )
        t = s.timestep(self.step) if callable(s.timestep) else s.timestep
        t = self.denoiser.manifest.default_timestep if t is None else t
        timestep = int(check_timestep(t, caller="DensityRegularizer"))
        x0_pred[asked] = run_denoiser(
            self.denoiser, channels, timestep, cubes.edge_fraction[asked.cpu().numpy()], caller="DensityRegularizer"
        )[:, 0]
        return x0_pred

    def _shown(self, density: Tensor, cubes: CubeBatch) -> tuple[Tensor, Tensor]:
        """Which cubes are worth asking about, ``(N,)``, and what the denoiser sees of them: ``(n, 1, R, R, R)``."""
        s, asked, shown = self.settings, [], []
        for part in cube_parts(density):
            wide, pitch = widest(density[part]), cubes.pitch[part]
            # occupied, told without an exponential
            asked.append(
                (wide > s.rule.density_threshold(pitch)).flatten(1).any(dim=1)
                if s.skip_empty
                else torch.ones(len(wide), dtype=torch.bool, device=density.device)
            )
            if bool(asked[-1].any()):
                shown.append(s.rule.encode(wide[asked[-1]], pitch[asked[-1]], soft=s.soft).float())
        return torch.cat(asked), torch.cat(shown)[:, None] if shown else density[:0, None].float()

    def _visibility(self, fields: list[DensityFn], device: torch.device) -> Tensor:
        s = self.settings
        zero = torch.zeros((), dtype=wide_dtype(device), device=device)
        if self._views is None or self.cameras is None or s.visibility_weight == 0 or s.visibility_samples == 0:
            return zero
        box = grow_box(self.aabb, s.visibility_reach)
        points = visibility_points(
            self._rng(1), s.visibility_samples, aabb=box, cameras=self.cameras, kind=s.visibility_kind
        )
        counts = self._views(points)
        unseen = counts < s.min_views
        self.report.update(points=len(points), unseen=int(unseen.sum()))
        if not unseen.any():
            return zero
        positions = torch.as_tensor(points[unseen], dtype=torch.float32, device=device)
        views = torch.as_tensor(counts[unseen], device=device)
        total = zero
        for field in fields:  # seen points add nothing, so the field is not asked about them
            density, valid = self._query(field, positions)
            depth = widest(density) * self.pitch if s.rule.kind == "opacity" else density
            loss = visibility_loss(depth, views, min_views=s.min_views)
            total = total + stable_mean(torch.where(valid, loss, torch.zeros_like(loss)), count=len(points))
        return total * s.visibility_weight

    def _sight_lines(self, fields: list[DensityFn], device: torch.device) -> Tensor:
        s, lines = self.settings, self.lines
        zero = torch.zeros((), dtype=wide_dtype(device), device=device)
        if lines is None or not len(lines) or s.sight_lines == 0:
            return zero
        total = zero
        if s.sight_line_weight > 0:
            places, lengths = lines.sample(self._rng(3), s.sight_lines, samples=s.sight_line_samples)
            self.report["lines"] += len(places)
            length = torch.as_tensor(lengths, dtype=torch.float32, device=device)
            for field in fields:
                density = self._on_lines(field, places, device)
                total = total + stable_mean(sight_line_loss(density, length)) * s.sight_line_weight
        if s.end_point_weight > 0:
            reach = MARGIN_CELLS * self.pitch
            places, covered = lines.sample_ends(self._rng(4), s.sight_lines, reach=reach)
            for field in fields if len(places) else ():
                density = self._on_lines(field, places, device)
                span = covered if isinstance(covered, float) else torch.as_tensor(covered).to(density)
                total = total + stable_mean(end_point_loss(density, span)) * s.end_point_weight
        return total

    def _on_lines(self, field: DensityFn, places: NDArray[np.float64], device: torch.device) -> Tensor:
        """Densities ``(L, S)``; 0 where they are dropped."""
        positions = torch.as_tensor(places.reshape(-1, 3), dtype=torch.float32, device=device)
        density, valid = self._query(field, positions)
        return torch.where(valid, density, torch.zeros_like(density)).reshape(places.shape[:2])


def _as_float64(values: Any) -> NDArray[np.float64]:
    """An array or tensor (bfloat16 too, which numpy does not know) as a float64 array."""
    plain = values.detach() if isinstance(values, Tensor) else values
    plain = upcast(plain) if isinstance(plain, Tensor) and plain.is_floating_point() else plain
    return np.asarray(to_numpy(plain), dtype=np.float64)
