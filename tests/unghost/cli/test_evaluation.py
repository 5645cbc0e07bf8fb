"""``unghost evaluate`` from a folder of pictures to a page, and every mistake in one line."""

import csv
import json

import numpy as np
import pytest
from PIL import Image

from unghost import cli
from unghost.evaluation.metrics import pixelwise as metrics

WIDTH, HEIGHT, FOCAL, WALL = 32, 24, 32.0, 4.0
XS = {"t0": 0.0, "e0": 2.0, "e1": 1.0, "e2": 0.5, "t1": -10.0}  # the last sees nothing of what they see
EVAL = ("e0", "e1", "e2")


def save(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(np.clip(pixels, 0, 1) * 255).astype(np.uint8)).save(path)


def photo(index):
    return np.random.default_rng(index).random((HEIGHT, WIDTH, 3)) * 0.8 + 0.1


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    frames = []
    for index, (name, x) in enumerate(XS.items()):
        save(folder / "images" / f"{name}.png", photo(index))
        pose = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": frames}))
    splits = {"train": ["images/t0.png", "images/t1.png"], "eval": [f"images/{name}.png" for name in EVAL]}
    (folder / "splits.json").write_text(json.dumps(splits))
    return folder


@pytest.fixture
def renders(tmp_path):
    """Two methods: ``a`` errs more, and more with every view."""
    rng = np.random.default_rng(9)
    for method, noise in (("a", 0.1), ("b", 0.05)):
        for index, name in enumerate(EVAL):
            error = rng.normal(scale=noise * (index + 1), size=(HEIGHT, WIDTH, 3))
            save(tmp_path / method / f"{name}.png", photo(index + 1) + error)
    return tmp_path


@pytest.fixture
def masks(capture, tmp_path):
    np.save(tmp_path / "depth.npy", np.full((3, HEIGHT, WIDTH), WALL))
    words = ["--depth", tmp_path / "depth.npy", "--depth-along", "axis", "--out", tmp_path / "masks"]
    assert cli.main(["masks", str(capture), "--downscale", "1", "--no-normalize", *map(str, words)]) == 0
    return tmp_path / "masks"


def run(*words):
    return cli.main(["evaluate", *map(str, words), "--resamples", "30"])


