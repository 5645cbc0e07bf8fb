"""Views that differ in size, and fisheyes: every number is that of each view alone."""

import json

import numpy as np
import pytest
from PIL import Image

from unghost import cli
from unghost.core.cameras import Cameras, look_at
from unghost.evaluation.metrics.geometry import backproject
from unghost.evaluation.scoring.conventions import CONVENTIONS, PLAIN_CONVENTIONS, SceneExtent
from unghost.evaluation.scoring.depths import optical_depth, ray_depth
from unghost.evaluation.scoring.engine import score_scene
from unghost.evaluation.scoring.evaluation import evaluate
from unghost.evaluation.scoring.protocol import view_counts
from unghost.evaluation.scoring.pseudo_truth import load_pseudo_truth, make_pseudo_truth
from unghost.evaluation.scoring.renders import Method, read_map, read_sized_photos
from unghost.evaluation.scoring.views import Renders, Truth, pad_views
from unghost.evaluation.uncertainty.photometric import photo_doubt

WIDTH, HEIGHT = np.array([24, 16, 24, 18]), np.array([16, 24, 16, 18])
FISHEYE = np.array([False, False, False, True])


def rig(count=4, *, turn=0.0, fisheye=True):
    """Landscape, portrait, landscape, and a square fisheye, about the origin."""
    angle = np.arange(count) * 0.4 + turn
    origins = np.stack([3 * np.cos(angle), 3 * np.sin(angle), np.full(count, 0.5)], axis=1)
    width, height = WIDTH[:count], HEIGHT[:count]
    lens = np.stack([np.full(count, 20.0), np.full(count, 20.0), width / 2, height / 2], axis=1)
    bend = np.where(FISHEYE[:count, None], [0.05, -0.01, 0, 0, 0, 0], 0.0) if fisheye else None
    poses = look_at(origins, np.zeros((count, 3)))
    return Cameras.create(poses, lens, width, height, bend, FISHEYE[:count] & fisheye)


def maps(cameras, draw, fill, seed=0):
    """A random map a view, and what stands beside it."""
    rng = np.random.default_rng(seed)
    return pad_views([draw(rng, shape) for shape in cameras.shapes], cameras.canvas, fill)


def depths(cameras, fill=np.inf, seed=0):
    return maps(cameras, lambda rng, shape: rng.uniform(1, 9, shape), fill, seed)


def photos(cameras, fill=0.0, seed=0):
    return maps(cameras, lambda rng, shape: rng.random((*shape, 3)), fill, seed)


def alone(cameras, index, *arrays):
    """One view of padded arrays as if there were no other; its camera with a size of two numbers."""
    width, height = cameras.size(index)
    one = Cameras.create(
        cameras.camera_to_world[[index]],
        cameras.intrinsics[index],
        width,
        height,
        cameras.distortion[index],
        bool(cameras.fisheye[index]),
    )
    return one, *(each[[index], :height, :width] for each in arrays)


@pytest.mark.parametrize("convention", [*CONVENTIONS, *PLAIN_CONVENTIONS])
@pytest.mark.parametrize("beside", [0.0, 1.0])
def test_scores_are_those_of_each_view_alone(convention, beside):
    cameras, rng = rig(), np.random.default_rng(1)
    target, preds = photos(cameras, beside), photos(cameras, 1 - beside, seed=2)
    depth, pseudo = depths(cameras, 1 + beside, seed=3), depths(cameras, 2.0, seed=4)
    visible = rng.random(depth.shape) < 0.7
    accumulation = maps(cameras, lambda rng, shape: rng.uniform(0.9, 1, shape), 1.0, seed=5)
    extent = SceneExtent(8.0, 3.0)
    truth = Truth(target, visible, pseudo, cameras=cameras)
    found = score_scene(Renders(preds, depth, accumulation), truth, extent, convention=convention)
    for index in range(len(cameras)):
        one, *parts = alone(cameras, index, target, preds, depth, pseudo, visible, accumulation)
        truth = Truth(parts[0], parts[4], parts[3], cameras=one, names=(str(index),))
        wanted = score_scene(Renders(parts[1], parts[2], parts[5]), truth, extent, convention=convention)
        assert found.images[index] == wanted.images[0]
        assert found.images[index]["pixels"] > 0


def test_what_stands_beside_a_view_counts_nowhere_in_a_comparison():
    cameras = rig()
    results = []
    for beside in (0.0, 0.9):
        target, preds, other = (photos(cameras, beside * k / 2, seed=k) for k in range(3))
        confidence = maps(cameras, lambda rng, shape: rng.random(shape), np.nan if beside else 1.0, seed=4)
        methods = [Method("a", Renders(preds), confidence), Method("b", Renders(other))]
        found = evaluate(methods, Truth(target, cameras=cameras), resamples=10)
        results.append(json.dumps([found.rows, found.differences, found.conventions]))
    assert results[0] == results[1]
    row = found.rows[0]
    assert [each["pixels"] for each in row["per_image"]] == [384, 384, 384, 324]


