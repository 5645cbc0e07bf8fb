import dataclasses
import hashlib
import io
import json
import zipfile

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.scoring import engine as scoring
from unghost.evaluation.scoring import protocol
from unghost.evaluation.scoring import pseudo_truth as pseudo
from unghost.evaluation.scoring.conventions import SceneExtent
from unghost.evaluation.scoring.pseudo_truth import load_pseudo_truth, make_pseudo_truth
from unghost.evaluation.scoring.views import Renders

WIDTH, HEIGHT, WALL = 20, 16, 4.0
GOLDEN_POSES = "6619283cbbcffba7e57ac65aa7b57b23802e6e9c08dc0fb6788d3b53a1d1cb5f"
GOLDEN_LENSES = "e6a3c6b94002117a8072a6c897502c82fd3bf3049bb3a7b2db008951db32d4c0"


def _cameras(offsets, *, distortion=None):
    poses = np.tile(np.eye(4), (len(offsets), 1, 1))
    poses[:, :3, 3] = offsets
    return Cameras.create(poses, np.array([20.0, 20.0, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT, distortion)


def _plane(cameras, z):
    """Distance along unit rays to the plane at depth z."""
    depths = []
    for index in range(len(cameras)):
        origins, directions = cameras.rays(index)
        depths.append((-z - origins[..., 2]) / directions[..., 2])
    return np.stack(depths)


TRAIN = _cameras([[0.0, 0, 0], [1.0, 0, 0]])
EVAL = _cameras([[0.5, 0, 0], [3.0, 0, 0]])


def _maps(**settings):
    settings = {"train_depth": _plane(TRAIN, WALL), "names": ("a", "b"), "details": {"scene": "wall"}, **settings}
    return make_pseudo_truth(EVAL, TRAIN, _plane(EVAL, WALL), **settings)


def _same(first, second):
    for item in dataclasses.fields(first):
        a, b = getattr(first, item.name), getattr(second, item.name)
        if isinstance(a, Cameras):
            assert (a.width, a.height) == (b.width, b.height)
            assert all(np.array_equal(getattr(a, name), getattr(b, name)) for name in pseudo.LENSES)
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        else:
            assert a == b


def test_maps_of_a_wall_by_hand():
    maps = _maps()
    np.testing.assert_allclose(maps.normals, np.broadcast_to([0.0, 0, 1], maps.normals.shape), atol=1e-5)
    # a frustum reaches 2 to either side at the wall, about x = 0 and x = 1
    for index, eye in enumerate((0.5, 3.0)):
        x = eye + (np.arange(WIDTH) + 0.5 - WIDTH / 2) / 20 * WALL
        seen = (np.abs(x) <= 2).astype(int) + (np.abs(x - 1) <= 2)
        np.testing.assert_array_equal(maps.seen_frustum[index], np.broadcast_to(seen, (HEIGHT, WIDTH)))
    np.testing.assert_array_equal(maps.seen_open, maps.seen_frustum)
    assert maps.extent == SceneExtent.of(TRAIN, EVAL)
    assert maps.extent.limit == 6.0


def test_what_stands_in_front_hides_the_wall_from_one_camera():
    blocked = _plane(TRAIN, WALL)
    blocked[1] = _plane(TRAIN, 1.0)[1]
    maps = _maps(train_depth=blocked)
    first_alone = protocol.view_counts(EVAL, _plane(EVAL, WALL), TRAIN.select([0]))
    np.testing.assert_array_equal(maps.seen_open, first_alone)
    np.testing.assert_array_equal(maps.seen_frustum, _maps().seen_frustum)
    assert maps.visible(occlusion=True).sum() < maps.visible(occlusion=False).sum()


def test_visible_is_the_protocols_mask():
    maps = _maps()
    for minimum in (1, 2):
        wanted = protocol.visibility_masks(EVAL, _plane(EVAL, WALL), TRAIN, minimum_views=minimum)
        np.testing.assert_array_equal(maps.visible(occlusion=False, minimum_views=minimum), wanted)
    with pytest.raises(ValueError, match="minimum_views must be >= 1, got 0"):
        maps.visible(occlusion=False, minimum_views=0)
    with pytest.raises(ValueError, match="occlusion needs maps made with train_depth"):
        _maps(train_depth=None).visible(occlusion=True)


def test_stored_maps_come_back_as_they_were(tmp_path):
    depth = _plane(EVAL, WALL)
    depth[0, :2] = np.inf
    for maps in (_maps(), _maps(train_depth=None, details=None, names=()), make_pseudo_truth(EVAL, TRAIN, depth)):
        path = tmp_path / "maps.npz"
        maps.save(path)
        _same(load_pseudo_truth(path), maps)
        _same(load_pseudo_truth(path, eval_cameras=EVAL, train_cameras=TRAIN), maps)
        assert [each.name for each in tmp_path.iterdir()] == ["maps.npz"]


def test_a_lens_and_given_normals_survive(tmp_path):
    bent = _cameras([[0.0, 0, 0], [1.0, 0, 0]], distortion=np.array([-0.05, 0.01, 0, 0, 1e-3, 0]))
    normals = np.full((2, HEIGHT, WIDTH, 3), np.nan)
    normals[..., :8, :] = [0.6, 0.0, 0.8]
    maps = make_pseudo_truth(bent, TRAIN, _plane(bent, WALL), normals=normals)
    maps.save(tmp_path / "maps.npz")
    _same(load_pseudo_truth(tmp_path / "maps.npz", eval_cameras=bent), maps)
    with pytest.raises(ValueError, match=r"other eval cameras: distortion of camera 0 is off by 0\.05"):
        load_pseudo_truth(tmp_path / "maps.npz", eval_cameras=_cameras([[0.0, 0, 0], [1.0, 0, 0]]))


def test_maps_of_other_cameras_are_refused(tmp_path):
    path = tmp_path / "maps.npz"
    _maps().save(path)
    with pytest.raises(
        ValueError, match=r"maps.npz is of other eval cameras: camera_to_world of camera 1 is off by 0.1"
    ):
        load_pseudo_truth(path, eval_cameras=_cameras([[0.5, 0, 0], [3.1, 0, 0]]))
    with pytest.raises(ValueError, match="of other train cameras: camera_to_world of camera 0 is off by 1"):
        load_pseudo_truth(path, train_cameras=_cameras([[1.0, 0, 0], [0.0, 0, 0]]))
    with pytest.raises(ValueError, match="2 train cameras of 20 x 16, not of 1 of 20 x 16"):
        load_pseudo_truth(path, train_cameras=TRAIN.select([0]))
    with pytest.raises(ValueError, match="not of 2 of 40 x 32"):
        load_pseudo_truth(path, eval_cameras=EVAL.resized(2))
    nearly = _cameras(EVAL.origins + 1e-8)
    _same(load_pseudo_truth(path, eval_cameras=nearly), _maps())


def test_the_file_can_be_read_from_its_description(tmp_path):
    # zipfile, the .npy header and SHA-256, nothing of ours
    path = tmp_path / "maps.npz"
    maps = _maps()
    maps.save(path)
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            raw = archive.read(name)
            assert raw[:6] == b"\x93NUMPY"
            arrays[name.removesuffix(".npy")] = np.lib.format.read_array(io.BytesIO(raw), allow_pickle=False)
    manifest = json.loads(arrays.pop("manifest").tobytes().decode("utf-8"))
    assert {key: manifest[key] for key in manifest if key != "sha256"} == {
        "format": "unghost-pseudo-gt",
        "format_version": 1,
        "names": ["a", "b"],
        "eval_size": [20, 16],
        "train_size": [20, 16],
        "depth_limit": 6.0,
        "tolerance": 0.05,
        "details": {"scene": "wall"},
    }
    types = {name: (values.dtype.str, values.shape) for name, values in arrays.items()}
    assert types == {
        "depth": ("<f4", (2, 16, 20)),
        "normals": ("<f4", (2, 16, 20, 3)),
        "seen_frustum": ("<u2", (2, 16, 20)),
        "seen_open": ("<u2", (2, 16, 20)),
        "eval_camera_to_world": ("<f8", (2, 3, 4)),
        "eval_intrinsics": ("<f8", (2, 4)),
        "eval_distortion": ("<f8", (2, 6)),
        "train_camera_to_world": ("<f8", (2, 3, 4)),
        "train_intrinsics": ("<f8", (2, 4)),
        "train_distortion": ("<f8", (2, 6)),
    }
    for name, values in arrays.items():
        text = "x".join(str(length) for length in values.shape) + ":"
        assert hashlib.sha256(text.encode() + values.tobytes()).hexdigest() == manifest["sha256"][name]
    # golden: of 24 and 8 little-endian doubles packed by struct after "2x3x4:" and "2x4:"
    assert manifest["sha256"]["eval_camera_to_world"] == GOLDEN_POSES
    assert manifest["sha256"]["eval_intrinsics"] == GOLDEN_LENSES


def _rewrite(path, **changes):
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    manifest = json.loads(arrays["manifest"].tobytes().decode())
    manifest |= changes.pop("manifest", {})
    arrays |= changes
    arrays["manifest"] = np.frombuffer(json.dumps(manifest).encode(), dtype=np.uint8)
    np.savez(path, **arrays)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_files_are_refused(tmp_path, share):
    path = tmp_path / "maps.npz"
    _maps().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(ValueError, match=r"maps.npz is not pseudo ground truth, or is truncated"):
        load_pseudo_truth(path)


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / "maps.npz"
    with pytest.raises(FileNotFoundError):
        load_pseudo_truth(path)
    path.write_text("hello")
    with pytest.raises(ValueError, match="is not pseudo ground truth, or is truncated"):
        load_pseudo_truth(path)
    np.savez(path, depth=np.ones(3))
    with pytest.raises(ValueError, match="is not pseudo ground truth"):
        load_pseudo_truth(path)
    np.savez(path, manifest=np.array([{"format": "unghost-pseudo-gt"}], dtype=object))
    with pytest.raises(ValueError, match=r"is not pseudo ground truth.*\(ValueError\)"):
        load_pseudo_truth(path)
    _maps().save(path)
    _rewrite(path, manifest={"format": "unghost-keep-mask"})
    with pytest.raises(ValueError, match="format must be 'unghost-pseudo-gt'"):
        load_pseudo_truth(path)
    _rewrite(path, manifest={"format": "unghost-pseudo-gt", "format_version": 3})
    with pytest.raises(ValueError, match="has version 3, this release reads 1 and 2"):
        load_pseudo_truth(path)


def test_altered_files_are_refused(tmp_path):
    path = tmp_path / "maps.npz"
    maps = _maps()

    def refused(match, **changes):
        maps.save(path)
        _rewrite(path, **changes)
        with pytest.raises(ValueError, match=match):
            load_pseudo_truth(path)

    refused("was altered: depth does not match its hash", depth=maps.depth + 1)
    refused("was altered: depth", depth=maps.depth.astype(np.float64))
    refused("was altered: seen_frustum", seen_frustum=maps.seen_frustum.reshape(2, WIDTH, HEIGHT))
    refused("sha256 must name exactly the arrays", extra=np.zeros(3))
    refused("is inconsistent: depth_limit 7.0 for cameras of 6.0", manifest={"depth_limit": 7.0})
    refused("is inconsistent: .*names must be 2 different ones", manifest={"names": ["a", "a"]})
    refused("is inconsistent: .*tolerance must be there", manifest={"tolerance": None})
    refused("is inconsistent: 'details'|is inconsistent", manifest={"details": 3})
    refused(r"is inconsistent: .*depth must have shape \(2, 16, 21\)", manifest={"eval_size": [21, 16]})


def test_a_failed_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "maps.npz"
    maps = _maps()
    maps.save(path)
    broken = dataclasses.replace(maps, details={"bad": float("nan")})
    with pytest.raises(ValueError, match="not JSON compliant"):
        broken.save(path)
    _same(load_pseudo_truth(path), maps)
    assert [each.name for each in tmp_path.iterdir()] == ["maps.npz"]


def test_bad_maps_are_refused_when_made():
    depth = _plane(EVAL, WALL)
    spoilt = depth.copy()
    spoilt[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"pseudo_depth must be > 0 .* 1 values are not"):
        make_pseudo_truth(EVAL, TRAIN, spoilt)
    with pytest.raises(ValueError, match="normals must be unit vectors, or NaN for none; 640 are not"):
        make_pseudo_truth(EVAL, TRAIN, depth, normals=np.ones((2, HEIGHT, WIDTH, 3)))
    with pytest.raises(ValueError, match=r"normals must have shape \(2, 16, 20, 3\), got \(2, 16, 20\)"):
        make_pseudo_truth(EVAL, TRAIN, depth, normals=depth)
    with pytest.raises(ValueError, match="names must be 2 different ones"):
        make_pseudo_truth(EVAL, TRAIN, depth, names=("a",))
    with pytest.raises(ValueError, match="details must be JSON without NaN"):
        make_pseudo_truth(EVAL, TRAIN, depth, details={"f": len})
    with pytest.raises(ValueError, match="two distinct camera origins"):
        make_pseudo_truth(EVAL.select([0]), EVAL.select([0]), depth[:1])


def test_two_identical_trajectories_see_everything():
    maps = make_pseudo_truth(TRAIN, TRAIN, _plane(TRAIN, WALL), train_depth=_plane(TRAIN, WALL))
    assert maps.visible(occlusion=True).all()
    assert (maps.seen_frustum >= 1).all()


def test_the_pseudo_truth_scores_itself_perfectly():
    photos = np.random.default_rng(0).random((2, HEIGHT, WIDTH, 3))
    maps = _maps()
    truth = maps.truth(photos, occlusion=True)
    assert truth.names == ("a", "b")
    renders = Renders(photos, maps.depth, np.ones_like(maps.depth), maps.normals)
    found = scoring.score_scene(renders, truth, maps.extent, convention="proper").means()
    assert found["psnr"] == float("inf")
    assert (found["depth_mse"], found["disparity_mae"], found["normal_pct_30"]) == (0, 0, 1)
    assert found["coverage"] == pytest.approx((maps.visible(occlusion=True) & (maps.depth < 6)).mean())
    cut = scoring.score_scene(renders, truth, maps.extent, convention="proper", within=truth.visible & False)
    assert cut.means()["psnr"] is None
    with pytest.raises(ValueError, match="within must be bool of shape"):
        scoring.score_scene(renders, truth, maps.extent, convention="proper", within=truth.visible[0])


def test_counts_beyond_the_type_stop_at_its_end():
    assert pseudo._counts(np.array([0, 65535, 70000])).tolist() == [0, 65535, 65535]
