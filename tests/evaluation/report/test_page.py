import json
import re

import numpy as np
import pytest
from unghost_tests.pages import HOSTILE, read_page

from unghost.evaluation.report import page
from unghost.evaluation.report import pictures as page_pictures
from unghost.evaluation.report import tables as page_tables
from unghost.evaluation.report.pictures import ViewPictures, error_picture, worst_first
from unghost.evaluation.report.tables import number, score_table


def rows():
    image = {"name": "v0", "pixels": 9, "psnr": 20.0, "coverage": 0.9, "infinite": []}
    return [
        {
            "method": "a",
            "convention": "proper",
            "psnr": 20.0,
            "coverage": 0.9,
            "intervals": {"psnr": [19.0, 21.0]},
            "images": 2,
            "images_scored": 2,
            "per_image": [image, {**image, "name": "v1", "psnr": 22.0}],
            "curve": [{"coverage": 0.5, "psnr": 23.0}, {"coverage": 0.9, "psnr": 20.0}],
        },
        {
            "method": "b",
            "convention": "proper",
            "psnr": 18.0,
            "coverage": 1.0,
            "images": 2,
            "images_scored": 1,
            "per_image": [image, {**image, "name": "v1", "psnr": None}],
        },
    ]


def test_the_page_is_one_file_that_nests_and_fetches_nothing():
    reader = read_page(page.page_text({"rows": rows(), "command": "c", "commit": "d"}))
    assert "a pixel counts in 1 of 2 views only" in reader.words
    assert reader.count("svg") == 2


def test_hostile_names_are_text_everywhere():
    picture = page_pictures.jpeg(np.zeros((4, 4, 3)))
    found = rows()
    for row in found:
        row["method"] += HOSTILE
        row["scene"] = HOSTILE
        for each in row["per_image"]:
            each["name"] += HOSTILE
    shown = {"photo": picture} | {row["method"]: picture for row in found}
    errors = {row["method"]: picture for row in found}
    view = ViewPictures("v0" + HOSTILE, shown, errors, dict.fromkeys(errors, HOSTILE), True)
    difference = {
        "method": HOSTILE,
        "against": HOSTILE,
        "convention": "proper",
        "metric": HOSTILE,
        "difference": 1.0,
        "low": 0.5,
        "high": 2.0,
        "images": 2,
    }
    ahead = {"method": HOSTILE, "point": HOSTILE, "coverage": 0.5, "psnr": 1.0, "psnr_point": 2.0, "ahead": 1.0}
    results = {
        "rows": found,
        "command": HOSTILE,
        "commit": HOSTILE,
        "versions": {HOSTILE: HOSTILE},
        "machine": {"cores": HOSTILE, "architecture": HOSTILE},
        "differences": [difference],
        "against_points": [ahead],
        "conventions": {HOSTILE: [{"metric": HOSTILE, HOSTILE: 1.0, "spread": None}]},
        "evaluation": {"views": 2, "width": 4, "height": 4, "gt": HOSTILE, "masks": HOSTILE, "notes": [HOSTILE]},
    }
    reader = read_page(page.page_text(results, [view]))
    assert reader.count("script") == 1  # the page's own
    assert all(attributes["src"].startswith("data:image/jpeg") for tag, attributes in reader.tags if tag == "img")
    assert sum(HOSTILE in each for each in reader.text) > 10


def texts(row):
    return [cell if isinstance(cell, str) else cell.text for cell in row]


def test_lpips_on_two_backbones_is_two_columns_that_name_them():
    found = [
        {"method": name, "convention": "proper", "lpips": value, "lpips_backbone": name}
        for name, value in (("vgg", 0.5), ("alex", 0.25))
    ]
    table = score_table(found, ["lpips"])
    assert re.findall(r"LPIPS \((\w+)\)", " ".join(table.heads)) == ["vgg", "alex"]
    assert [texts(row) for row in table.rows] == [["vgg", "0.500", "–"], ["alex", "–", "0.250"]]
    assert score_table([{"method": "a", "lpips": 0.5}], ["lpips"]).heads == ["method", "LPIPS\N{NO-BREAK SPACE}↓"]


def test_the_interval_is_below_its_mean_and_the_colour_before_the_name():
    table = score_table(rows(), ["psnr"], {"a": 0, "b": 1})
    (name, score), (other, plain) = table.rows
    assert (name.text, name.series, other.series) == ("a", 0, 1)
    assert (score.text, score.below, plain.below) == ("20.00", "19.00 – 21.00", "")


def test_two_conventions_are_two_tables_and_one_table_refuses_both():
    second = {"method": "a", "convention": "paper_code", "psnr": 25.0, "coverage": 0.4}
    with pytest.raises(ValueError, match=r"'proper' \(row 'a'\) and 'paper_code' \(row 'a'\) must not stand in one"):
        score_table([rows()[0], second], ["psnr"])
    text = page.page_text({"rows": [*rows(), second]})
    tables = re.findall(r"<table>.*?</table>", text, re.S)
    assert not [each for each in tables if "20.00" in each and "25.00" in each]
    assert "Under <code>proper</code>" in text
    assert "Under <code>paper_code</code>" in text


