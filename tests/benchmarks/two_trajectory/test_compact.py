"""The compact form of the two-trajectory results keeps every cell and what the tables print."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks.two_trajectory.compact import (
    POINTS,
    compact,
    compact_rows,
    expanded,
    read_expanded,
    thinned,
    write_compact,
)
from benchmarks.two_trajectory.tables import AT_EQUAL, summary_rows

RESULTS = Path(__file__).parents[3] / "docs" / "results"
GRID = (0.02, 0.05, *(round(0.05 * step, 2) for step in range(2, 20)))


def curve(covered, bend):
    """As scores.py has it: the own coverage first, then the grid below it."""
    coverage = [covered, *(each for each in GRID if each < covered)]
    values = [20.0 + bend * math.sin(5 * each) for each in coverage]
    return {"coverage": coverage, **{key: list(values) for key in AT_EQUAL}}


def cell(method, scene, covered, **more):
    curves = {"spread": curve(covered, 1.0), "photos": curve(covered, 2.0), "own": curve(covered, 1.0)}
    scores = {"psnr": 20.123456789, "ssim": 0.123456789, "ause": {"spread": 0.25, "photos": None, "own": 0.25}}
    named = {"table": "main", "scene": scene, "seed": 0, "method": method, "convention": "proper", "factor": None}
    return {**named, "coverage": covered, **scores, "curves": curves, "note": "", **more}


@pytest.fixture
def results():
    knob = cell("bold @ 0.123456789", "a", 0.9, knob=0.123456789)
    del knob["curves"]["photos"]
    cells = [
        cell("field", "a", 0.901234567, conventions={"paper": {"psnr": 1.0, "ssim": None}}),
        cell("bold", "b", 0.6),
        cell("bold", "a", 0.53125, curves={**cell("bold", "a", 0.53125)["curves"], "own": curve(0.53125, 3.0)}),
        knob,
        cell("field", "b", 0.7, coverage=0.0, curves={}),
    ]
    return {"command": "x", "scenes": {"main": {}}, "cells": cells, "rows": summary_rows(cells)}


def test_every_cell_comes_back(results, tmp_path):
    write_compact(tmp_path / "r.json", results)
    found = read_expanded(tmp_path / "r.json")
    assert len(found["cells"]) == len(results["cells"])
    by = {(each["scene"], each["method"]): each for each in found["cells"]}
    for wanted in results["cells"]:
        got = by[wanted["scene"], wanted["method"]]
        for key in set(wanted) - {"curves", "ause", "coverage", "psnr", "ssim", "note", "conventions"}:
            assert got[key] == wanted[key]
        assert (got["psnr"], got["ssim"]) == (20.123, 0.12346)
        assert got["coverage"] == pytest.approx(wanted["coverage"], rel=1e-5)
        assert got["ause"] == {"spread": 0.25, "own": 0.25}
        assert set(got.get("curves", {})) == set(wanted["curves"])
        for order, each in got.get("curves", {}).items():
            assert each["coverage"][0] == got["coverage"]
            full = wanted["curves"][order]
            for place, value in list(zip(each["coverage"], each["psnr"]))[1:]:
                assert value == pytest.approx(full["psnr"][full["coverage"].index(place)], abs=5e-4)
    assert by["a", "field"]["conventions"] == {"paper": {"psnr": 1.0, "ssim": None}}
    assert by["a", "bold"]["curves"]["own"] != by["a", "bold"]["curves"]["spread"]


def test_several_factors_and_idle_losses_come_back(tmp_path):
    more = {"factor": [0.123456789, 0.01], "points": "12ab34cd", "changed_share": 0.25, "idle": ["sight_lines"]}
    cells = [cell("bold", "a", 0.5, **more), cell("field", "a", 0.6)]
    write_compact(tmp_path / "r.json", {"cells": cells, "rows": summary_rows(cells)})
    first, second = read_expanded(tmp_path / "r.json")["cells"]
    assert {key: first[key] for key in more} == more
    assert not second.get("idle")
    assert second.get("changed_share") is None  # a row from before it was recorded: nothing is said of it


def test_what_is_compact_does_not_change(results):
    once = json.loads(json.dumps(compact(results)))
    assert compact(once) == once
    assert compact(expanded(once)) == once


def test_scores_at_equal_coverage_do_not_change(results):
    before, after = (summary_rows(expanded(each)["cells"]) for each in (results, compact(results)))
    for old, new in zip(before, after):
        for key in (f"psnr_at_coverage{order}" for order in ("", "_by_spread", "_by_photos", "_at_best")):
            assert new[key] == (None if old[key] is None else pytest.approx(old[key], abs=2e-3)), key
        for key in () if "@" in new["method"] else ("psnr_area", "psnr_area_by_photos"):
            assert new[key] == (None if old[key] is None else pytest.approx(old[key], abs=0.02)), key


@pytest.mark.parametrize("lowest", [0.03, 0.1, 0.43, 0.8123, 0.9012])
def test_points_that_tables_need_stay(lowest):
    curves = {"spread": curve(0.9012, 1.0), "photos": curve(0.9012, 2.0)}
    found = thinned(curves, lowest)
    coverage = sorted(found["spread"]["coverage"])
    assert len(coverage) == POINTS
    assert found["photos"]["coverage"] == found["spread"]["coverage"]
    assert found["spread"]["coverage"][0] == 0.9012
    everywhere = sorted(curves["spread"]["coverage"])
    for end in (0.1, lowest):
        below = np.searchsorted(everywhere, end, side="right") - 1
        assert set(everywhere[below : below + 2]) <= set(coverage)
    assert thinned(found, lowest) == found
    assert thinned({}, lowest) == {}
    assert len(thinned(curves, lowest, points=0)["spread"]["coverage"]) <= 5


def test_rows_keep_what_is_printed():
    intervals = {"psnr": [19.123456, 21.0], "psnr_area": [1.005, 2.0], "ssim_area": [0.1, 0.2], "flip": [None, None]}
    row = {"method": "a", "psnr": 20.123456789, "ssim": None, "normal_mean_deg_area": 3.0, "intervals": intervals}
    expected = {"method": "a", "psnr": 20.12346, "intervals": {"psnr": [19.12, 21.0], "psnr_area": [1.0, 2.0]}}
    assert compact_rows([row]) == compact_rows(compact_rows([row])) == [expected]


@pytest.mark.slow
def test_the_stored_results_are_compact():
    path = RESULTS / "two_trajectory.json"
    assert path.stat().st_size <= 700_000
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert compact(stored) == stored
    assert len(expanded(stored)["cells"]) == sum(len(run["cells"]) for run in stored["runs"]) == 600
