import sys

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.report import rows as report

A = {"seed": 0, "psnr": 18.0, "coverage": 0.9, "views_scored": 4, "convention": "paper"}
B = {"seed": 1, "psnr": 20.0, "coverage": 0.8, "views_scored": 4, "convention": "paper"}


def test_a_row_is_the_mean_over_seeds_and_keeps_each_seed():
    row = report.mean_over_seeds("dsds", [A, B])
    assert row["method"] == "dsds"
    assert row["psnr"] == pytest.approx(19)
    assert row["coverage"] == pytest.approx(0.85)
    assert row["convention"] == "paper"
    assert [scores["seed"] for scores in row["per_seed"]] == [0, 1]
    assert [scores["psnr"] for scores in row["per_seed"]] == [18, 20]
    assert "seed" not in row


def test_a_seed_without_a_number_leaves_no_mean():
    row = report.mean_over_seeds("field", [A, {**B, "psnr": float("nan")}])
    assert row["psnr"] is None
    assert row["per_seed"][1]["psnr"] is None
    assert report.mean_over_seeds("field", [A, {**B, "psnr": None}]) == row
    assert row["coverage"] == pytest.approx(0.85)


def test_conventions_and_keys_do_not_mix():
    with pytest.raises(ValueError, match="conventions do not mix"):
        report.mean_over_seeds("field", [A, {**B, "convention": "other"}])
    with pytest.raises(ValueError, match="same keys"):
        report.mean_over_seeds("field", [A, {"seed": 1}])
    with pytest.raises(ValueError, match="at least one"):
        report.mean_over_seeds("field", [])
    with pytest.raises(ValueError, match="must not stand in one table"):
        report.format_table([{"method": "a", "convention": "x"}, {"method": "b", "convention": "y"}])


def test_the_table_shows_numbers_and_their_absence():
    text = report.format_table(
        [{"method": "field", "psnr": 18.98, "ssim": None}, {"method": "dsds", "psnr": 19.5}], ["psnr", "ssim"]
    )
    assert [line.split() for line in text.splitlines()] == [
        ["method", "psnr", "ssim"],
        ["field", "18.980", "–"],
        ["dsds", "19.500", "–"],
    ]


def test_the_figure_shows_every_column_and_view(tmp_path):
    rng = np.random.default_rng(0)
    columns = {
        name: {"rgb": np.full((3, 12, 16, 3), level), "depth": rng.uniform(1, 3, (3, 12, 16))}
        for name, level in (("photo", 0.2), ("field", 0.7))
    }
    columns["field"]["depth"][:] = np.inf
    before = columns["field"]["rgb"].copy()
    report.draw_comparison(tmp_path / "a" / "b.png", columns, views=[0, 2], limit=5.0, title="t", note="n")
    pixels = np.asarray(Image.open(tmp_path / "a" / "b.png").convert("RGB")).astype(int)
    grey = (np.abs(pixels - round(0.7 * 255)).max(axis=-1) <= 2).mean()
    dark = (np.abs(pixels - round(0.2 * 255)).max(axis=-1) <= 2).mean()
    nothing = (np.abs(pixels - round(0.55 * 255)).max(axis=-1) <= 2).mean()
    assert min(grey, dark, nothing) > 0.1  # two views each of the eight cells
    np.testing.assert_array_equal(columns["field"]["rgb"], before)


def test_depth_colours_are_warm_when_near_and_grey_beyond_the_limit():
    from matplotlib import colormaps

    painted = report._paint(np.array([[1.0, 4.0, np.inf]]), 1.0, 4.0, 5.0, colormaps["turbo"])
    assert painted[0, 0, 0] > painted[0, 0, 2]  # red over blue
    assert painted[0, 1, 0] < painted[0, 1, 2] + 0.05
    np.testing.assert_allclose(painted[0, 2], 0.55)


def test_without_matplotlib_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[eval\]"):
        report.draw_comparison(tmp_path / "a.png", {}, views=[0], limit=1.0, title="t")


def test_the_refusal_names_both_conventions_and_rows():
    rows = [{"method": "field", "convention": "proper"}, {"method": "dsds", "convention": "paper_code"}]
    with pytest.raises(
        ValueError, match=r"'proper' \(row 'field'\) and 'paper_code' \(row 'dsds'\) must not stand in one"
    ):
        report.format_table(rows)
    with pytest.raises(ValueError, match=r"None \(row 'field'\) and 'proper' \(row 'dsds'\)"):
        report.format_table([{"method": "field"}, {"method": "dsds", "convention": "proper"}])


def test_conventions_stand_side_by_side_in_a_column_each():
    scores = {
        "proper": {"convention": "proper", "psnr": 17.0, "ssim": 0.5, "coverage": 0.6},
        "nerfbaselines": {"convention": "nerfbaselines", "psnr": 19.0, "ssim": 0.75},
        "paper_code": {"convention": "paper_code", "psnr": float("inf"), "ssim": None, "coverage": 0.8},
    }
    rows = {row["metric"]: row for row in report.convention_rows(scores)}
    assert rows["psnr"]["spread"] == 2.0  # infinity is no distance
    assert rows["ssim"] == {"metric": "ssim", "proper": 0.5, "nerfbaselines": 0.75, "paper_code": None, "spread": 0.25}
    assert rows["coverage"]["nerfbaselines"] is None
    assert rows["coverage"]["spread"] == pytest.approx(0.2)
    assert rows["flip"]["spread"] is None
    lines = [line.split() for line in report.format_conventions(scores).splitlines()]
    assert lines[0] == ["metric", "proper", "nerfbaselines", "paper_code", "spread"]
    assert lines[1] == ["psnr", "17.000", "19.000", "inf", "2.000"]
    assert ["coverage", "0.600", "–", "0.800", "0.200"] in lines
    with pytest.raises(ValueError, match="given as 'proper' are of 'paper_code'"):
        report.convention_rows({"proper": scores["paper_code"]})
