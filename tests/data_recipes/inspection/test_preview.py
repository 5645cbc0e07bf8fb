import pathlib
import re

import numpy as np
import pytest
from unghost_tests.pages import HOSTILE, read_page

from unghost import cli
from unghost.core.shards.packing import pack_labels, quantize_signed
from unghost.core.shards.storage import Shard, read_shard, write_shard
from unghost.data_recipes.curation import curate
from unghost.data_recipes.inspection.drawing import MISSING, SURFACE
from unghost.data_recipes.inspection.preview import draw_pair, sources_of, write_preview
from unghost.data_recipes.recipe import Recipe


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pairs") / "few"
    curate(Recipe(empty_share=0.3), folder, count=9, seed=1)
    return folder


def shard_of(folder, signed, labels, provenance):
    count = len(signed)
    numbers = np.linspace(0.1, 0.9, count, dtype=np.float32)
    packed = pack_labels(labels) if count else np.zeros((0, 8192), dtype=np.uint8)
    write_shard(
        folder,
        {
            "inputs": quantize_signed(signed),
            "labels": packed,
            "severity": numbers,
            "edge_fraction": numbers,
            "group": np.zeros(count, dtype=np.int32),
        },
        provenance,
    )
    return read_shard(folder)


def slabs(count):
    signed = np.full((count, 32, 32, 32), -1.0)
    signed[:, 8:12] = 1.0
    return signed, (signed > 0).astype(np.uint8)


@pytest.mark.slow
def test_the_page_holds_everything_and_asks_no_network(pairs, tmp_path):
    path, facts = write_preview(pairs, out=tmp_path / "deep" / "page.html", cubes=4)
    text = path.read_text(encoding="utf-8")
    page = read_page(text)
    assert path == tmp_path / "deep" / "page.html"
    assert not list(path.parent.glob("*.partial"))
    assert page.count("img") == 2 * 4
    assert page.count("script") == 0
    assert [attributes["href"] for tag, attributes in page.tags if tag == "link"] == ["data:,"]  # no icon is fetched
    assert all(attributes["src"].startswith("data:image/png;base64,") for tag, attributes in page.tags if tag == "img")
    assert not re.search(r"https?:|//[a-z]|@import|url\(", re.sub(r"base64,[\w+/=]+", "", text))
    assert facts["total"] == facts["cubes"] == 9
    assert facts["shards"] == 1
    said = page.words
    for words in (
        "9 pairs of cubes",
        "empty inputs",
        "empty truths",
        "Edge fraction",
        "Occupied share",
        "procedural",
        "generated",
        "Sources and licences",
        "ghost share",
    ):
        assert words in said, words
    assert page.count("svg") == 6


@pytest.mark.slow
def test_the_same_folder_gives_the_same_page(pairs, tmp_path):
    first, _ = write_preview(pairs, out=tmp_path / "a.html", cubes=2, seed=5)
    second, _ = write_preview(pairs, out=tmp_path / "b.html", cubes=2, seed=5)
    assert first.read_bytes() == second.read_bytes()
    third, _ = write_preview(pairs, out=tmp_path / "c.html", cubes=2, seed=6)
    assert first.read_bytes() != third.read_bytes()


def test_share_of_empty_cubes(tmp_path):
    signed, labels = slabs(4)
    signed[0], labels[0], labels[1] = -1.0, 0, 0
    shard_of(tmp_path / "s", signed, labels, {"recipe": "by hand", "licence": "CC0-1.0"})
    path, facts = write_preview(tmp_path / "s", cubes=0)
    said = re.sub(r"<[^>]+>", " ", path.read_text(encoding="utf-8"))
    assert path == tmp_path / "s-preview.html"
    assert facts["empty_share"] == 0.25
    assert re.search(r"25\s%\s+empty inputs", said)
    assert re.search(r"50\s%\s+empty truths", said)
    assert "CC0-1.0" in said


@pytest.mark.slow
def test_what_a_shard_says_of_itself_is_only_text(tmp_path):
    signed, labels = slabs(1)
    evil = "<script>alert(1)</script>"
    folder = tmp_path / "a<b>&c"
    shard_of(folder, signed, labels, {"recipe": evil, "licence": f'"{evil}'})
    page = read_page(write_preview(folder, cubes=1)[0].read_text(encoding="utf-8"))
    assert page.count("script") == 0
    assert "".join(page.text).count(evil) == 2
    assert "a<b>&c" in "".join(page.text)


def test_names_of_recipes_meshes_and_folders_are_only_text(tmp_path):
    signed, labels = slabs(1)
    mesh = {"path": HOSTILE, "reason": HOSTILE}
    provenance = {"recipe": {"name": HOSTILE, "licence": HOSTILE}, "licence": HOSTILE, "rejected": [mesh]}
    name = HOSTILE.replace("/", "")  # no folder's name holds one
    shard_of(tmp_path / "set" / name, signed, labels, provenance)
    shard_of(tmp_path / name, signed, labels, {})
    path, _ = write_preview(tmp_path / "set", cubes=1, against=tmp_path / name, out=tmp_path / "p.html")
    page = read_page(path.read_text(encoding="utf-8"))
    assert page.count("script") == 0
    assert page.count("img") == 2
    assert page.text.count(HOSTILE) == 4  # source, licence, mesh, reason
    assert f"Compared with {name}" in page.text
    assert any(text.startswith(f"{name}, row 0") for text in page.text)


