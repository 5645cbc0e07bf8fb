import xml.dom.minidom

import numpy as np
import pytest
from unghost_tests.pages import HOSTILE

from unghost.core.pages import charts
from unghost.core.pages.charts import LineChart, Series, colours_of, histogram, line_chart, percent, series_class
from unghost.core.pages.rendering import environment


def drawn(name, *arguments):
    """SVG of a macro, parsed."""
    macros = environment().get_template("macros.html.jinja").module
    return xml.dom.minidom.parseString(str(getattr(macros, name)(*arguments)).strip())


def test_charts_place_points_where_they_belong():
    chart = line_chart([Series("a", (0.0, 1.0), (10.0, 20.0))], x_label="x", y_label="y")
    (polyline,) = drawn("line_chart", chart).getElementsByTagName("polyline")
    points = polyline.getAttribute("points").split()
    (x0, y0), (x1, y1) = ([float(each) for each in point.split(",")] for point in points)
    span = LineChart.right - LineChart.left
    assert x1 - x0 == pytest.approx(span / 1.12, abs=0.1)  # six hundredths of margin on either side
    assert y0 > y1
    assert line_chart([Series("a", (), ())], x_label="x", y_label="y") is None
    single = drawn("line_chart", line_chart([Series("a", (0.5,), (7.0,))], x_label="x", y_label="y"))
    assert len(single.getElementsByTagName("circle")) == 1
    assert not single.getElementsByTagName("polyline")


def test_seeds_share_a_key_and_points_have_notes():
    two = [Series("a", (0.0, 1.0), (1.0, 2.0), 3, ("first",)), Series("a", (0.0,), (3.0,), 3)]
    chart = line_chart(two, x_label="x", y_label="y")
    assert chart.key == ((3, "a"),)
    assert [point.text for point in chart.lines[0].points] == ["first", "1, 2"]


def test_labels_are_text():
    chart = line_chart([Series(HOSTILE, (0.0, 1.0), (1.0, 2.0))], x_label=HOSTILE, y_label=HOSTILE)
    svg = drawn("line_chart", chart)
    assert svg.documentElement.getAttribute("aria-label") == f"{HOSTILE} over {HOSTILE}"
    assert [each.firstChild.data for each in svg.getElementsByTagName("text")].count(HOSTILE) == 1
    titles = [each.firstChild.data for each in svg.getElementsByTagName("title")]
    assert all(title.startswith(HOSTILE) for title in titles)
    assert not svg.getElementsByTagName("script")


@pytest.mark.parametrize(("low", "high"), [(0, 1), (15, 36), (0.9, 0.91), (-3, 1e4), (1e-9, 2e-9)])
def test_ticks_are_few_and_inside(low, high):
    ticks = charts._ticks(low, high)
    assert 2 <= len(ticks) <= charts.TICKS + 1
    assert all(low - 1e-12 <= each <= high + 1e-12 for each in ticks)


def test_histogram_is_valid_svg_and_its_bars_are_the_shares():
    chart = histogram({"a": np.array([1.0, 3.0]), "b": np.array([0.0, 0.0])}, 2, {0: "<0>", 2: "2"})
    svg = drawn("histogram", chart, "title")
    heights = [float(bar.getAttribute("height")) for bar in svg.getElementsByTagName("rect")]
    assert heights == pytest.approx([100 / 3, 100], abs=0.1)
    texts = [each.firstChild.data for each in svg.getElementsByTagName("text")]
    assert texts == ["<0>", "2", "tallest bar: 75\u00a0%"]
    assert [label for _, label in chart.key] == ["a", "b"]
    assert histogram({"a": np.ones(2)}, 2, {}).key == ()
    assert histogram({"a": np.zeros(2)}, 2, {}).bars == ()


def test_percentages():
    found = [percent(share) for share in (0, 0.0004, 0.004, 0.05, 0.0996, 0.5, 1)]
    assert found == [f"{each}\u00a0%" for each in ("0", "< 0.1", "0.4", "5.0", "10", "50", "100")]


def test_a_method_keeps_its_colour_and_the_ninth_is_dashed():
    assert colours_of(["a", "b", "a"]) == {"a": 0, "b": 1}
    assert [series_class(each) for each in (0, 7, 8)] == ["s0", "s7", "s0 dashed"]
