"""The page of ``unghost evaluate`` in a real browser: everything arrives, the slider moves, nothing is fetched."""

import json

import numpy as np
import pytest
from PIL import Image

from unghost import cli

pytestmark = pytest.mark.browser
VIEWS, HEIGHT, WIDTH = 5, 120, 160
CLIP = "getComputedStyle(document.querySelector('.slider .top')).clipPath"
HOSTILE = "<script>document.title='x'</script>&\"'"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Photos, a hazy method and a clear one that says how sure it is, through the command line."""
    folder = tmp_path_factory.mktemp("report")
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    for index in range(VIEWS):
        photo = np.stack([np.sin(row / 9 + index), np.cos(column / 7), np.sin((row + column) / 11)], -1) / 2 + 0.5
        haze = np.exp(-((row - 60) ** 2 + (column - 40 - 20 * index) ** 2) / 900)[..., None] * 0.2 * (index + 1)
        hazy = photo * (1 - haze) + haze * 0.8
        clear = np.clip(photo + rng.normal(scale=0.02, size=photo.shape), 0, 1)
        for name, picture in (("photos", photo), ("hazy", hazy), ("clear", clear)):
            (folder / name).mkdir(exist_ok=True)
            Image.fromarray(np.round(picture * 255).astype(np.uint8)).save(folder / name / f"v{index}.png")
        (folder / "clear" / "uncertainty").mkdir(exist_ok=True)
        np.save(folder / "clear" / "uncertainty" / f"v{index}.npy", rng.random((HEIGHT, WIDTH)))
    words = ["evaluate", f"clear={folder / 'clear'}", f"{HOSTILE}={folder / 'hazy'}", "--against", str(folder / "hazy")]
    words += ["--gt", str(folder / "photos"), "--out", str(folder / "out"), "--pairs", "3", "--resamples", "50"]
    assert cli.main(words) == 0
    return folder / "out" / "report.html"


@pytest.mark.slow
def test_everything_arrives_and_nothing_is_fetched(browser, report):
    browser.open(report)
    assert browser.complaints == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:"))] == []
    found = browser.look(
        "({title: document.title, images: [...document.images].map(i => i.complete && i.naturalWidth),"
        " rows: document.querySelector('table tbody').rows.length, views: document.querySelectorAll('.view').length,"
        " charts: [...document.querySelectorAll('svg.chart')].map(c => c.getBoundingClientRect().width)})"
    )
    assert "hazy" in found["title"]
    assert HOSTILE in found["title"]  # as text
    assert len(found["images"]) == 3 * (2 + 1 + 3 * 2)
    assert set(found["images"]) == {WIDTH}
    assert (found["rows"], found["views"]) == (3, 3)
    assert len(found["charts"]) == 2
    assert min(found["charts"]) > 300


@pytest.mark.slow
def test_the_slider_follows_the_pointer_and_the_arrow_keys(browser, report):
    browser.open(report)
    assert browser.look(CLIP) == "inset(0px 50% 0px 0px)"
    browser.drag(".slider input", to=0.8)
    shown = float(browser.look(CLIP).split()[1].rstrip("%"))
    assert shown == pytest.approx(20, abs=2.5)
    browser.press("ArrowLeft", 37)
    assert float(browser.look(CLIP).split()[1].rstrip("%")) == pytest.approx(shown + 1)
    others = browser.look(
        "[...document.querySelectorAll('.slider')].slice(1).map(s => s.style.getPropertyValue('--at'))"
    )
    assert others == ["", ""]  # one view's slider moves that view alone


def test_either_side_can_show_any_picture(browser, report):
    browser.open(report)
    state = (
        "(v => ({left: v.querySelector('em.left').textContent, photo: v.querySelector('.top img').src ==="
        " v.querySelector('figure[data-label=photo] img').src}))(document.querySelector('.view'))"
    )
    assert browser.look(state) == {"left": "hazy", "photo": False}
    browser.look(
        "(s => {s.value = 'photo'; s.dispatchEvent(new Event('change'))})(document.querySelector('.choose select'))"
    )
    assert browser.look(state) == {"left": "photo", "photo": True}


@pytest.mark.slow
@pytest.mark.parametrize(("width", "dark"), [(1400, False), (400, False), (400, True)])
def test_it_fits_the_screen(browser, report, width, dark, tmp_path):
    browser.open(report, width=width, dark=dark)
    assert browser.look("document.documentElement.scrollWidth") <= width
    browser.screenshot(tmp_path / "page.png")
    picture = np.asarray(Image.open(tmp_path / "page.png").convert("L"))
    assert width - 20 <= picture.shape[1] <= width  # a scroll bar
    assert (np.median(picture) < 60) == dark
    small = browser.look(
        "Math.min(...[...document.querySelectorAll('svg.chart text')].map(t => t.getBoundingClientRect().height))"
    )
    assert small > 9
    first = browser.look(
        "[...document.querySelectorAll('tbody th')].filter(c => c.offsetWidth)"
        ".map(c => [c.offsetWidth, c.offsetHeight])"
    )
    assert max(each[0] for each in first) < 0.5 * width  # a long name leaves room for its numbers
    assert max(each[1] for each in first) < 170  # and is no column of single letters


def test_without_scripts_all_of_it_can_be_read(browser, report):
    browser.open(report, scripts=False)
    words = browser.ask("Runtime.evaluate", expression="document.body.innerText", returnByValue=True)["result"]["value"]
    assert "PSNR" in words
    assert "worst first" in words
    found = browser.ask("Page.captureScreenshot")
    assert len(found["data"]) > 10_000


def test_the_page_of_a_results_file(browser, report):
    assert (
        cli.main(["report", str(report.with_name("results.json")), "--out", str(report.with_name("again.html"))]) == 0
    )
    browser.open(report.with_name("again.html"))
    assert browser.complaints == []
    assert browser.look("document.querySelectorAll('svg.chart').length") == 2
    assert browser.look("document.images.length") == 0
    json.loads(report.with_name("results.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
