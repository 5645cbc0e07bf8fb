import base64
import re
import sys

import pytest
from unghost_tests.pages import HOSTILE, Reader

from unghost.core.pages import Cell, Table, environment, render
from unghost.core.pages.rendering import TEMPLATES, data_uri

PNG = b"\x89PNG\r\n\x1a\n..."


def macro(name, *arguments):
    return Reader(str(getattr(environment().get_template("macros.html.jinja").module, name)(*arguments)))


def test_templates_never_switch_escaping_off():
    templates = sorted(TEMPLATES.glob("*.jinja"))
    assert len(templates) > 4
    for path in templates:
        assert not re.search(r"\|\s*safe|autoescape", path.read_text(encoding="utf-8")), path
    assert environment().autoescape is True


def test_no_module_makes_markup_of_its_own():
    folders = [path.resolve() for path in TEMPLATES.parents[2].iterdir() if path.is_dir()]
    modules = [path for folder in folders for path in folder.rglob("*.py")]
    assert len(modules) > 200
    for path in modules:
        assert not re.search(r"\bmarkupsafe\b|\bMarkup\(|<table|<!doctype html", path.read_text(encoding="utf-8")), path


def test_pages_extend_the_base():
    pages = {path.name for path in TEMPLATES.glob("*.jinja")} - {"base.html.jinja", "macros.html.jinja"}
    assert pages == {"demo.html.jinja", "preview.html.jinja", "report.html.jinja"}
    for name in pages:
        text = (TEMPLATES / name).read_text(encoding="utf-8")
        assert text.startswith('{% extends "base.html.jinja" %}')
        assert "<style" not in text
        assert "style=" not in text.replace('style="background:{{ rgb }}"', "")


def test_a_value_that_is_not_given_is_an_error():
    from jinja2 import UndefinedError

    with pytest.raises(UndefinedError):
        render("report.html.jinja")


def test_without_jinja2_the_extras_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    environment.cache_clear()
    with pytest.raises(ImportError, match=r"need Jinja2: pip install unghost\[demo\], unghost\[recipes\] or unghost"):
        render("demo.html.jinja")
    monkeypatch.undo()
    assert environment().autoescape


def test_pictures_are_inline():
    assert data_uri(PNG) == "data:image/png;base64," + base64.b64encode(PNG).decode()
    assert data_uri(b"\xff\xd8\xff\xe0").startswith("data:image/jpeg;base64,")
    with pytest.raises(
        ValueError, match=r"data_uri: image must be a PNG or JPEG file, got bytes that start with b'GIF"
    ):
        data_uri(b"GIF89a")


def test_cells_of_a_table_are_text():
    cells = [HOSTILE, Cell(HOSTILE, below=HOSTILE, series=9, style="better"), HOSTILE]
    page = macro("table", Table([HOSTILE, "b", HOSTILE], [cells], text_columns=(2,)))
    assert page.text.count(HOSTILE) == 2 + 4
    tags = [tag for tag, _ in page.tags]
    assert tags.count("th") == 3 + 1  # the first cell of a row is its heading
    assert tags.count("td") == 2
    assert not {"script", "img"} & set(tags)
    classes = [attributes["class"] for _, attributes in page.tags if "class" in attributes]
    assert classes == ["scroll", "left", "swatch s1 dashed", "better", "left"]


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="Table: every row must have 2 cells, got 1"):
        Table(["a", "b"], [["x"]])


def test_labels_of_a_slider_are_text():
    page = macro("slider", PNG, PNG, HOSTILE, HOSTILE, HOSTILE)
    assert page.text.count(HOSTILE) == 2
    assert page.count("script") == 0
    assert [attributes["alt"] for tag, attributes in page.tags if tag == "img"] == [f"{HOSTILE}: {HOSTILE}"] * 2
    (handle,) = (attributes for tag, attributes in page.tags if tag == "input")
    assert handle["aria-label"] == f"{HOSTILE}: {HOSTILE} or {HOSTILE}"
    assert set(handle) == {"type", "min", "max", "value", "aria-label"}


def test_provenance_shows_what_is_there():
    assert "".join(macro("provenance", {}).text).strip() == ""
    page = macro("provenance", {"command": "c", "commit": "d", "machine": {"cores": 2, "architecture": "x"}})
    assert "commit d, 2 cores of x." in page.words
    assert "numpy 2, python 3." in macro("provenance", {"versions": {"numpy": 2, "python": 3}}).words
