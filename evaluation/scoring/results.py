"""Results of scoring several methods: rows, scores of each view, curves; written as a table, a page and files."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from ...core.io import write_bytes
from ...core.results import build_results, write_results
from ..report.page import write_page
from ..report.pictures import PHOTO, ViewPictures, view_pictures, worst_first
from ..report.rows import format_table
from ..report.tables import EQUAL_KEYS, OWN_KEYS, present
from .comparison import method_curves
from .conventions import evaluation_masks, get_convention
from .curves import Curve
from .ground_truth import GroundTruth
from .renders import Method

Row: TypeAlias = Mapping[str, Any]  # a row of the results file: docs/formats.md

CAPTION_KEYS = ("psnr", "ssim", "coverage")
PAIRS = 12  # views that a page shows as pictures


@dataclass(frozen=True)
class ViewScores:
    """Scores of one view.

    Attributes:
        name: of the view.
        pixels: that count.
        scores: metric -> value; None where it is not defined, inf where the render equals its photo.
    """

    name: str
    pixels: int
    scores: Mapping[str, float | None]


@dataclass(frozen=True, eq=False)
class Results:
    """Scores of several methods on the same views, as :func:`unghost.evaluation.evaluate` gives them.

    Attributes:
        convention: that all rows are scored under.
        rows: a row a method, references first, as in the results file (docs/formats.md).
        differences: each method less each reference, a row a metric, with bootstrap intervals.
        against_points: methods with a knob against those without, at the latter's coverage.
        conventions: method -> its renders under every convention, a row a metric; empty unless asked for.
        notes: sentences for the user: what was left out or chosen, and why.
        references: methods that the others are compared with.
        sort: metric by which the views of a page are sorted, the worst first.
        methods: what was scored.
        ground_truth: what it was scored against.
        seed: of the bootstrap.
    """

    convention: str
    rows: tuple[Row, ...]
    differences: tuple[Row, ...]
    against_points: tuple[Row, ...]
    conventions: Mapping[str, Sequence[Row]]
    notes: tuple[str, ...]
    references: tuple[str, ...]
    sort: str
    methods: tuple[Method, ...] = field(repr=False)
    ground_truth: GroundTruth = field(repr=False)
    seed: int = 0

    @property
    def scores(self) -> dict[str, dict[str, float | None]]:
        """Method -> metric -> mean over its views: None if undefined, inf if a render equals its photo."""
        keys = get_convention(self.convention).keys
        return {row["method"]: _restored(row, keys) for row in self.rows}

    @property
    def views(self) -> dict[str, tuple[ViewScores, ...]]:
        """Method -> scores of each view, in order."""
        keys = get_convention(self.convention).keys
        return {
            row["method"]: tuple(
                ViewScores(each["name"], each["pixels"], _restored(each, keys)) for each in row["per_image"]
            )
            for row in self.rows
        }

    @property
    def curves(self) -> dict[str, Curve]:
        """Method -> PSNR over coverage; a single point for a method without a knob. Without scores, no curve."""
        return method_curves(self.rows)

    @property
    def left_out(self) -> dict[str, dict[str, str]]:
        """Method -> metric of the convention that is not computed -> why."""
        return {row["method"]: dict(row["notes"]) for row in self.rows}

    def table(self) -> str:
        """Scores as aligned text, one method a line, then the notes."""
        shown = [{**row, **dict.fromkeys(row["infinite"], float("inf"))} for row in self.rows]
        return "\n".join([format_table(shown, present(self.rows, [*OWN_KEYS, *EQUAL_KEYS])), *self.notes])

    def to_json(self, *, command: str | None = None) -> dict[str, Any]:
        """The results object of docs/formats.md.

        Args:
            command: that was run; the program's own name and arguments if None.
        """
        extra: dict[str, Any] = {"evaluation": self._facts(), "against_points": list(self.against_points)}
        extra["differences"] = list(self.differences)
        if self.conventions:
            extra["conventions"] = dict(self.conventions)
        return build_results(self.rows, command=command, seeds=[self.seed], **extra)

    def page(self, path: str | Path, *, pairs: int = PAIRS, command: str | None = None) -> None:
        """Write an HTML page with tables, curves and the worst views as pictures. Needs Pillow (``unghost[eval]``).

        Args:
            path: of the page.
            pairs: how many views are shown as pictures.
            command: as :meth:`to_json` takes it.
        """
        write_page(path, self.to_json(command=command), self._pictures(pairs))

    def write(self, folder: str | Path, *, pairs: int = PAIRS, command: str | None = None) -> None:
        """Write ``report.html``, ``results.json`` and ``images.csv``.

        Args:
            folder: made if absent.
            pairs, command: as :meth:`page` takes them.
        """
        out, results, pictures = Path(folder), self.to_json(command=command), self._pictures(pairs)
        write_results(out / "results.json", results)
        _write_views(out / "images.csv", self.rows)
        write_page(out / "report.html", results, pictures)

    @property
    def sorted_by(self) -> Row:
        """The row of the first method that is no reference."""
        return self.rows[len(self.references) % len(self.rows)]

    def _facts(self) -> dict[str, Any]:
        against, main = self.ground_truth, self.sorted_by["method"]
        extent = against.extent
        return {
            "convention": self.convention,
            "views": len(against.truth),
            "width": against.truth.photos.shape[2],
            "height": against.truth.photos.shape[1],
            "gt": against.name,
            "sort": self.sort,
            "sorted_by": main,
            "references": list(self.references),
            "wipe": [self.references[0], main] if self.references else [main, PHOTO],
            "extent": None if extent is None else {"limit": extent.limit, "unit": extent.unit},
            **against.facts,
            "notes": list(self.notes),
        }

    def _pictures(self, pairs: int) -> list[ViewPictures]:
        rule, truth, extent = get_convention(self.convention), self.ground_truth.truth, self.ground_truth.extent
        masks = {each.name: evaluation_masks(rule, each.renders, truth, extent) for each in self.methods}
        order = worst_first(self.sorted_by["per_image"], self.sort)[: max(pairs, 0)]
        return view_pictures(order, self.methods, truth, masks, self.rows, keys=CAPTION_KEYS)


def _restored(row: Row, keys: Sequence[str]) -> dict[str, float | None]:
    """Scores with infinity where the stored null stands for it."""
    return {key: float("inf") if key in row["infinite"] else row.get(key) for key in keys}


def _write_views(path: Path, rows: Sequence[Row]) -> None:
    """A line a view and method; an empty cell where a metric is undefined, inf where a render equals its photo."""
    keys = [key for key in rows[0]["per_image"][0] if key not in ("name", "pixels", "infinite")]
    stream = io.StringIO(newline="")
    writer = csv.writer(stream)
    writer.writerow(["method", "convention", "view", "pixels", *keys])
    for row in rows:
        for each in row["per_image"]:
            values = ["inf" if key in each["infinite"] else each[key] for key in keys]
            writer.writerow([row["method"], row["convention"], each["name"], each["pixels"], *values])
    write_bytes(path, stream.getvalue().encode("utf-8"))
