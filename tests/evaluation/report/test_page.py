import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from unghost.evaluation.report import charts as page_charts
from unghost.evaluation.report import page
from unghost.evaluation.report import pictures as page_pictures
from unghost.evaluation.report import tables as page_tables
from unghost.evaluation.report.charts import Series, line_chart
from unghost.evaluation.report.pictures import ViewPictures, error_picture, worst_first
from unghost.evaluation.report.tables import number, score_table

HOSTILE = '<img src=x onerror="alert(1)">&\'</script><script>alert(2)</script>'


class Reader(HTMLParser):
    """Tags, attributes and whether they nest."""

    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.tags, self.open, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img", "input", "line", "polyline"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, (tag, self.open)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text.append(data)


def read(text):
    reader = Reader()
    reader.feed(text)
    assert reader.open == []
    return reader


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
    reader = read(page.page_text({"rows": rows(), "command": "c", "commit": "d"}))
    for tag, attributes in reader.tags:
        for key in ("src", "href"):
            assert attributes.get(key, "data:").startswith("data:"), (tag, attributes)
    assert "url(" not in page.STYLE
    assert "@import" not in page.STYLE
    words = " ".join(reader.text)
    assert "a pixel counts in 1 of 2 views only" in words
    assert sum(tag == "svg" for tag, _ in reader.tags) == 2


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
    results = {
        "rows": found,
        "command": HOSTILE,
        "commit": HOSTILE,
        "versions": {HOSTILE: HOSTILE},
        "machine": {"cores": HOSTILE, "architecture": HOSTILE},
        "differences": [difference],
        "conventions": {HOSTILE: [{"metric": HOSTILE, HOSTILE: 1.0, "spread": None}]},
        "evaluation": {"views": 2, "width": 4, "height": 4, "gt": HOSTILE, "masks": HOSTILE, "notes": [HOSTILE]},
    }
    reader = read(page.page_text(results, [view]))
    assert [tag for tag, _ in reader.tags].count("script") == 1  # the page's own
    assert not [attributes for _, attributes in reader.tags if "onerror" in attributes]
    assert all(attributes["src"].startswith("data:image/jpeg") for tag, attributes in reader.tags if tag == "img")
    assert sum(HOSTILE in each for each in reader.text) > 10


def test_lpips_on_two_backbones_is_two_columns_that_name_them():
    found = [
        {"method": name, "convention": "proper", "lpips": value, "lpips_backbone": name}
        for name, value in (("vgg", 0.5), ("alex", 0.25))
    ]
    text = score_table(found, ["lpips"])
    assert re.findall(r"LPIPS \((\w+)\)", text) == ["vgg", "alex"]
    assert re.findall(r"<td>(.*?)</td>", text) == ["0.500", "–", "–", "0.250"]
    assert "LPIPS (" not in score_table([{"method": "a", "lpips": 0.5}], ["lpips"])


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
    reader = read(page.page_text({"rows": [*made, mean]}))
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
    assert "∞" in score_table([{"method": "a", "psnr": None, "infinite": ["psnr"]}], ["psnr"])
    assert score_table([{"method": "a", "psnr": None}], ["psnr"]) == ""
    assert "True" not in score_table([{"method": "a", "psnr": True, "ssim": 1.0}], ["psnr", "ssim"])


def test_a_difference_is_called_so_only_if_its_interval_leaves_out_zero():
    row = {"method": "a", "against": "b", "convention": "c", "images": 3}
    cases = [
        ("psnr", 1.0, 0.5, 1.5, "better"),
        ("flip", 1.0, 0.5, 1.5, "worse"),
        ("psnr", 1.0, -0.5, 2.5, "no difference"),
        ("coverage", -0.1, -0.2, -0.05, "differs"),
        ("psnr", 1.0, None, None, "one image"),
    ]
    for metric, mean, low, high, verdict in cases:
        text = page_tables.difference_table([{**row, "metric": metric, "difference": mean, "low": low, "high": high}])
        assert f">{verdict}" in text, (metric, verdict)


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


def test_charts_place_points_where_they_belong():
    drawn = line_chart([Series("a", (0.0, 1.0), (10.0, 20.0))], x_label="x", y_label="y")
    points = re.search(r'points="([^"]+)"', drawn).group(1).split()
    (x0, y0), (x1, y1) = ([float(each) for each in point.split(",")] for point in points)
    span = page_charts.WIDTH - page_charts.LEFT - page_charts.RIGHT
    assert x1 - x0 == pytest.approx(span / 1.12, abs=0.1)  # six hundredths of margin on either side
    assert y0 > y1
    assert line_chart([Series("a", (), ())], x_label="x", y_label="y") == ""
    single = line_chart([Series("a", (0.5,), (7.0,))], x_label="x", y_label="y")
    assert single.count("<circle") == 1
    assert "polyline" not in single


@pytest.mark.parametrize(("low", "high"), [(0, 1), (15, 36), (0.9, 0.91), (-3, 1e4), (1e-9, 2e-9)])
def test_ticks_are_few_and_inside(low, high):
    ticks = page_charts._ticks(low, high)
    assert 2 <= len(ticks) <= page_charts.TICKS + 1
    assert all(low - 1e-12 <= each <= high + 1e-12 for each in ticks)


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