def results(out):
    return json.loads((out / "results.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_two_folders_of_pictures_are_enough(renders, capture, capsys):
    out = renders / "out"
    plain = renders / "photos"
    for name in EVAL:
        save(plain / f"{name}.png", photo(EVAL.index(name) + 1))
    assert run(renders / "a", "--gt", plain, "--out", out) == 0
    said = capsys.readouterr().out
    assert "3 views, convention whole_image" in said
    assert "Scored as whole_image: proper needs masks of what the training photos saw, depth beside" in said
    found = results(out)
    (row,) = found["rows"]
    first = [np.asarray(Image.open(renders / "a" / f"{name}.png")) / 255 for name in EVAL]
    second = [np.asarray(Image.open(plain / f"{name}.png")) / 255 for name in EVAL]
    everywhere = np.ones((HEIGHT, WIDTH), dtype=bool)
    wanted = [metrics.psnr(a, b, everywhere, data_range=1.0) for a, b in zip(first, second)]
    assert row["psnr"] == pytest.approx(np.mean(wanted), abs=1e-4)
    assert [each["name"] for each in row["per_image"]] == list(EVAL)
    assert found["command"].split()[0] == "unghost"
    assert found["seeds"] == [0]
    with (out / "images.csv").open(newline="") as stream:
        table = list(csv.DictReader(stream))
    assert [line["view"] for line in table] == list(EVAL)
    assert float(table[2]["psnr"]) == pytest.approx(wanted[2], abs=1e-4)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.index("1. e2") < page.index("2. e1") < page.index("3. e0")  # the worst first


def test_masks_depth_and_two_methods(renders, capture, masks, capsys):
    rays = np.load(renders / "depth.npy")
    for method in "ab":
        depth = rays.copy()
        depth[:, : HEIGHT // 2] = np.inf if method == "b" else WALL
        np.savez(renders / method / "maps.npz", names=np.array(EVAL), depth=depth)
    words = [f"better={renders / 'b'}", "--against", renders / "a", "--gt", capture, "--no-normalize"]
    words += ["--masks", masks / "masks.npz", "--depth-along", "axis", "--out", renders / "out"]
    assert run(*words) == 0, capsys.readouterr()
    found = results(renders / "out")
    rows = {row["method"]: row for row in found["rows"]}
    assert list(rows) == ["a", "better"]
    assert {row["convention"] for row in rows.values()} == {"proper"}
    assert rows["a"]["depth_mse"] == pytest.approx(0, abs=1e-9)  # both along the axis, by way of the ray
    # half, three quarters and seven eighths of the wall were seen; of b, the lower half of that
    assert rows["a"]["coverage"] == pytest.approx((0.5 + 0.75 + 0.875) / 3)
    assert rows["better"]["coverage"] == pytest.approx((0.5 + 0.75 + 0.875) / 6)
    assert rows["a"]["psnr_common"] != rows["a"]["psnr"]
    assert rows["better"]["psnr_common"] == rows["better"]["psnr"]
    assert {row["against"] for row in found["differences"]} == {"a"}
    assert found["evaluation"]["masks"] == "masks.npz"
    assert found["evaluation"]["sorted_by"] == "better"


def test_mask_pictures_without_depth_are_the_visible_pixels(renders, capture, masks, capsys):
    assert run(renders / "a", "--gt", capture, "--no-normalize", "--masks", masks, "--out", renders / "out") == 0
    assert "convention visible_only" in capsys.readouterr().out
    (row,) = results(renders / "out")["rows"]
    assert row["coverage"] == pytest.approx((0.5 + 0.75 + 0.875) / 3)


def test_mask_pictures_belong_to_a_plain_folder_of_photos_too(renders, capture, masks):
    photos = renders / "photos"
    photos.mkdir()
    for name in EVAL:
        (capture / "images" / f"{name}.png").rename(photos / f"{name}.png")
    assert {path.name for path in masks.glob("*.png")} == {f"images_{name}.png.mask.png" for name in EVAL}
    assert run(renders / "a", "--gt", photos, "--masks", masks, "--out", renders / "out") == 0
    (row,) = results(renders / "out")["rows"]
    assert row["coverage"] == pytest.approx((0.5 + 0.75 + 0.875) / 3)


@pytest.mark.parametrize("name", ["val", "test"])
def test_without_a_sweep_called_eval_it_is_the_usual_other_name(renders, capture, capsys, name):
    sweeps = json.loads((capture / "splits.json").read_text())
    (capture / "splits.json").write_text(json.dumps({"train": sweeps["train"], name: sweeps["eval"]}))
    assert run(renders / "a", "--gt", capture, "--out", renders / "out") == 0  # else: two views have no render
    assert results(renders / "out")["evaluation"]["views"] == 3
    (capture / "splits.json").write_text(json.dumps({"walk": sweeps["train"], "back": sweeps["eval"]}))
    assert run(renders / "a", "--gt", capture, "--out", renders / "new") == 2
    assert "--eval-split must say which sweep is meant; the capture has walk, back" in capsys.readouterr().err
    assert run(renders / "a", "--gt", capture, "--eval-split", "back", "--out", renders / "new") == 0
    assert "No depth limit is known: the capture has no sweep called train" in capsys.readouterr().out
    words = ["--eval-split", "back", "--train-split", "run"]
    assert run(renders / "a", "--gt", capture, *words, "--out", renders / "third") == 2
    assert "no split 'run'" in capsys.readouterr().err


def test_views_are_sorted_by_a_metric_that_is_computed(renders, capture):
    assert run(renders / "a", "--gt", capture, "--metrics", "ssim", "psnr", "--out", renders / "out") == 0
    assert results(renders / "out")["evaluation"]["sort"] == "psnr"
    assert run(renders / "a", "--gt", capture, "--metrics", "ssim", "--out", renders / "one") == 0
    assert results(renders / "one")["evaluation"]["sort"] == "ssim"


def test_a_sort_that_is_not_computed_is_refused_before_a_picture_is_read(renders, capture, capsys):
    words = [renders / "absent", "--gt", capture, "--metrics", "ssim", "--sort", "flip", "--out", renders / "out"]
    assert run(*words) == 2
    assert "sort must be one of the metrics ssim, got 'flip'" in capsys.readouterr().err


def test_normals_that_are_no_directions_are_refused(renders, capture, capsys):
    np.savez(renders / "a" / "maps.npz", names=np.array(EVAL), normals=np.ones((3, HEIGHT, WIDTH, 3)))
    assert run(renders / "a", "--gt", capture, "--out", renders / "out") == 2
    assert f"normals must be unit vectors, or NaN for none; {3 * HEIGHT * WIDTH} are not" in capsys.readouterr().err


def test_a_black_mask_gives_dashes_and_no_nan(renders, capture, capsys):
    for name in EVAL:
        Image.new("L", (WIDTH, HEIGHT)).save(renders / f"{name}.png")
    black = renders / "black"
    black.mkdir()
    for name in EVAL:
        (renders / f"{name}.png").rename(black / f"{name}.png")
    assert run(renders / "a", "--gt", capture, "--masks", black, "--out", renders / "out") == 0
    (row,) = results(renders / "out")["rows"]
    assert (row["psnr"], row["images_scored"], row["coverage"]) == (None, 0, 0)
    assert "no pixel counts in any view" in (renders / "out" / "report.html").read_text(encoding="utf-8")


def test_one_camera_and_one_view_are_a_defined_row(renders, capture, capsys):
    meta = json.loads((capture / "transforms.json").read_text())
    meta["frames"] = meta["frames"][1:2]
    (capture / "transforms.json").write_text(json.dumps(meta))
    (capture / "splits.json").write_text(json.dumps({"eval": ["images/e0.png"], "train": ["images/e0.png"]}))
    one = renders / "one"
    one.mkdir()
    (renders / "a" / "e0.png").rename(one / "e0.png")
    assert run(one, "--gt", capture, "--out", renders / "out") == 0
    said = capsys.readouterr().out
    assert "No depth limit is known (depth_limit: needs two distinct camera origins" in said
    (row,) = results(renders / "out")["rows"]
    assert row["intervals"]["psnr"] == [None, None]
    assert row["psnr"] > 0


def test_two_identical_trajectories_are_scored(renders, capture, capsys):
    splits = {"train": [f"images/{name}.png" for name in EVAL], "eval": [f"images/{name}.png" for name in EVAL]}
    (capture / "splits.json").write_text(json.dumps(splits))
    np.savez(renders / "a" / "maps.npz", names=np.array(EVAL), depth=np.full((3, HEIGHT, WIDTH), 2.0))
    np.save(renders / "depth.npy", np.full((3, HEIGHT, WIDTH), 2.0))  # they are 1.5 apart: the limit is 3
    words = ["--depth", renders / "depth.npy", "--out", renders / "masks"]
    assert cli.main(["masks", str(capture), "--downscale", "1", "--no-normalize", *map(str, words)]) == 0
    words = [renders / "a", "--gt", capture, "--no-normalize", "--masks", renders / "masks" / "masks.npz"]
    assert run(*words, "--out", renders / "out") == 0
    (row,) = results(renders / "out")["rows"]
    assert row["convention"] == "proper"
    assert row["mask_precision"] == row["coverage"] > 0.99  # every view sees its own pixels
    assert row["mask_recall"] == 1


@pytest.mark.parametrize("words", [("--min-views", "3"), ("--occlusion", "False")])
def test_options_of_masks_npz_are_refused_without_it(renders, capture, masks, capsys, words):
    option = words[0].removeprefix("--").replace("-", "_")
    assert run(renders / "a", "--gt", capture, "--no-normalize", *words, "--out", renders / "out") == 2
    assert (
        f"--{option.replace('_', '-')} needs masks.npz (of unghost masks) as masks, got no masks"
        in capsys.readouterr().err
    )
    words = (*words, "--masks", masks)
    assert run(renders / "a", "--gt", capture, "--no-normalize", *words, "--out", renders / "out") == 2
    assert f"got the pictures in {masks}" in capsys.readouterr().err


def test_lpips_that_cannot_be_had_leaves_the_other_columns(renders, capture, capsys, monkeypatch):
    from unghost.evaluation.metrics import perceptual

    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: None)
    words = [renders / "a", "--gt", capture, "--out", renders / "out", "--lpips", "vgg"]
    assert run(*words) == 0
    assert "LPIPS is left out. load_lpips: LPIPS (vgg) needs the packages" in capsys.readouterr().out
    assert results(renders / "out")["rows"][0]["ssim"] is not None
    assert run(*words, "--metrics", "psnr", "lpips") == 2
    assert "needs the packages" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["a", "--convention", "proper"],
            "'proper' needs what is not there (a: masks of what the training photos saw,",
        ),
        (["a", "--convention", "propper"], "must be one of proper, paper_text"),
        (["a", "--metrics", "depth_mse"], "'whole_image' does not define 'depth_mse'"),
        (["a", "--metrics", "lpips"], "lpips was asked for, but no LPIPS network"),
        (["a", "--sort", "coverage"], "key must be one of psnr"),
        (["a", "--sort", "depth_mse"], "no view of a has a depth_mse to sort by, but psnr, ssim, flip, coverage"),
        (["a", "--downscale", "2"], "are not 16 x 12 as the photos are"),
        (["a", "--eval-split", "third"], "no split 'third'"),
        (["a", "--eval-split", "all"], "2 of 5 views have none (images/t0.png, images/t1.png)"),
        (["a", "a"], "two methods are called 'a'"),
        (["absent"], "no folder"),
        ([], "no folder of renders"),
        (["a", "--masks", "nothing.npz"], "nothing.npz"),
        (["a", "--depth-along", "axis", "--gt", "photos"], "axis needs the cameras"),
    ],
)
def test_mistakes_are_a_line_and_write_nothing(words, message, renders, capture, capsys, monkeypatch):
    monkeypatch.chdir(renders)
    for name in EVAL:
        save(renders / "photos" / f"{name}.png", photo(1))
    words = words if "--gt" in words else [*words, "--gt", capture]
    assert run(*words, "--out", "out") == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (renders / "out").exists()


def test_masks_of_other_photos_are_refused(renders, capture, masks, capsys):
    stored = masks / "masks.npz"
    assert run(renders / "a", "--gt", capture, "--masks", stored, "--out", renders / "out") == 2
    assert "of other eval cameras" in capsys.readouterr().err  # normalised here, not there
    words = [renders / "a", "--gt", capture, "--masks", stored, "--no-normalize", "--downscale", "2"]
    assert run(*words, "--out", renders / "out") == 2
    assert "the photos are 16 x 12" in capsys.readouterr().err
    assert not (renders / "out").exists()


def test_report_makes_the_page_again(renders, capture, capsys):
    assert run(renders / "a", renders / "b", "--gt", capture, "--out", renders / "out") == 0
    assert cli.main(["report", str(renders / "out" / "results.json")]) == 0
    page = (renders / "out" / "results.html").read_text(encoding="utf-8")
    assert "Differences, view by view" in page
    assert "<h2>Views, worst first" not in page
    assert cli.main(["report", str(renders / "absent.json")]) == 2
    assert "unghost report: read_results: no file" in capsys.readouterr().err