def test_sizes_need_no_cameras_and_must_fit():
    target = photos(rig())
    truth = Truth(target, sizes=np.stack([WIDTH, HEIGHT], axis=1))
    assert truth.shapes == [(16, 24), (24, 16), (16, 24), (18, 18)]
    assert truth.inside().sum() == 3 * 384 + 324
    assert Truth(target).inside() is None
    for sizes in ([[24, 16]] * 4, [[24, 24]] * 3, [[24, 24], [0, 1], [1, 1], [1, 1]]):
        with pytest.raises(ValueError, match="sizes must be 4 of width and height, the largest 24 x 24"):
            Truth(target, sizes=np.array(sizes))
    with pytest.raises(ValueError, match="sizes must be those of the cameras"):
        Truth(target, cameras=rig(), sizes=np.full((4, 2), 24))


def test_views_are_counted_as_each_alone():
    train, views = rig(turn=0.2), rig()
    depth, beside = depths(views), depths(train, seed=7)
    for given in (None, beside):
        found = view_counts(views, depth, train, train_depth=given)
        assert found.max() > 1
        for index in range(len(views)):
            one, mine = alone(views, index, depth)
            apart = np.zeros(mine.shape, dtype=int)
            for other in range(len(train)):
                single, hidden = alone(train, other, beside)
                apart += view_counts(one, mine, single, train_depth=None if given is None else hidden)
            np.testing.assert_array_equal(found[index][views.window(index)][None], apart)
        outside = np.ones(found.shape, dtype=bool)
        for index in range(len(views)):
            outside[index][views.window(index)] = False
        assert not found[outside].any()
    np.testing.assert_allclose(ray_depth(optical_depth(depth, views), views), depth)
    with pytest.raises(ValueError, match=r"depth must have shape \(4, 24, 24\), got \(4, 16, 24\)"):
        optical_depth(depth[:, :16], views)
    with pytest.raises(ValueError, match=r"backproject: depth must have shape \(24, 16\), got \(24, 24\)"):
        backproject(depth[1], views, 1)


def test_masks_of_fisheyes_and_sizes_are_stored_and_of_no_other_cameras(tmp_path):
    train, views = rig(turn=0.2), rig()
    made = make_pseudo_truth(views, train, depths(views), train_depth=depths(train, seed=7))
    made.save(tmp_path / "masks.npz")
    again = load_pseudo_truth(tmp_path / "masks.npz", eval_cameras=views, train_cameras=train)
    for here, there in ((again.eval_cameras, views), (again.train_cameras, train)):
        np.testing.assert_array_equal(here.sizes, there.sizes)
        np.testing.assert_array_equal(here.fisheye, there.fisheye)
        np.testing.assert_array_equal(here.rays(3)[1], there.rays(3)[1])
    np.testing.assert_array_equal(again.seen_open, made.seen_open)
    for index in range(len(views)):
        one, mine = alone(views, index, made.depth)
        single = make_pseudo_truth(one, train, mine)
        np.testing.assert_allclose(made.normals[index][views.window(index)][None], single.normals, atol=1e-5)
    manifest = json.loads(np.load(tmp_path / "masks.npz")["manifest"].tobytes())
    assert manifest["format_version"] == 2
    assert manifest["eval_size"] == [[24, 16], [16, 24], [24, 16], [18, 18]]
    straight = Cameras(views.camera_to_world, views.intrinsics, *views.sizes.T, views.distortion)
    with pytest.raises(ValueError, match=r"of other eval cameras: camera 3 has another lens \(fisheye or not\)"):
        load_pseudo_truth(tmp_path / "masks.npz", eval_cameras=straight)
    turned = Cameras(views.camera_to_world, views.intrinsics, *views.sizes.T[::-1], views.distortion, views.fisheye)
    with pytest.raises(ValueError, match=r"of other eval cameras: camera 0 has another size"):
        load_pseudo_truth(tmp_path / "masks.npz", eval_cameras=turned)
    alike = views.select([0, 2])  # nothing new about these: the format that every release reads
    make_pseudo_truth(alike, alike, depths(alike)).save(tmp_path / "plain.npz")
    manifest = json.loads(np.load(tmp_path / "plain.npz")["manifest"].tobytes())
    assert (manifest["format_version"], manifest["eval_size"]) == (1, [24, 16])
    assert "eval_fisheye" not in manifest


def test_doubt_is_that_of_each_view_alone():
    views, train = rig(), rig(turn=0.2)
    colors, depth = photos(views, 0.3), np.minimum(depths(views), 4.0)
    shown, hidden = photos(train, 0.6, seed=3), np.full((4, *train.canvas), 3.5)
    beside = dict(photos=shown, photo_depth=hidden, photo_cameras=train, tolerance=0.2)
    found = photo_doubt(colors, depth, views, **beside)
    assert (found < 1).mean() > 0.1
    again = photo_doubt(colors, depth, views, **beside | {"photos": photos(train, 0.1, seed=3)})
    np.testing.assert_array_equal(found, again)  # what stands beside a photo is not looked at
    for index in range(len(views)):
        one, mine, here = alone(views, index, colors, depth)
        np.testing.assert_array_equal(found[index][views.window(index)][None], photo_doubt(mine, here, one, **beside))


