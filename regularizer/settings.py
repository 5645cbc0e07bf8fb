"""What can be set of a :class:`DensityRegularizer`; validated, saved with the run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..core.errors import InvalidArgument
from ..core.occupancy import OccupancyRule
from ..core.schedule import check_timestep
from ..core.sight_lines import MOST_REACH
from .proposals import Strategy
from .visibility import PointKind

Timestep = int | Callable[[int], int] | None

SURE = 0.9  # score from which a voxel is filled


@dataclass(frozen=True)
class RegularizerSettings:
    """Numbers of the regularizer, with where they come from.

    Attributes:
        cubes: cubes a step (40: the paper).
        every: calls from one that does something to the next; those between cost nothing and return zeros.
        edge_range: lowest and highest cube edge as fractions of the scene extent; None: .5-1.25 field cells a
            voxel (.01-.1: the paper).
        rotate: turn every cube at random (uniform on SO(3)); False keeps the scene's axes.
        strategy: ``"mixed"``, ``"importance"`` or ``"uniform"`` cube centres.
        uniform_share: of the mixed strategy, in [0, 1].
        timestep: for the denoiser; None for its default, or a function of the step.
        threshold: ``x0_pred`` below it is pushed out (0: the paper); None for what the manifest advises ``clean``.
        fill_threshold: ``x0_pred`` at or above it is filled (0: the paper); what lies between the two is left alone.
            None for .9, or ``threshold`` if higher.
        target: ``w`` of eq. 2, up to which it is filled: an opacity of a field cell in (0, 1), or a density > 0 under
            the density rule, at or above the rule's threshold. None for that threshold (the paper): what is filled
            then never counts as occupied, so nothing grows from it. With more holes close, and a capture's fog sets.
        dsds_weight, visibility_weight: factors of the losses; 0 switches one off, its queries too. Under the
            opacity rule the losses are optical depths per cell, so the weights do not depend on the scene's unit.
        visibility_samples: points a step for the visibility loss.
        visibility_kind: ``"mixed"``, ``"rays"`` (the paper) or ``"uniform"`` points.
        visibility_reach: how many times the aabb those points may go out to, >= 1.
        sight_line_weight, end_point_weight: factors of the two terms of the sight-line loss, which needs ``points``:
            the mean opacity of random sight lines, and the mean transparency of four field cells about their points.
        sight_lines, sight_line_samples: lines a step for each term, and places on each.
        sight_line_reach: how many times the aabb the lines may go out to, in [1, 2^20]; the box of ``visibility_reach``
            is always covered. More is for contracted fields: lines to points beyond that box end earlier.
        light_steps: for a denoiser that asks how well the photos see a place through the field: steps after which
            the rays are followed anew.
        min_views: points seen by fewer cameras are penalised (1: the paper).
        rule: density to occupancy.
        soft: show the denoiser opacities rather than bits (opacity rule only).
        skip_empty: do not send cubes without an occupied voxel to the denoiser; see ``DensityRegularizer``.
        drop_invalid: leave NaN, infinite and negative densities out of the loss and count them, instead of raising.
        grid_resolution, grid_decay: of the importance grid (20: the paper).
        chunk: most positions handed to a density function at once.
        seed: of everything random.

    Example:
        >>> RegularizerSettings(cubes=12).cubes, RegularizerSettings.paper().rule.threshold
        (12, 0.01)
    """

    cubes: int = 40
    every: int = 1
    edge_range: tuple[float, float] | None = None
    rotate: bool = False
    strategy: Strategy = "mixed"
    uniform_share: float = 0.25
    timestep: Timestep = None
    threshold: float | None = -0.9
    fill_threshold: float | None = None
    target: float | None = None
    dsds_weight: float = 0.1
    visibility_weight: float = 1.0
    visibility_samples: int = 32768
    visibility_kind: PointKind = "mixed"
    visibility_reach: float = 1.0
    sight_line_weight: float = 0.03
    end_point_weight: float = 0.01
    sight_lines: int = 4096
    sight_line_samples: int = 12
    sight_line_reach: float = 1.0
    light_steps: int = 50
    min_views: int = 1
    rule: OccupancyRule = dataclasses.field(default_factory=OccupancyRule)
    soft: bool = True
    skip_empty: bool = True
    drop_invalid: bool = False
    grid_resolution: int = 20
    grid_decay: float = 0.9
    chunk: int = 1 << 18
    seed: int = 0

    def __post_init__(self) -> None:
        rules: dict[str, tuple[bool, str]] = {
            "cubes": (self.cubes >= 0, ">= 0"),
            "every": (self.every >= 1, ">= 1"),
            "visibility_samples": (self.visibility_samples >= 0, ">= 0"),
            "sight_lines": (self.sight_lines >= 0, ">= 0"),
            "sight_line_samples": (self.sight_line_samples >= 1, ">= 1"),
            "sight_line_reach": (1 <= self.sight_line_reach <= MOST_REACH, f"in [1, {MOST_REACH:.0f}]"),
            "sight_line_weight": (
                math.isfinite(self.sight_line_weight) and self.sight_line_weight >= 0,
                "finite and >= 0",
            ),
            "end_point_weight": (
                math.isfinite(self.end_point_weight) and self.end_point_weight >= 0,
                "finite and >= 0",
            ),
            "light_steps": (self.light_steps >= 1, ">= 1"),
            "min_views": (self.min_views >= 1, ">= 1"),
            "chunk": (self.chunk >= 1, ">= 1"),
            "seed": (self.seed >= 0, ">= 0"),
            "dsds_weight": (math.isfinite(self.dsds_weight) and self.dsds_weight >= 0, "finite and >= 0"),
            "visibility_weight": (
                math.isfinite(self.visibility_weight) and self.visibility_weight >= 0,
                "finite and >= 0",
            ),
            "visibility_reach": (
                math.isfinite(self.visibility_reach) and self.visibility_reach >= 1,
                "finite and >= 1",
            ),
            "uniform_share": (0.0 <= self.uniform_share <= 1.0, "in [0, 1]"),
            "strategy": (self.strategy in ("mixed", "importance", "uniform"), "mixed, importance or uniform"),
            "visibility_kind": (self.visibility_kind in ("mixed", "rays", "uniform"), "mixed, rays or uniform"),
            "edge_range": (self.edge_range is None or _is_range(self.edge_range), "0 < low <= high, finite"),
            "threshold": (self.threshold is None or -1 <= self.threshold <= 1, "in [-1, 1]"),
            "target": (
                self.target is None or self.rule.threshold <= self.target < self._most_target(),
                f"in [{self.rule.threshold} (the rule's threshold), {self._most_target()})",
            ),
            "fill_threshold": (self.fill_threshold is None or -1 <= self.fill_threshold <= 1, "in [-1, 1]"),
        }
        for name, (holds, rule) in rules.items():
            if not holds:
                raise InvalidArgument(f"DensityRegularizer: {name} must be {rule}, got {getattr(self, name)!r}")
        if self.timestep is not None and not callable(self.timestep):
            check_timestep(self.timestep, caller="DensityRegularizer")

    def _most_target(self) -> float:
        return 1.0 if self.rule.kind == "opacity" else math.inf

    def target_density(self) -> float:
        """``w`` as the loss takes it: an optical depth of a cell, under the density rule a density."""
        target = self.rule.threshold if self.target is None else self.target
        return target if self.rule.kind == "density" else -math.log1p(-target)

    @classmethod
    def paper(cls, **overrides: Any) -> RegularizerSettings:
        """What the paper has: raw densities and bits, one threshold, cubes of 1 to 10 % by importance, rays' samples.

        The weights stay ours, as it gives none.
        """
        known = {
            "threshold": 0.0,
            "fill_threshold": 0.0,
            "rule": OccupancyRule.paper(),
            "soft": False,
            "edge_range": (0.01, 0.1),
            "strategy": "importance",
            "visibility_kind": "rays",
        }
        return cls(**{**known, **overrides})


def _is_range(edge_range: tuple[float, float]) -> bool:
    return len(edge_range) == 2 and 0 < edge_range[0] <= edge_range[1] and math.isfinite(edge_range[1])
