import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.captures.loading import load_cameras, load_capture

SHARED = Path(__file__).parents[3].parent / "shared" / "data" / "captures" / "snowmiku_plush"
POSES = [
    [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]],
    [[0, -1, 0, 3], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]],
    [[1, 0, 0, 2], [0, 1, 0, 6], [0, 0, 1, 3], [0, 0, 0, 1]],
]


def _write(folder, *, meta=None, drop=(), splits=None, size=(16, 12)):
    """Three 16 x 12 photos; photo i has red = 40 i and a green ramp from left to right."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, pose in enumerate(POSES):
        pixels = np.zeros((size[1], size[0], 3), dtype=np.uint8)
        pixels[..., 0] = 40 * index
        pixels[..., 1] = np.arange(size[0])[None] * 8
        Image.fromarray(pixels).save(folder / "images" / f"{index}.png")
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose})
    shared = {"camera_model": "OPENCV", "fl_x": 20.0, "fl_y": 21.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12, "k1": 0.03}
    content = {key: value for key, value in {**shared, "frames": frames, **(meta or {})}.items() if key not in drop}
    (folder / "transforms.json").write_text(json.dumps(content))
    named = (
        {"note": "two sweeps", "first": ["images/0.png", "./images/1.png"], "second": ["images/2.png"]}
        if splits is None
        else splits
    )
    if named:
        (folder / "splits.json").write_text(json.dumps(named))
    return folder


def test_a_capture_has_the_poses_lens_and_splits_of_its_files(tmp_path):
    capture = load_capture(_write(tmp_path / "c"), downscale=1, normalize=False)
    assert len(capture) == 3
    assert capture.names == ("images/0.png", "images/1.png", "images/2.png")
    np.testing.assert_array_equal(capture.cameras.camera_to_world, np.array(POSES, dtype=float)[:, :3])
    np.testing.assert_array_equal(capture.cameras.intrinsics, [[20, 21, 8, 6]] * 3)
    np.testing.assert_array_equal(capture.cameras.distortion, [[0.03, 0, 0, 0, 0, 0]] * 3)
    np.testing.assert_array_equal(capture.split("first"), [0, 1])
    np.testing.assert_array_equal(capture.split("all"), [0, 1, 2])
    np.testing.assert_array_equal(capture.transform, np.eye(4))


def test_cameras_need_no_photos_and_are_those_of_the_capture(tmp_path):
    folder = _write(tmp_path / "c")
    wanted = load_capture(folder, downscale=1, normalize=False).cameras
    shutil.rmtree(folder / "images")
    for path in (folder, folder / "transforms.json"):
        found = load_cameras(path)
        assert (found.width, found.height) == (16, 12)
        np.testing.assert_array_equal(found.camera_to_world, wanted.camera_to_world)
        np.testing.assert_array_equal(found.intrinsics, wanted.intrinsics)
        np.testing.assert_array_equal(found.distortion, wanted.distortion)


@pytest.mark.parametrize(
    ("meta", "drop", "message"),
    [
        ({}, ("w",), "must state one w and h"),
        ({"h": 0}, (), "must state one w and h"),
        ({"w": [16]}, (), "must state one w and h"),
        ({"w": math.inf}, (), "must state one w and h"),
        ({"frames": []}, (), "has no frames"),
        ({}, ("fl_x",), "neither fl_x nor camera_angle_x"),
    ],
)
def test_cameras_that_a_file_does_not_tell(meta, drop, message, tmp_path):
    folder = _write(tmp_path / "c", meta=meta, drop=drop)
    shutil.rmtree(folder / "images")
    with pytest.raises(ValueError, match=message):
        load_cameras(folder)


def test_a_size_that_a_file_does_not_state_is_that_of_the_photos(tmp_path):
    cameras = load_cameras(_write(tmp_path / "c", drop=("w", "h")))
    assert (cameras.width, cameras.height) == (16, 12)


def test_cameras_of_two_sizes_have_each_their_own(tmp_path):
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose, "w": 16 + i} for i, pose in enumerate(POSES)]
    cameras = load_cameras(_write(tmp_path / "c", meta={"frames": frames}))
    assert cameras.sizes.tolist() == [[16, 12], [17, 12], [18, 12]]
    del frames[1]["w"]
    with pytest.raises(ValueError, match=r"one w and h in pixels for each frame, got None x 12 for 1\.png"):
        load_cameras(_write(tmp_path / "d", meta={"frames": frames}, drop=("w",)))


FISHEYE = {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.0005, "p1": 0, "p2": 0}


@pytest.mark.parametrize(
    "meta",
    [
        {**FISHEYE, "camera_model": "OPENCV_FISHEYE"},  # nerfstudio
        {**FISHEYE, "camera_model": None, "is_fisheye": True, "camera_angle_x": 2.2},  # instant-ngp
        {**FISHEYE, "camera_model": "OPENCV_FISHEYE", "is_fisheye": True},
        {"camera_model": "OPENCV_FISHEYE", "distortion_params": [0.05, -0.01, 0.002, -0.0005, 0, 0]},
    ],
)
def test_a_fisheye_is_read_as_one(tmp_path, meta):
    """A point 45 degrees off the axis lands at theta (1 + k1 theta^2 + ...), written out here."""
    folder = _write(tmp_path / "c", meta=meta)
    for cameras in (load_cameras(folder), load_capture(folder, downscale=1, normalize=False).cameras):
        assert cameras.fisheye.all()
        assert cameras.distortion[0].tolist() == [0.05, -0.01, 0.002, -0.0005, 0, 0]
        theta = math.pi / 4
        radius = theta * (1 + 0.05 * theta**2 - 0.01 * theta**4 + 0.002 * theta**6 - 0.0005 * theta**8)
        pixels, _, _ = cameras.project(0, cameras.origins[0] + [1.0, 0.0, -1.0])
        np.testing.assert_allclose(pixels, [8 + 20 * radius, 6])


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' .*undistort"),
        ({"camera_model": "FISHEYE624"}, "camera_model 'FISHEYE624' .*undistort"),
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "camera_model 'THIN_PRISM_FISHEYE' .*undistort"),
        ({"camera_model": "FOV"}, "camera_model 'FOV' of images/0.png is none of"),
        ({"camera_model": "FULL_OPENCV", "k4": 0.1}, "distortion .* but camera_model FULL_OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "distortion .* but camera_model OPENCV_FISHEYE"),
        ({"camera_model": "SIMPLE_RADIAL_FISHEYE", "k2": 0.1}, "but camera_model SIMPLE_RADIAL_FISHEYE"),
        ({"camera_model": ["PINHOLE"]}, "camera_model .'PINHOLE'. of images/0.png is none of"),
        ({"is_fisheye": True}, "is_fisheye True but camera_model OPENCV: which"),
        ({"camera_model": "OPENCV_FISHEYE", "is_fisheye": False}, "is_fisheye False but camera_model OPENCV_FISHEYE"),
        ({"is_fisheye": "yes"}, "is_fisheye of images/0.png must be true or false, got 'yes'"),
        ({"ftheta_p0": 0, "ftheta_p1": 0.01}, "ftheta_p1 0.01, an f-theta lens"),
        ({"latlong": True}, "latlong True, a panorama"),
        ({"is_latlong": True}, "is_latlong True"),
        ({"equirectangular": True}, "equirectangular True"),
        ({"rolling_shutter": [0, 0, 0.03, 0]}, r"rolling_shutter \[0, 0, 0.03, 0\], a pose for each row"),
        ({"k5": 0.1}, "k5 0.1"),
        ({"distortion_params": [0.1] * 12}, "distortion_params of images/0.png must be k1, k2, k3, k4, p1, p2"),
    ],
)
def test_lenses_that_are_not_read_are_refused_by_name(tmp_path, meta, message):
    folder = _write(tmp_path / "c", meta=meta)
    for read in (load_cameras, load_capture):
        with pytest.raises(ValueError, match=message):
            read(folder)


def test_lens_flags_that_are_off_mean_nothing(tmp_path):
    off = {"is_fisheye": False, "latlong": False, "rolling_shutter": [0, 0, 0, 0], "k5": 0, "distortion_params": None}
    cameras = load_cameras(_write(tmp_path / "c", meta=off))
    assert not cameras.fisheye.any()
    assert cameras.distortion[0].tolist() == [0.03, 0, 0, 0, 0, 0]


def test_field_of_view_of_both_sides(tmp_path):
    angles = {"camera_angle_x": math.pi / 2, "y_fov": 90.0}
    cameras = load_cameras(_write(tmp_path / "c", meta=angles, drop=("fl_x", "fl_y")))
    np.testing.assert_allclose(cameras.intrinsics[0], [8, 6, 8, 6])
    meta = {"camera_model": "OPENCV_FISHEYE", **angles}
    with pytest.raises(ValueError, match="is a fisheye and needs fl_x in pixels; camera_angle_x is a pinhole's"):
        load_cameras(_write(tmp_path / "d", meta=meta, drop=("fl_x", "fl_y")))


def test_a_crop_that_is_not_read_is_named(tmp_path):
    folder = _write(tmp_path / "c", meta={"camera_model": "OPENCV_FISHEYE", "fisheye_crop_radius": 7.0})
    with pytest.warns(UserWarning, match="fisheye_crop_radius is not read"):
        load_cameras(folder)


def test_normalised_origins_fill_the_unit_box_and_the_transform_says_how(tmp_path):
    plain = load_capture(_write(tmp_path / "c"), downscale=1, normalize=False)
    capture = load_capture(tmp_path / "c", downscale=1)
    # origins (1,2,3), (3,2,3), (2,6,3): mean (2, 10/3, 3), farthest coordinate 6 - 10/3 = 8/3
    assert capture.scale_factor == pytest.approx(3 / 8)
    np.testing.assert_allclose(capture.cameras.origins.mean(axis=0), 0, atol=1e-12)
    assert np.abs(capture.cameras.origins).max() == pytest.approx(1)
    moved = plain.cameras.origins @ capture.transform[:3, :3].T + capture.transform[:3, 3]
    np.testing.assert_allclose(moved, capture.cameras.origins, atol=1e-12)
    np.testing.assert_array_equal(capture.cameras.camera_to_world[:, :, :3], plain.cameras.camera_to_world[:, :, :3])


def test_a_normalised_scene_projects_to_the_same_pixels(tmp_path):
    plain = load_capture(_write(tmp_path / "c"), normalize=False)
    capture = load_capture(tmp_path / "c")
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.5 + [1, 2, -2]
    moved = points @ capture.transform[:3, :3].T + capture.transform[:3, 3]
    np.testing.assert_allclose(
        capture.cameras.project(0, moved)[0], plain.cameras.project(0, points)[0], rtol=1e-9, atol=1e-9
    )


def test_images_are_box_filtered_and_belong_to_their_index(tmp_path):
    capture = load_capture(_write(tmp_path / "c"), downscale=4)
    assert (capture.cameras.width, capture.cameras.height) == (4, 3)
    images = capture.images([2, 0])
    assert images.shape == (2, 3, 4, 3)
    assert images.dtype == np.float32
    np.testing.assert_allclose(images[0, ..., 0], 80 / 255, atol=1e-6)
    np.testing.assert_allclose(images[1, ..., 0], 0)
    # four columns of 8 * (0, 1, 2, 3) average to 12
    np.testing.assert_allclose(images[0, 0, :, 1] * 255, [12, 44, 76, 108], atol=0.51)
    assert capture.images([]).shape == (0, 3, 4, 3)
    assert capture.images().shape == (3, 3, 4, 3)


def test_images_are_read_lazily_once_and_cannot_be_spoilt_by_the_caller(tmp_path):
    capture = load_capture(_write(tmp_path / "c"), downscale=4)
    first = capture.images([0])
    before = first.copy()
    shutil.rmtree(tmp_path / "c" / "images")
    first[:] = 9
    np.testing.assert_array_equal(capture.images([0]), before)
    with pytest.raises((ValueError, FileNotFoundError), match=r"1\.png"):
        capture.images([1])
    with pytest.raises(IndexError):
        capture.images([3])


def test_intrinsics_of_a_frame_win_over_shared_ones(tmp_path):
    _write(tmp_path / "c")
    meta = json.loads((tmp_path / "c" / "transforms.json").read_text())
    meta["frames"][1]["fl_x"] = 33.0
    (tmp_path / "c" / "transforms.json").write_text(json.dumps(meta))
    np.testing.assert_array_equal(load_capture(tmp_path / "c", downscale=1).cameras.intrinsics[:, 0], [20, 33, 20])


def test_an_opening_angle_stands_in_for_a_focal_length(tmp_path):
    _write(tmp_path / "c", meta={"camera_angle_x": math.pi / 2}, drop=("fl_x", "fl_y", "cx", "cy", "w", "h"))
    np.testing.assert_allclose(load_capture(tmp_path / "c", downscale=1).cameras.intrinsics[0], [8, 8, 8, 6])


@pytest.mark.parametrize("downscale", [1, 2, 4])
def test_downscaling_keeps_rays(tmp_path, downscale):
    capture = load_capture(_write(tmp_path / "c"), downscale=downscale)
    corner = np.array([4.0, 4.0])
    _, direction = capture.cameras.rays(0, corner / downscale)
    _, wanted = load_capture(tmp_path / "c", downscale=1).cameras.rays(0, corner)
    np.testing.assert_allclose(direction, wanted, atol=1e-12)


def test_without_splits_json_nerfstudio_lists_are_used(tmp_path):
    _write(tmp_path / "c", splits={}, meta={"train_filenames": ["images/1.png"], "test_filenames": ["images/0.png"]})
    capture = load_capture(tmp_path / "c")
    assert {name: indices.tolist() for name, indices in capture.splits.items()} == {"train": [1], "test": [0]}


def test_the_released_naming_is_understood(tmp_path):
    _write(tmp_path / "c", splits={})
    for index, name in enumerate(("frame_00001", "frame_1_00001", "frame_1_00002")):
        (tmp_path / "c" / "images" / f"{index}.png").rename(tmp_path / "c" / "images" / f"{name}.png")
    text = (tmp_path / "c" / "transforms.json").read_text()
    for index, name in enumerate(("frame_00001", "frame_1_00001", "frame_1_00002")):
        text = text.replace(f"images/{index}.png", f"images/{name}.png")
    (tmp_path / "c" / "transforms.json").write_text(text)
    capture = load_capture(tmp_path / "c")
    assert capture.split("train").tolist() == [0]
    assert capture.split("eval").tolist() == [1, 2]


def _bad_pose(value):
    return {"frames": [{"file_path": "images/0.png", "transform_matrix": value}]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drop": ("frames",)}, "has no frames"),
        ({"meta": {"frames": []}}, "has no frames"),
        ({"meta": {"frames": [{"file_path": "images/0.png"}]}}, r"images/0\.png has no transform_matrix"),
        ({"meta": {"frames": [{"transform_matrix": POSES[0]}]}}, "frame 0 .* has no file_path"),
        ({"meta": _bad_pose([[1, 2], [3, 4]])}, r"must have shape \(4, 4\), got \(2, 2\)"),
        ({"meta": _bad_pose([["a"] * 4] * 4)}, "not a matrix of numbers"),
        ({"meta": _bad_pose([[math.nan] * 4] * 4)}, "must be finite"),
        ({"meta": _bad_pose((2 * np.eye(4)).tolist())}, "must hold a rotation"),
        ({"meta": _bad_pose(np.diag([1, 1, -1, 1]).tolist())}, "must hold a rotation"),
        ({"meta": {"frames": [{"file_path": "images/0.png", "transform_matrix": POSES[0]}] * 2}}, "in two frames"),
        ({"meta": {"camera_model": "EQUIRECTANGULAR"}}, "EQUIRECTANGULAR.* none of OPENCV, PINHOLE"),
        ({"meta": {"camera_model": "PINHOLE"}}, "distortion"),
        ({"drop": ("fl_x", "fl_y")}, "neither fl_x nor camera_angle_x"),
        ({"meta": {"fl_x": -1.0}}, "fl_x, fl_y > 0"),
        ({"meta": {"w": 17}}, r"photo images/0\.png is 16 x 12, transforms\.json says 17 x 12"),
        ({"splits": {"first": ["images/9.png"]}}, r"split 'first' names 'images/9\.png', which is in no frame"),
        ({"splits": {"first": []}}, "split 'first' must be a list"),
        ({"splits": {"first": ["images/0.png", "images/0.png"]}}, "twice"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        load_capture(_write(tmp_path / "c", **changes))


def test_photos_that_are_not_there_are_reported_together_or_dropped(tmp_path):
    folder = _write(tmp_path / "c", splits={"one": ["images/0.png", "images/1.png"], "two": ["images/2.png"]})
    whole = load_capture(folder, downscale=1, normalize=False)
    assert whole.dropped == ()
    (folder / "images" / "0.png").unlink()
    with pytest.raises(ValueError, match="missing must be one of error, drop, got 'ignore'"):
        load_capture(folder, missing="ignore")
    with pytest.warns(UserWarning, match=r"1 of the 3 photos .*: images/0\.png; left out"):
        rest = load_capture(folder, downscale=1, normalize=False, missing="drop")
    assert rest.dropped == ("images/0.png",)
    assert rest.names == ("images/1.png", "images/2.png")
    assert {name: indices.tolist() for name, indices in rest.splits.items()} == {"one": [0], "two": [1]}
    np.testing.assert_array_equal(rest.cameras.camera_to_world, whole.cameras.camera_to_world[1:])
    np.testing.assert_array_equal(rest.images(), whole.images([1, 2]))
    (folder / "images" / "2.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"2 of the 3 photos .*: images/0\.png, images/2\.png \(missing="):
        load_capture(folder)
    (folder / "images" / "1.png").unlink()
    with pytest.raises(FileNotFoundError, match="3 of the 3 photos"):
        load_capture(folder, missing="drop")


def test_normalisation_over_named_sweeps(tmp_path):
    folder = _write(tmp_path / "c", splits={"a": ["images/0.png"], "b": ["images/1.png"], "c": ["images/2.png"]})
    capture = load_capture(folder, downscale=1, normalize=("a", "b"))
    # origins (1,2,3), (3,2,3): mean (2,2,3), farthest coordinate 1; the third, (2,6,3), lies 4 away
    np.testing.assert_allclose(capture.cameras.origins, [[-1, 0, 0], [1, 0, 0], [0, 4, 0]], atol=1e-12)
    assert load_capture(folder, normalize="a").scale_factor == 1.0
    for names in (("a", "z"), ()):
        with pytest.raises(ValueError, match=r"normalize names no sweep: .*choose from a, b, c"):
            load_capture(folder, normalize=names)


@pytest.mark.parametrize(("model", "k1", "k2"), [("SIMPLE_RADIAL", 0.03, 0.0), ("RADIAL", 0.03, 0.1)])
def test_radial_lenses_are_understood(tmp_path, model, k1, k2):
    _write(tmp_path / "c", meta={"camera_model": model, "k1": k1, "k2": k2})
    np.testing.assert_array_equal(load_capture(tmp_path / "c").cameras.distortion[0], [k1, k2, 0, 0, 0, 0])
    _write(tmp_path / "d", meta={"camera_model": model, "k1": k1, "p1": 0.1})
    with pytest.raises(ValueError, match="distortion"):
        load_capture(tmp_path / "d")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        load_capture(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"has no transforms\.json"):
        load_capture(tmp_path / "empty")
    _write(tmp_path / "c")
    (tmp_path / "c" / "images" / "1.png").unlink()
    with pytest.raises(
        FileNotFoundError,
        match=r"1 of the 3 photos that transforms\.json names are not in .*: images/1\.png \(missing='drop'",
    ):
        load_capture(tmp_path / "c")


@pytest.mark.parametrize("text", ["{", "[1, 2]", "\x00"])
def test_files_that_are_no_json_objects_are_refused(tmp_path, text):
    _write(tmp_path / "c")
    (tmp_path / "c" / "transforms.json").write_text(text)
    with pytest.raises(ValueError, match=r"transforms\.json (is not JSON|must hold an object)"):
        load_capture(tmp_path / "c")


def test_a_broken_photo_is_named(tmp_path):
    _write(tmp_path / "c")
    photo = tmp_path / "c" / "images" / "1.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)).save(photo)
    whole = photo.read_bytes()
    photo.write_bytes(whole[:-200])  # the header is intact, the pixels are not
    capture = load_capture(tmp_path / "c")
    with pytest.raises(ValueError, match=r"cannot decode .*1\.png"):
        capture.images([1])
    photo.write_bytes(b"not an image")
    with pytest.raises(ValueError, match=r"cannot read photo .*1\.png"):
        load_capture(tmp_path / "c")


def test_transparent_pixels_stand_before_white_or_the_stated_background(tmp_path):
    _write(tmp_path / "c")
    photo = tmp_path / "c" / "images" / "0.png"
    plain = load_capture(tmp_path / "c", downscale=1).images([0])
    alpha = Image.open(photo).convert("RGBA")
    alpha.save(photo)
    np.testing.assert_array_equal(load_capture(tmp_path / "c", downscale=1).images([0]), plain)
    alpha.putpixel((0, 0), (255, 0, 51, 102))  # 0.4 opaque
    alpha.save(photo)
    white = load_capture(tmp_path / "c", downscale=1).images([0])
    np.testing.assert_allclose(white[0, 0, 0], [1.0, 0.6, 0.6 + 0.4 * 0.2], atol=1 / 255)
    np.testing.assert_array_equal(white[0, 1:], plain[0, 1:])
    black = load_capture(tmp_path / "c", downscale=1, background=0.0).images([0])
    np.testing.assert_allclose(black[0, 0, 0], [0.4, 0.0, 0.08], atol=1 / 255)
    with pytest.raises(ValueError, match=r"0\.png has transparent pixels"):
        load_capture(tmp_path / "c", background=None).images([0])
    with pytest.raises(ValueError, match=r"background must be in \[0, 1\] or None, got 255"):
        load_capture(tmp_path / "c", background=255)


def test_unknown_split_lists_the_choices(tmp_path):
    capture = load_capture(_write(tmp_path / "c"))
    with pytest.raises(ValueError, match="no split 'third'; choose from first, second, all"):
        capture.split("third")


def test_downscale_below_one_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"downscale must be >= 1, got 0\.5"):
        load_capture(_write(tmp_path / "c"), downscale=0.5)


@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.exists(), reason="the data folder beside the project is absent")
def test_the_real_capture():
    capture = load_capture(SHARED)
    assert [len(capture.split(f"trajectory_{i}")) for i in (1, 2, 3)] == [24, 29, 44]
    assert (capture.cameras.width, capture.cameras.height) == (126, 94)
    assert np.abs(capture.cameras.origins).max() == pytest.approx(1)
    images = capture.images(capture.split("trajectory_1")[:2])
    assert images.shape == (2, 94, 126, 3)
    assert 0.1 < images.mean() < 0.9


def test_without_pillow_the_extra_is_named(tmp_path, monkeypatch):
    _write(tmp_path / "c")
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[eval\]"):
        load_capture(tmp_path / "c")