def test_folders_of_pictures_of_two_sizes(tmp_path):
    for name, size in (("a", (6, 4)), ("b", (4, 6))):
        for folder in ("photos", "renders"):
            (tmp_path / folder).mkdir(exist_ok=True)
            Image.new("RGB", size, (200, 100, 50)).save(tmp_path / folder / f"{name}.png")
    names, pictures, sizes = read_sized_photos(tmp_path / "photos")
    assert (names, pictures.shape, sizes.tolist()) == (("a", "b"), (2, 6, 6, 3), [[6, 4], [4, 6]])
    (tmp_path / "renders" / "depth").mkdir()
    np.save(tmp_path / "renders" / "depth" / "a.npy", np.full((4, 6), 2.0))
    np.save(tmp_path / "renders" / "depth" / "b.npy", np.full((6, 4), 3.0))
    depth = read_map(tmp_path / "renders", "depth", names, [(4, 6), (6, 4)])
    assert np.isinf(depth).sum() == 24
    assert (depth[0, :4], depth[1, :, :4]) == (pytest.approx(2.0), pytest.approx(3.0))
    np.savez(tmp_path / "renders" / "maps.npz", names=np.array(["a", "b"]), depth=np.where(np.isinf(depth), 0, depth))
    np.testing.assert_array_equal(read_map(tmp_path / "renders", "depth", names, [(4, 6), (6, 4)]), depth)
    found = evaluate(tmp_path / "renders", tmp_path / "photos", resamples=10)
    assert [each["pixels"] for each in found.rows[0]["per_image"]] == [24, 24]
    assert found.rows[0]["infinite"] == ["psnr"]
    Image.new("RGB", (6, 4)).save(tmp_path / "renders" / "b.png")
    with pytest.raises(ValueError, match=r"1 of 2 pictures in .* are not 4 x 6 as the photos are: b.png is 6 x 4"):
        evaluate(tmp_path / "renders", tmp_path / "photos")


def test_a_capture_of_portrait_landscape_and_fisheye_through_the_verbs(tmp_path, capsys):
    """masks, uncertainty and evaluate: the photos themselves, of a wall that everybody sees, are beyond doubt."""
    folder, frames = tmp_path / "capture", []
    (folder / "images").mkdir(parents=True)
    cameras = {sweep: rig(3, turn=turn, fisheye=False) for sweep, turn in (("train", 0.1), ("eval", 0.0))}
    for sweep, views in cameras.items():
        for index in range(3):
            name, (width, height) = f"images/{sweep}_{index}.png", views.size(index)
            Image.new("RGB", (width, height), (200, 100, 50)).save(folder / name)
            pose = [*views.camera_to_world[index].tolist(), [0, 0, 0, 1]]
            lens = {"w": width, "h": height, "fl_x": 20.0, "cx": width / 2, "cy": height / 2}
            frames.append({"file_path": name, "transform_matrix": pose, **lens})
            if index == 2:
                frames[-1] |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "fl_y": 20.0}
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    for sweep, views in cameras.items():
        renders = tmp_path / f"renders_{sweep}"
        (renders / "depth").mkdir(parents=True)
        for index in range(3):
            width, height = views.size(index)
            Image.new("RGB", (width, height), (200, 100, 50)).save(renders / f"{sweep}_{index}.png")
            np.save(renders / "depth" / f"{sweep}_{index}.npy", np.full((height, width), 3.0))
        np.savez(
            tmp_path / f"{sweep}.npz",
            depth=np.where(maps(views, lambda _, shape: np.ones(shape), 0.0) > 0, 3.0, np.inf),
        )
    plain = ["--downscale", "1", "--no-normalize"]
    words = ["masks", folder, "--depth", tmp_path / "eval.npz", "--train-depth", tmp_path / "train.npz"]
    assert cli.main([*map(str, [*words, "--out", tmp_path / "masks"]), *plain]) == 0
    with Image.open(tmp_path / "masks" / "images_eval_1.png.mask.png") as picture:
        assert picture.size == (16, 24)
    words = ["doubt", tmp_path / "renders_eval", "--gt", folder, "--train-renders", tmp_path / "renders_train"]
    assert cli.main([*map(str, words), *plain]) == 0
    doubt = np.load(tmp_path / "renders_eval" / "uncertainty" / "eval_1.npy")
    assert doubt.shape == (24, 16)
    assert doubt[12, 8] == 0.0
    words = ["evaluate", tmp_path / "renders_eval", "--gt", folder, "--masks", tmp_path / "masks" / "masks.npz"]
    assert cli.main([*map(str, [*words, "--out", tmp_path / "page"]), "--no-normalize"]) == 0
    assert "3 views, convention proper" in capsys.readouterr().out
    row = json.loads((tmp_path / "page" / "results.json").read_text())["rows"][0]
    assert 0.3 < row["coverage"] <= 1
    assert row["infinite"] == ["psnr"]
