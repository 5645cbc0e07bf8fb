"""Splats through ``clean``: scores by hand, bytes untouched, a scene whose floaters are labelled."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from unghost import cli
from unghost.cleaning.keep_mask import KeepMask
from unghost.cleaning.splats import box_of, clean_ply, clean_splats, keep_scores, pitch_of
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
    assert cleaned.dtype.names == (*names, "keep_score")
    place = {row.tobytes(): index for index, row in enumerate(rows)}
    kept = np.array([place[row.tobytes()] for row in cleaned[list(names)].astype(rows.dtype)])
    assert (np.diff(kept) > 0).all()  # in their order, every byte as it was
    assert (np.asarray(cleaned["keep_score"]) >= 0.5).all()
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
    for option in (["--resolution", "64"], ["--reach", "3"]):
        assert cli.main(["clean", str(tmp_path / "g.npz"), *option]) == 2
        assert "are for splats" in capsys.readouterr().err


def test_folders_are_made(scene, tmp_path):
    found = clean_ply(scene, tmp_path / "new" / "clean.ply", denoiser=Constant(1.0), resolution=16)
    assert len(read_splat_ply(tmp_path / "new" / "clean.ply")) == found.keep.sum()


def test_never_onto_itself_and_nothing_half_written(scene, tmp_path, capsys):
    with pytest.raises(ValueError, match="is the file to clean; write to another"):
        clean_ply(scene, scene)
    nan = np.float32(np.nan).tobytes()
    whole, bad = scene.read_bytes(), tmp_path / "bad.ply"
    for content, message in (
        (whole[:-7], "bad.ply"),
        (whole[:-8] + nan + whole[-4:], "finite"),
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


def test_half_a_million_are_cleaned_within_two_minutes():
    """The committed result, made by benchmarks/cleaning/splats.py."""
    found = json.loads((ROOT / "docs" / "results" / "splats.json").read_text(encoding="utf-8"))
    rows = [row for row in found["rows"] if row["method"] == "unghost"]
    assert len({row["method"] for row in found["rows"]}) == 5
    assert len(rows) >= 3
    assert all(row["splats"] == 500_000 and row["seconds"] < 120 for row in rows)
    assert all(row["floater_recall"] > 0.95 and row["surface_kept"] > 0.98 for row in rows)
