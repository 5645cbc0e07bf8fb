"""Splats through ``clean``: scores by hand, bytes untouched, a scene whose floaters are labelled."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from unghost import cli
from unghost.cleaning.keep_mask import KeepMask
from unghost.cleaning.pipeline import CleanSettings
from unghost.cleaning.splats import box_of, clean_ply, clean_splats, judged_box, keep_scores, pitch_of, warn_if_small
from unghost.core.manifest import Manifest
from unghost.splats.ply import Gaussians, read_splat_ply

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The example's own scene: a vase on a pedestal, 5 % floaters, labelled."""
    spec = importlib.util.spec_from_file_location("splats_example", ROOT / "examples" / "splats.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    path = tmp_path_factory.mktemp("splats") / "scene.ply"
    example.make(path)
    return path


class Constant:
    """A denoiser with one opinion."""

    kind = "numpy"

    def __init__(self, value):
        self.value, self.manifest = value, Manifest("constant")

    def __call__(self, channels, timestep, edge_fraction):
        return np.full_like(channels[:, :1], self.value)


def test_scores_by_hand():
    """Cells left of x = 0 are kept: a Gaussian whose long axis crosses the border loses one point of seven, or two."""
    cells = np.zeros((8, 8, 8), dtype=bool)
    cells[:4] = True
    mask = KeepMask(np.array([[-1.0, -1, -1], [1, 1, 1]]), 0.25, cells)
    turn = np.sqrt(0.5)
    gaussians = Gaussians.create(
        [[-0.5, 0.1, 0.1], [-0.1, 0.1, 0.1], [0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [5.0, 0, 0]],
        [[0.05, 0.05, 0.05], [0.2, 0.01, 0.01], [0.2, 0.01, 0.01], [0.2, 0.01, 0.01], [0.1, 0.1, 0.1]],
        [[1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [turn, 0, 0, turn], [1, 0, 0, 0]],  # the fourth lies along y
        np.zeros(5),
    )
    np.testing.assert_allclose(keep_scores(gaussians, mask), [1, 6 / 7, 1 / 7, 1, 1], atol=1e-6)


def test_the_box_holds_what_hovers_about_the_scene_and_not_the_horizon():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.uniform(-1, 1, (2000, 3)), [[1.6, 0, 0], [300.0, 0, 0]]])
    gaussians = Gaussians.create(means, np.full((2002, 3), 0.01), np.tile([1.0, 0, 0, 0], (2002, 1)), np.zeros(2002))
    box = box_of(gaussians)
    assert 1.6 < box[1, 0] < 2.5
    assert box[0, 0] == pytest.approx(-1.01, abs=0.02)  # nothing is there to be cleaned
    assert pitch_of(gaussians, box, None) == pytest.approx(0.02)
    assert pitch_of(gaussians, box, 10) == pytest.approx((box[1] - box[0]).max() / 10)


@pytest.mark.slow
def test_one_opinion_keeps_or_removes_what_is_in_the_box(scene):
    gaussians = read_splat_ply(scene).gaussians()
    kept = clean_splats(gaussians, denoiser=Constant(1.0), resolution=32)
    assert kept.keep.all()
    assert (kept.keep_score == 1).all()
    gone = clean_splats(gaussians, denoiser=Constant(-1.0), resolution=32)
    assert gone.keep.mean() < 0.02
    with pytest.raises(ValueError, match="resolution must be >= 8, got 4"):
        clean_splats(gaussians, denoiser=Constant(1.0), resolution=4)


@pytest.mark.slow
def test_the_command_removes_floaters_and_touches_nothing_else(scene, tmp_path, capsys):
    before, target = scene.read_bytes(), tmp_path / "clean.ply"
    words = ["clean", str(scene), "-o", str(target), "--keep", str(tmp_path / "k.npz")]
    assert cli.main(words) == 0, capsys.readouterr().err
    assert "of 18900 Gaussians (4.8%) are ghosts" in capsys.readouterr().out
    assert scene.read_bytes() == before
    rows, cleaned = read_splat_ply(scene).rows, read_splat_ply(target).rows
    names = rows.dtype.names
    assert cleaned.dtype.names == names  # strict readers want the standard properties alone
    place = {row.tobytes(): index for index, row in enumerate(rows)}
    kept = np.array([place[row.tobytes()] for row in cleaned[list(names)].astype(rows.dtype)])
    assert (np.diff(kept) > 0).all()  # in their order, every byte as it was
    ghost = np.asarray(rows["made_as"]) == 1
    stays = np.zeros(len(rows), bool)
    stays[kept] = True
    assert (~stays)[ghost].mean() > 0.8
    assert stays[~ghost].mean() > 0.95
    KeepMask.load(tmp_path / "k.npz")


@pytest.mark.slow
def test_a_preview_shows_and_changes_nothing(scene, tmp_path, capsys):
    from matplotlib.image import imread

    before = scene.read_bytes()
    assert cli.main(["clean", str(scene), "--preview", str(tmp_path / "look.png")]) == 0, capsys.readouterr().err
    printed = capsys.readouterr().out
    assert "regions would go" in printed
    assert "nothing was changed" in printed
    assert scene.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["look.png"]
    picture = imread(tmp_path / "look.png")[..., :3]
    orange = (picture[..., 0] > picture[..., 2] + 0.3).mean()
    grey = ((np.ptp(picture, axis=-1) < 0.02) & (picture[..., 0] < 0.95)).mean()
    assert 0.001 < orange < 0.3
    assert grey > 0.1


def test_no_file_is_written_over_another(scene, tmp_path, capsys):
    from unghost.fields.adapters.grids import save_grid

    save_grid(tmp_path / "g.npz", np.ones((4, 4, 4), np.float32), np.array([[0.0, 0, 0], [1, 1, 1]]))
    (tmp_path / "s.ply").write_bytes(scene.read_bytes())
    (tmp_path / "link.npz").symlink_to(tmp_path / "g.npz")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for words in (
        ["g.npz", "-o", "g.npz"],
        ["g.npz", "--keep", "g.npz"],
        ["s.ply", "--keep", "s.ply"],
        ["s.ply", "-o", "s.ply"],
        ["g.npz", "-o", "g-keep.npz"],
        ["g.npz", "--preview", "g.npz"],
        ["g.npz", "-o", "link.npz"],
    ):
        assert cli.main(["clean", *(str(tmp_path / w) if not w.startswith("-") else w for w in words)]) == 2, words
        assert "are the same file" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    for option in (["--resolution", "64"], ["--reach", "3"], ["--box", *"012345"], ["--scores-only"], ["--keep-score"]):
        assert cli.main(["clean", str(tmp_path / "g.npz"), *option]) == 2
        assert "are for splats" in capsys.readouterr().err


def test_folders_are_made(scene, tmp_path):
    found = clean_ply(scene, tmp_path / "new" / "clean.ply", denoiser=Constant(1.0), resolution=16)
    assert len(read_splat_ply(tmp_path / "new" / "clean.ply")) == found.keep.sum()


def test_never_onto_itself_and_nothing_half_written(scene, tmp_path, capsys):
    with pytest.raises(ValueError, match="is the file to clean; write to another"):
        clean_ply(scene, scene)
    whole, bad = scene.read_bytes(), tmp_path / "bad.ply"
    for content, message in (
        (whole[:-7], "bad.ply"),
        (whole + b"\0", "bytes longer than"),
        (whole.replace(b"property float opacity", b"property float opaquely"), "opacity"),
        (b"\x89PNG\r\n\x1a\n" + whole, "bad.ply"),
        (b"", "bad.ply"),
    ):
        bad.write_bytes(content)
        assert cli.main(["clean", str(bad)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("unghost clean: ")
        assert message in error
        assert [path.name for path in tmp_path.iterdir()] == ["bad.ply"]


@pytest.mark.slow
def test_scores_alone(scene, tmp_path):
    assert (
        cli.main(
            ["clean", str(scene), "-o", str(tmp_path / "all.ply"), "--scores-only", "--keep", str(tmp_path / "k.npz")]
        )
        == 0
    )
    before, after = read_splat_ply(scene).rows, read_splat_ply(tmp_path / "all.ply").rows
    assert (after[list(before.dtype.names)].astype(before.dtype) == before).all()
    ghost, score = np.asarray(before["made_as"]) == 1, np.asarray(after["keep_score"])
    assert (score[ghost] < 0.5).mean() > 0.8
    assert (score[~ghost] >= 0.5).mean() > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--keep-score"], ["--scores-only"]])
def test_a_score_is_written_on_request_alone(scene, tmp_path, words):
    target, again = tmp_path / "a.ply", tmp_path / "b.ply"
    source = scene if words == ["--scores-only"] else few(scene, tmp_path)
    common = ["--denoiser", "xs", "--resolution", "16", "--keep", str(tmp_path / "k.npz")]
    assert cli.main(["clean", str(source), "-o", str(target), *words, *common]) == 0
    names = read_splat_ply(source).rows.dtype.names
    assert read_splat_ply(target).rows.dtype.names == (*names, "keep_score")
    clean_ply(target, again, denoiser=Constant(1.0), resolution=16)
    assert read_splat_ply(again).rows.dtype.names == (*names, "keep_score")
    assert (read_splat_ply(again).rows["keep_score"] == 1).all()  # one that is there is renewed, never stale


def few(scene, folder, step=4, name="few.ply", **changes):
    """Every fourth splat, with ``property=(rows, value)`` set."""
    head, body = scene.read_bytes().split(b"end_header\n", 1)
    rows = np.frombuffer(body, read_splat_ply(scene).rows.dtype)[::step].copy()
    for key, (which, value) in changes.items():
        rows[key][which] = value
    count = str(len(read_splat_ply(scene).rows)).encode()
    head = head.replace(b"vertex " + count, b"vertex " + str(len(rows)).encode())
    path = folder / name
    path.write_bytes(head + b"end_header\n" + rows.tobytes())
    return path


@pytest.mark.slow
def test_opaque_and_flat_splats_are_judged(scene, tmp_path):
    """Infinite logits, and extents of 0, as converters write them; the finite twin is judged the same."""
    opaque = {"opacity": (slice(0, 1500), np.inf)}
    found = clean_ply(few(scene, tmp_path, **opaque), tmp_path / "a.ply", denoiser=Constant(-1.0), resolution=32)
    twin = {"opacity": (slice(0, 1500), 30.0)}
    other = clean_ply(few(scene, tmp_path, **twin), None, denoiser=Constant(-1.0), resolution=32)
    assert found.valid.all()
    assert np.isfinite(found.keep_score).all()
    np.testing.assert_array_equal(found.keep_score, other.keep_score)
    assert found.mask.summary()["occupied"] > 500
    flat = {"scale_2": (slice(None), -np.inf), "opacity": (slice(0, 99), -np.inf)}
    thin = {"scale_2": (slice(None), -30.0), "opacity": (slice(0, 99), -np.float32(80))}
    scores = [
        clean_ply(few(scene, tmp_path, **change), None, denoiser=Constant(-1.0), resolution=32).keep_score
        for change in (flat, thin)
    ]
    np.testing.assert_array_equal(*scores)
    assert (scores[0] < 0.5).mean() > 0.5


@pytest.mark.slow
def test_splats_that_cannot_be_judged_stay_or_go_and_are_counted(scene, tmp_path, capsys):
    bad = {"x": (3, np.nan), "scale_1": ([5, 6], np.inf), "opacity": (9, np.nan)}
    bad |= {f"rot_{i}": (11, 0.0) for i in range(4)}
    source, broken = few(scene, tmp_path, **bad), [3, 5, 6, 9, 11]
    rows = read_splat_ply(source).rows
    options = ["--denoiser", "xs", "--resolution", "16", "--keep", str(tmp_path / "k.npz")]
    for words, stay in (([], True), (["--drop-invalid"], False)):
        assert cli.main(["clean", str(source), "-o", str(tmp_path / "a.ply"), *options, *words]) == 0
        printed = capsys.readouterr().out
        assert "5 cannot be judged" in printed
        assert ("--drop-invalid removes them" in printed) == stay
        assert KeepMask.load(tmp_path / "k.npz").summary()["invalid_splats"] == 5
        written = {row.tobytes() for row in read_splat_ply(tmp_path / "a.ply").rows}
        assert [rows[index].tobytes() in written for index in broken] == [stay] * 5
        first = (tmp_path / "a.ply").read_bytes()
        mask = ["--mask", str(tmp_path / "k.npz")]
        assert cli.main(["clean", str(source), "-o", str(tmp_path / "again.ply"), *mask]) == 0
        assert (tmp_path / "again.ply").read_bytes() == first
        capsys.readouterr()
    gaussians = read_splat_ply(source).gaussians()
    found = clean_splats(gaussians, denoiser=Constant(-1.0), resolution=16)
    assert np.flatnonzero(~found.valid).tolist() == broken
    assert found.keep_score[broken].tolist() == [1.0] * 5
    dropped = clean_splats(gaussians, denoiser=Constant(-1.0), resolution=16, settings=CleanSettings(drop_invalid=True))
    assert not dropped.keep[broken].any()
    others = np.delete(np.arange(len(gaussians)), broken)
    np.testing.assert_array_equal(dropped.keep_score[others], found.keep_score[others])
    good = clean_splats(gaussians.only(gaussians.valid), denoiser=Constant(-1.0), resolution=16)
    np.testing.assert_array_equal(good.keep_score, found.keep_score[others])


def test_splats_are_splats_whatever_their_name(scene, tmp_path, capsys):
    mask = clean_ply(scene, None, denoiser=Constant(1.0), resolution=8).mask
    mask.save(tmp_path / "k.npz")
    for name, out in (("s.PLY", "s-clean.PLY"), ("t.npz", "t-clean.ply"), ("u", "u-clean.ply")):
        (tmp_path / name).write_bytes(scene.read_bytes())
        assert cli.main(["clean", str(tmp_path / name), "--mask", str(tmp_path / "k.npz")]) == 0
        assert (tmp_path / out).read_bytes() == scene.read_bytes()
    for wrong in ("a.splat", "a.SOG", "a.npz"):
        assert cli.main(["clean", str(tmp_path / "u"), "-o", str(tmp_path / wrong)]) == 2
        assert f"splats are written as .ply, got --out {wrong}" in capsys.readouterr().err
    assert cli.main(["clean", str(tmp_path / "u"), "--reach", "1", "--box", *"000111"]) == 2
    assert "--box is judged in place of --reach" in capsys.readouterr().err
    assert cli.main(["clean", str(tmp_path / "u"), "--mask", str(tmp_path / "k.npz"), "--box", *"000111"]) == 2
    assert "leave out box" in capsys.readouterr().err


def test_not_one_that_can_be_judged(scene, tmp_path, capsys):
    assert cli.main(["clean", str(few(scene, tmp_path, x=(slice(None), np.nan)))]) == 2
    assert "not one of 4725 Gaussians is finite" in capsys.readouterr().err


def lawn(seed=0):
    """A ball of radius 0.5 with a blob beside it, in the middle of a lawn of radius 40; which is which."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(6000, 3))
    ball = 0.5 * out / np.linalg.norm(out, axis=1, keepdims=True)
    blob = rng.normal([0.9, 0.0, 0.3], 0.03, (150, 3))
    radius, angle = np.exp(rng.uniform(np.log(0.5), np.log(40), 6000)), rng.uniform(0, 2 * np.pi, 6000)
    grass = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(6000, -0.6)], axis=1)
    side = np.concatenate([np.full(6150, 0.015), 0.02 * np.maximum(radius, 0.7)])
    means, kind = np.concatenate([ball, blob, grass]), np.repeat([0, 1, 2], [6000, 150, 6000])
    extents = side[:, None] * np.where(kind[:, None] == 2, [1, 1, 0.05], 1.0)
    turns = np.tile([1.0, 0, 0, 0], (len(means), 1))
    return Gaussians.create(means, extents, turns, np.full(len(means), 3.0)), kind


@pytest.mark.slow
def test_an_object_that_is_small_beside_its_surroundings_is_pointed_out():
    from unghost import load_denoiser

    gaussians, kind = lawn()
    denoiser = load_denoiser("xs", backend="onnx")
    with pytest.warns(
        UserWarning, match=r"spans \d+ cells of side .*fewer than 20.*--box\), say (\S+ ){5}\S+$"
    ) as caught:
        clean_splats(gaussians, denoiser=Constant(1.0))
    box = np.array([float(word) for word in str(caught[0].message).split("say ")[1].split()]).reshape(2, 3)
    assert (box[0] < -0.5).all()
    assert (box[1] > 0.5).all()
    assert np.abs(box).max() < 8
    alone = clean_splats(gaussians, denoiser=denoiser, box=[[-1.5, -1.5, -1.0], [1.5, 1.5, 1.0]])
    assert alone.keep[kind == 0].mean() > 0.99
    assert not alone.keep[kind == 1].any()
    assert alone.keep[kind == 2].mean() > 0.99


def test_what_fills_its_box_or_was_asked_for_coarsely_is_not_pointed_out():
    ball = np.random.default_rng(0).normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    gaussians = Gaussians.create(ball, np.full((3000, 3), 0.03), np.tile([1.0, 0, 0, 0], (3000, 1)), np.zeros(3000))
    box = box_of(gaussians)
    for resolution in (None, 8, 16, 64):
        warn_if_small(gaussians, box, pitch_of(gaussians, box, resolution))
    transparent = Gaussians(gaussians.means, gaussians.extents, gaussians.rotations, np.full(3000, -np.inf))
    warn_if_small(transparent, box, 0.1)


def test_only_what_is_in_the_box_is_judged(scene):
    gaussians = read_splat_ply(scene).gaussians()
    box = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 9.0]])
    inside = ((gaussians.means >= box[0]) & (gaussians.means <= box[1])).all(axis=1)
    found = clean_splats(gaussians, denoiser=Constant(-1.0), box=box, resolution=32)
    assert found.keep[~inside].all()
    assert (~found.keep[inside]).mean() > 0.95
    aabb, held = judged_box(gaussians, box)
    assert len(held) == inside.sum()
    assert aabb[1, 2] < 1  # nothing is above
    assert (aabb >= box[0]).all()
    with pytest.raises(ValueError, match=r"box must hold Gaussians, got \[\[50.*; all lie in \[\["):
        clean_splats(gaussians, denoiser=Constant(-1.0), box=[[50, 50, 50], [60, 60, 60]])
    with pytest.raises(ValueError, match=r"clean_splats: box: aabb must have min < max"):
        clean_splats(gaussians, denoiser=Constant(-1.0), box=box[::-1])
    with pytest.raises(ValueError, match="leave out box"):
        clean_splats(gaussians, denoiser=Constant(-1.0), box=box, mask=found.mask)


def test_half_a_million_are_cleaned_within_two_minutes():
    """The committed result, made by benchmarks/cleaning/splats.py."""
    found = json.loads((ROOT / "docs" / "results" / "splats.json").read_text(encoding="utf-8"))
    rows = [row for row in found["rows"] if row["method"] == "unghost"]
    assert len({row["method"] for row in found["rows"]}) == 5
    assert len(rows) >= 3
    assert all(row["splats"] == 500_000 and row["seconds"] < 120 for row in rows)
    assert all(row["floater_recall"] > 0.95 and row["surface_kept"] > 0.98 for row in rows)
