"""The demo's page: names are text, and in a real browser it fits, fetches nothing and its slider moves."""

import io

import numpy as np
import pytest
from PIL import Image
from unghost_tests.pages import HOSTILE, read_page

from unghost.demo.page import page_text

SCORES = dict.fromkeys(("floater_recall", "floater_precision", "surface_kept", "iou_before", "iou", "seconds"), 0.5)


def png():
    stream = io.BytesIO()
    Image.fromarray(np.zeros((30, 40, 3), dtype=np.uint8)).save(stream, format="PNG")
    return stream.getvalue()


@pytest.fixture(scope="module")
def page():
    results = {
        "rows": [{"method": HOSTILE, **SCORES, "recall_by_kind": {HOSTILE: None}}],
        "command": HOSTILE,
        "commit": HOSTILE,
        "machine": {"cores": HOSTILE, "architecture": HOSTILE},
        "versions": {HOSTILE: HOSTILE},
    }
    return page_text(results, dict.fromkeys(("before", f"after_{HOSTILE}", "removed", "sections"), png()))


def test_names_on_the_page_are_only_text(page):
    reader = read_page(page)
    assert reader.count("script") == 1  # the slider's
    assert reader.count("img") == 5
    assert sum(HOSTILE in text for text in reader.text) == 7  # cores, caption, row, kind, row, command, commit
    assert f"The room after {HOSTILE}" in [attributes.get("alt") for _, attributes in reader.tags]


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize(("width", "dark"), [(1400, False), (400, False), (400, True)])
def test_it_works_in_a_browser(browser, page, width, dark, tmp_path):
    path = tmp_path / "index.html"
    path.write_text(page, encoding="utf-8")
    browser.open(path, width=width, dark=dark)
    assert browser.complaints == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:"))] == []
    assert browser.look("document.documentElement.scrollWidth") <= width
    assert browser.look("[...document.images].every(image => image.complete && image.naturalWidth === 40)")
    browser.drag(".slider input", to=0.8)
    clip = browser.look("getComputedStyle(document.querySelector('.slider .top')).clipPath")
    assert float(clip.split()[1].rstrip("%")) == pytest.approx(20, abs=2.5)
    browser.screenshot(tmp_path / "page.png")
    assert (np.median(np.asarray(Image.open(tmp_path / "page.png").convert("L"))[:100]) < 60) == dark