def test_results_of_other_programs_make_a_page_too():
    made = [
        {
            "method": name,
            "scene": scene,
            "seed": seed,
            "convention": convention,
            "psnr": 17.0 + seed,
            "ssim": None,
            "coverage": 0.8,
            "curve": [
                {"coverage": 0.4, "psnr": 18.0 + seed, "threshold": 0.5},
                {"coverage": 0.8, "psnr": 17.0 + seed, "threshold": 0.1},
            ],
        }
        for name in ("ours", "theirs")
        for scene in ("room", "hall")
        for seed in (0, 1)
        for convention in ("proper", "paper_code")
    ]
    mean = {"method": "ours", "scene": "mean", "convention": "proper", "psnr": 17.5, "coverage": 0.8, "per_seed": [{}]}
    reader = read_page(page.page_text({"rows": [*made, mean]}))
    tags = [tag for tag, _ in reader.tags]
    assert tags.count("svg") == 2 * 2 + 1  # a convention and a scene each, and the mean's single point
    assert tags.count("polyline") == 2 * 2 * 2 * 2
    assert "SSIM ↑" not in reader.text  # nobody has one


def test_numbers_and_what_stands_for_none():
    assert number(None, 2) == "–"
    assert number(None, 2, infinite=True) == number(float("inf"), 2) == "∞"
    assert number(float("nan"), 2) == "–"
    assert number(-1.234, 2) == "−1.23"
    assert number(-0.001, 2) == "0.00"
    assert number("text", 2) == "–"
    assert page_tables._signed(0.004, 2) == "0.00"
    assert page_tables._signed(0.4, 2) == "+0.40"
    endless = score_table([{"method": "a", "psnr": None, "infinite": ["psnr"]}], ["psnr"])
    assert texts(endless.rows[0]) == ["a", "∞"]
    assert score_table([{"method": "a", "psnr": None}], ["psnr"]) is None
    assert texts(score_table([{"method": "a", "psnr": True, "ssim": 1.0}], ["psnr", "ssim"]).rows[0]) == ["a", "1.000"]


def test_a_difference_is_called_so_only_if_its_interval_leaves_out_zero():
    row = {"method": "a", "against": "b", "convention": "c", "images": 3}
    cases = [
        ("psnr", 1.0, 0.5, 1.5, "better", "better"),
        ("flip", 1.0, 0.5, 1.5, "worse", "worse"),
        ("psnr", 1.0, -0.5, 2.5, "no difference shown", "weak"),
        ("coverage", -0.1, -0.2, -0.05, "differs", ""),
        ("psnr", 1.0, None, None, "one image", "weak"),
    ]
    for metric, mean, low, high, verdict, style in cases:
        table = page_tables.difference_table([{**row, "metric": metric, "difference": mean, "low": low, "high": high}])
        cell = table.rows[0][table.heads.index("verdict")]
        assert (cell.text, cell.style) == (verdict, style), metric


def test_the_worst_come_first_and_the_undefined_last():
    images = [
        {"name": "a", "psnr": 20.0, "flip": 0.1},
        {"name": "b", "psnr": None, "infinite": ["psnr"], "flip": 0.0},
        {"name": "c", "psnr": 10.0, "flip": 0.3},
        {"name": "d", "psnr": None, "flip": None},
    ]
    assert worst_first(images, "psnr") == ["c", "a", "b", "d"]
    assert worst_first(images, "flip") == ["c", "a", "b", "d"]
    with pytest.raises(ValueError, match=r"key must be one of psnr, ssim, .* got 'coverage'"):
        worst_first(images, "coverage")


def test_errors_are_painted_by_size_and_grey_where_nothing_counts():
    target = np.zeros((1, 4, 3))
    preds = np.zeros((1, 4, 3))
    preds[0, 1, 0], preds[0, 2] = 0.25, 0.9
    painted = error_picture(preds, target, np.array([[True, True, True, False]]))
    np.testing.assert_allclose(painted[0, 0], page_pictures.HEAT[0])
    np.testing.assert_allclose(painted[0, 1], page_pictures.HEAT[2])  # half of WORST: the middle
    np.testing.assert_allclose(painted[0, 2], page_pictures.HEAT[-1])
    np.testing.assert_allclose(painted[0, 3], page_pictures.NOT_COUNTED)
    assert preds[0, 3].max() == 0


def test_results_files_are_read_with_care(tmp_path):
    path = tmp_path / "r.json"
    with pytest.raises(FileNotFoundError, match="read_results: no file"):
        page.read_results(path)
    path.write_text("{")
    with pytest.raises(ValueError, match="is not JSON"):
        page.read_results(path)
    for body in ([], {"rows": []}, {"rows": [{"psnr": 1}]}, {"rows": {"method": 1}}):
        path.write_text(json.dumps(body))
        with pytest.raises(ValueError, match="has no rows with a method each"):
            page.read_results(path)
    with pytest.raises(ValueError, match="results must have rows, each with a method"):
        page.page_text({"rows": [{}]})
    path.write_text(json.dumps({"rows": rows()}))
    page.write_page(tmp_path / "new" / "p.html", page.read_results(path))
    assert [each.name for each in (tmp_path / "new").iterdir()] == ["p.html"]