def test_meshes_that_were_passed_over_are_named(tmp_path):
    signed, labels = slabs(1)
    notes = [{"path": f"kit/{row:02}.glb", "reason": "rejected: <no GLB>", "row": row} for row in range(23)]
    for name in ("a", "b"):
        shard_of(tmp_path / "s" / name, signed, labels, {"rejected": notes})
    page = read_page(write_preview(tmp_path / "s", cubes=0)[0].read_text(encoding="utf-8"))
    said = "".join(page.text)
    assert said.count("rejected: <no GLB>") == 20
    assert "kit/19.glb" in said
    assert "kit/20.glb" not in said
    assert "And 3 more." in said


def test_a_full_disk_leaves_the_page_that_was_there(pairs, tmp_path, monkeypatch):
    target = tmp_path / "page.html"
    target.write_text("before", encoding="utf-8")
    real = pathlib.Path.open

    def full(self, *args, **kwargs):  # fails with ENOSPC on writing, as a full disk does
        if self.suffix == ".partial":
            self.touch()
            return real(pathlib.Path("/dev/full"), *args, **kwargs)
        return real(self, *args, **kwargs)

    monkeypatch.setattr(pathlib.Path, "open", full)
    with pytest.raises(OSError, match="No space left on device"):
        write_preview(pairs, out=target, cubes=0)
    monkeypatch.undo()
    assert target.read_text(encoding="utf-8") == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


@pytest.mark.slow
def test_another_set_stands_beside(pairs, tmp_path):
    signed, labels = slabs(3)
    shard_of(tmp_path / "slabs", signed, labels, {})
    path, facts = write_preview(pairs, out=tmp_path / "p.html", cubes=0, against=tmp_path / "slabs")
    found = facts["against"]
    assert 0 < found["distance"] <= 1
    assert found["distance"] == pytest.approx(np.mean(list(found["features"].values())))
    assert f"{found['distance']:.3f}" in path.read_text(encoding="utf-8")
    _, same = write_preview(pairs, out=tmp_path / "p.html", cubes=0, against=pairs)
    assert same["against"]["distance"] == pytest.approx(0, abs=1e-12)


def test_sources_from_each_kind_of_provenance(tmp_path):
    signed, labels = slabs(3)
    stated = shard_of(tmp_path / "a", signed, labels, {"recipe": "harvest", "licence": "generated"})
    assert sources_of(stated) == {("harvest", "generated"): 3}
    recipe = {"name": "mine", "source": "meshes", "licences": ["CC0-1.0", "MIT-0"]}
    assert sources_of(shard_of(tmp_path / "b", signed, labels, {"recipe": recipe})) == {
        ("mine", "any of CC0-1.0, MIT-0"): 3
    }
    assert sources_of(shard_of(tmp_path / "c", signed, labels, {})) == {("unknown", "unknown"): 3}
    entries = [{"path": "kit/a.glb", "licence": "CC0-1.0"}, {"path": "kit/b.glb", "licence": "CC0-1.0"}]
    each = Shard(
        stated.inputs,
        stated.labels,
        stated.severity,
        stated.edge_fraction,
        stated.group,
        {"recipe": recipe, "sources": entries},
        source=np.array([0, 1, -1], dtype=np.int32),
    )
    assert sources_of(each) == {("mine: kit", "CC0-1.0"): 2, ("mine", "generated"): 1}


def test_pictures_of_a_pair_show_what_is_missing():
    signed, labels = slabs(1)
    whole = draw_pair(signed[0], labels[0], width=48)
    lacking = draw_pair(np.full((32, 32, 32), -1.0), labels[0], width=48)

    def near(image, color):
        hue = np.array(color) / max(color)
        tone = image / np.maximum(image.max(axis=-1, keepdims=True), 1)
        return (np.abs(tone - hue).max(axis=-1) < 0.05).sum()

    assert near(whole[1], SURFACE) > 150
    assert near(whole[1], MISSING) == 0
    assert near(lacking[1], MISSING) > 150


def test_bad_input_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"find_shards: .*absent is not a shard and holds none"):
        write_preview(tmp_path / "absent")
    signed, labels = slabs(0)
    shard_of(tmp_path / "none", signed, labels, {})
    with pytest.raises(ValueError, match="hold no cube"):
        write_preview(tmp_path / "none")
    with pytest.raises(ValueError, match="cubes must be >= 0 and measured >= 1, got -1 and 200"):
        write_preview(tmp_path / "none", cubes=-1)
    signed, labels = slabs(1)
    shard_of(tmp_path / "cut", signed, labels, {})
    (tmp_path / "cut" / "labels.npy").write_bytes(b"short")
    with pytest.raises(ValueError, match="read_shard: cannot read"):
        write_preview(tmp_path / "cut")
    assert not list(tmp_path.glob("*.html*"))


def test_the_verb_writes_the_page_and_says_where(tmp_path, capsys):
    signed, labels = slabs(2)
    shard_of(tmp_path / "s", signed, labels, {})
    words = ["preview", str(tmp_path / "s"), "--cubes", "1", "--against", str(tmp_path / "s")]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert "2 cubes in 1 shard, IoU of input and truth 1.000; look at " in said
    assert "distance to" in said
    assert (tmp_path / "s-preview.html").is_file()
    assert cli.main(["preview", str(tmp_path / "absent")]) == 2
    assert "unghost preview: find_shards:" in capsys.readouterr().err
