"""COLMAP models written by pycolmap, read as captures; its own projection is the oracle."""

import shutil
import sys

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.captures.colmap import find_model, read_model
from unghost.evaluation.captures.loading import load_cameras, load_capture

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT = 64, 48
PARAMETERS = {
    "SIMPLE_PINHOLE": [60.0, 31.0, 25.0],
    "PINHOLE": [60.0, 61.0, 31.0, 25.0],
    "SIMPLE_RADIAL": [60.0, 31.0, 25.0, 0.05],
    "RADIAL": [60.0, 31.0, 25.0, 0.05, -0.01],
    "OPENCV": [60.0, 61.0, 31.0, 25.0, 0.05, -0.01, 0.002, -0.003],
    "SIMPLE_RADIAL_FISHEYE": [30.0, 31.0, 25.0, 0.05],
    "RADIAL_FISHEYE": [30.0, 31.0, 25.0, 0.05, -0.01],
    "OPENCV_FISHEYE": [30.0, 31.0, 31.0, 25.0, 0.05, -0.01, 0.002, -0.003],
    "FULL_OPENCV": [60.0, 61.0, 31.0, 25.0, 0.05, -0.01, 0.002, -0.003, 0.0, 0.1, 0.0, 0.0],
}


def _pose(number):
    """World to camera, COLMAP's way; the cameras look at the origin's neighbourhood from 4 units away."""
    rotation = pycolmap.Rotation3d(np.array([0.1 * number, -0.2, 0.05 * number]))
    return pycolmap.Rigid3d(rotation, np.array([0.3 * number, 0.1, 4.0]))


def model_of(names_and_models):
    """A reconstruction without points: a camera a photo, so that lenses differ."""
    model = pycolmap.Reconstruction()
    for number, (name, kind) in enumerate(names_and_models, start=1):
        camera = pycolmap.Camera(
            camera_id=number, model=kind, width=WIDTH, height=HEIGHT, params=np.array(PARAMETERS[kind]) + number * 1e-3
        )
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, _pose(number))
    return model


def _write(folder, model, *, text=False, part="0"):
    target = folder / "sparse" / part
    target.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(target)
    for photo in model.images.values():
        path = folder / "images" / photo.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (WIDTH, HEIGHT)).save(path)
    return folder


KINDS = [(f"{number}.png", kind) for number, kind in enumerate(list(PARAMETERS)[:5])]
FISHEYES = [(f"{number}.png", kind) for number, kind in enumerate(PARAMETERS) if kind.endswith("FISHEYE")]


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("kinds", [KINDS, FISHEYES, [("0.png", "PINHOLE"), ("1.png", "OPENCV_FISHEYE")]])
def test_a_point_projects_where_colmap_projects_it(tmp_path, kinds, text):
    model = model_of(kinds)
    capture = load_capture(_write(tmp_path / "c", model, text=text), downscale=1, normalize=False)
    assert capture.names == tuple(f"images/{name}" for name, _ in kinds)
    assert capture.cameras.fisheye.tolist() == [kind.endswith("FISHEYE") for _, kind in kinds]
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (40, 3))
    for index, photo in enumerate(model.images[number] for number in sorted(model.images)):
        expected = np.array([photo.project_point(point) for point in points])
        pixels, depth, _ = capture.cameras.project(index, points)
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-9)
        assert (depth > 2).all()


def test_poses_and_lenses_are_those_of_the_model(tmp_path):
    model = model_of(KINDS)
    cameras = load_capture(_write(tmp_path / "c", model), downscale=1, normalize=False).cameras
    for index, number in enumerate(sorted(model.images)):
        photo = model.images[number]
        np.testing.assert_allclose(cameras.origins[index], photo.projection_center(), atol=1e-12)
        np.testing.assert_allclose(-cameras.camera_to_world[index, :, 2], photo.viewing_direction(), atol=1e-12)
    np.testing.assert_allclose(cameras.intrinsics[0], [60.001, 60.001, 31.001, 25.001])  # SIMPLE_PINHOLE
    np.testing.assert_allclose(cameras.intrinsics[4], [60.005, 61.005, 31.005, 25.005])  # OPENCV
    np.testing.assert_allclose(cameras.distortion[4], [0.055, -0.005, 0, 0, 0.007, 0.002], atol=1e-12)
    np.testing.assert_allclose(cameras.distortion[2], [0.053, 0, 0, 0, 0, 0], atol=1e-12)


def test_the_model_itself_and_photos_elsewhere_are_understood(tmp_path):
    folder = _write(tmp_path / "c", model_of(KINDS))
    whole = load_capture(folder)
    assert load_capture(folder / "sparse" / "0").names == whole.names
    moved = shutil.move(folder / "images", tmp_path / "photos")
    with pytest.raises(FileNotFoundError, match="5 of the 5 photos that the COLMAP model 0 names are not in"):
        load_capture(folder)
    elsewhere = load_capture(folder, photos=moved)
    assert elsewhere.names == tuple(name for name, _ in KINDS)
    assert elsewhere.images([0]).shape == (1, 6, 8, 3)
    np.testing.assert_array_equal(elsewhere.cameras.camera_to_world, whole.cameras.camera_to_world)
    cameras = load_cameras(folder)
    assert (len(cameras), cameras.width, cameras.height) == (5, WIDTH, HEIGHT)


def test_photos_in_two_folders_are_two_sweeps(tmp_path):
    names = [("walk/1.png", "PINHOLE"), ("back/1.png", "PINHOLE"), ("walk/2.png", "PINHOLE")]
    capture = load_capture(_write(tmp_path / "c", model_of(names)))
    assert {name: [capture.names[i] for i in found] for name, found in capture.splits.items()} == {
        "back": ["images/back/1.png"],
        "walk": ["images/walk/1.png", "images/walk/2.png"],
    }


def test_renders_are_scored_against_a_model_s_photos(tmp_path, capsys):
    from unghost import cli

    folder = tmp_path / "model"
    _write(folder, model_of([(f"{sweep}/{name}.png", "PINHOLE") for sweep in ("train", "eval") for name in "ab"]))
    (tmp_path / "renders").mkdir()
    for name in "ab":
        shutil.copy(folder / "images" / "eval" / f"{name}.png", tmp_path / "renders")
    words = [tmp_path / "renders", "--gt", folder, "--out", tmp_path / "page"]
    assert cli.main(["evaluate", *map(str, words)]) == 0
    assert "1 method, 2 views, convention whole_image" in capsys.readouterr().out


def test_transforms_json_wins_over_a_model_beside_it(tmp_path):
    folder = _write(tmp_path / "c", model_of(KINDS))
    (folder / "transforms.json").write_text("{}")
    with pytest.raises(ValueError, match=r"transforms\.json in .* has no frames"):
        load_capture(folder)


def test_of_parts_that_were_not_joined_the_largest_is_read_with_a_warning(tmp_path):
    folder = _write(tmp_path / "c", model_of(KINDS[:2]))
    _write(folder, model_of(KINDS[2:]), part="1")
    with pytest.warns(UserWarning, match=r"did not join \(0: 2 photos, 1: 3 photos\)"):
        capture = load_capture(folder)
    assert capture.names == ("images/2.png", "images/3.png", "images/4.png")
    assert find_model(tmp_path) is None


def _of_one(tmp_path, kind, params):
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model=kind, width=WIDTH, height=HEIGHT, params=np.array(params))
    model.add_camera_with_trivial_rig(camera)
    model.add_image_with_trivial_frame(pycolmap.Image(name="a.png", camera_id=1, image_id=1), _pose(1))
    return camera, _write(tmp_path / kind, model)


@pytest.mark.parametrize(
    ("kind", "params", "words"),
    [
        ("FULL_OPENCV", PARAMETERS["FULL_OPENCV"], "FULL_OPENCV with k4, k5, k6 other than 0"),
        ("FOV", [60.0, 61.0, 31.0, 25.0, 0.9], "FOV, none of SIMPLE_PINHOLE, .*OPENCV_FISHEYE"),
        ("THIN_PRISM_FISHEYE", [30.0, 30.0, 31.0, 25.0, *[0.01] * 8], "THIN_PRISM_FISHEYE, none of SIMPLE_PINHOLE"),
    ],
)
def test_a_lens_that_is_not_read_is_refused(tmp_path, kind, params, words):
    with pytest.raises(ValueError, match=rf"camera 1 of .* is a {words}.*image_undistorter"):
        load_capture(_of_one(tmp_path, kind, params)[1])


def test_full_opencv_that_does_not_divide_is_opencv(tmp_path):
    _, folder = _of_one(tmp_path, "FULL_OPENCV", [60.0, 61.0, 31.0, 25.0, 0.05, -0.01, 0.002, -0.003, 0.02, 0, 0, 0])
    cameras = load_cameras(folder)
    assert cameras.distortion.tolist() == [[0.05, -0.01, 0.02, 0, 0.002, -0.003]]
    theirs = pycolmap.Reconstruction(folder / "sparse" / "0").images[1]
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (20, 3))
    expected = [theirs.project_point(point) for point in points]
    np.testing.assert_allclose(cameras.project(0, points)[0], expected, atol=1e-9)


def test_a_lens_that_no_photo_has_is_nobody_s_concern(tmp_path):
    model = model_of(KINDS)
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=9, model="FOV", width=WIDTH, height=HEIGHT, params=np.array([60.0, 61, 31, 25, 0.9]))
    )
    assert len(load_cameras(_write(tmp_path / "c", model))) == 5


def test_portrait_and_landscape_in_one_model(tmp_path):
    model = pycolmap.Reconstruction()
    sizes = {1: (64, 48), 2: (48, 64)}
    for number, (width, height) in sizes.items():
        params = np.array([60.0, width / 2, height / 2])
        camera = pycolmap.Camera(camera_id=number, model="SIMPLE_PINHOLE", width=width, height=height, params=params)
        model.add_camera_with_trivial_rig(camera)
    for number in range(1, 5):
        image = pycolmap.Image(name=f"{number}.png", camera_id=1 + number % 2, image_id=number)
        model.add_image_with_trivial_frame(image, _pose(number))
    folder = _write(tmp_path / "c", model)
    for number in range(1, 5):
        Image.new("RGB", sizes[1 + number % 2], (number * 10, 0, 0)).save(folder / "images" / f"{number}.png")
    capture = load_capture(folder, downscale=2, normalize=False)
    assert capture.cameras.sizes.tolist() == [[24, 32], [32, 24]] * 2
    assert capture.cameras.intrinsics[:2].tolist() == [[30, 30, 12, 16], [30, 30, 16, 12]]
    assert capture.images([0, 2]).shape == (2, 32, 24, 3)
    assert capture.images([3]).shape == (1, 24, 32, 3)
    assert capture.images([1])[0, 0, 0, 0] == pytest.approx(20 / 255)
    with pytest.raises(ValueError, match=r"differ in size \(24 x 32, 32 x 24\); ask for one size at a time.*by_size"):
        capture.images()
    assert load_cameras(folder).sizes.tolist() == [[48, 64], [64, 48]] * 2
    Image.new("RGB", (64, 48)).save(folder / "images" / "1.png")
    with pytest.raises(ValueError, match=r"photo images/1\.png is 64 x 48, the COLMAP model 0 says 48 x 64"):
        load_capture(folder)


def _cut(name, count):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:count])


@pytest.mark.parametrize(
    "spoil",
    [
        _cut("images.bin", 100),
        _cut("cameras.bin", 30),
        lambda folder: (folder / "images.bin").write_bytes(b"\xff" * 500),
        lambda folder: (folder / "cameras.bin").write_bytes(b"\xff" * 500),
        lambda folder: (folder / "images.bin").write_bytes(b""),
    ],
)
def test_broken_models_are_refused(tmp_path, spoil):
    folder = _write(tmp_path / "c", model_of(KINDS))
    spoil(folder / "sparse" / "0")
    with pytest.raises(ValueError, match=r"read_model: .*0 (is no COLMAP model that can be read|has no photo)"):
        load_capture(folder)


def test_points_are_not_read(tmp_path):
    """A file of points cut short takes pycolmap's reader, and the process, down."""
    folder = _write(tmp_path / "c", model_of(KINDS))
    (folder / "sparse" / "0" / "points3D.bin").write_bytes(b"\xff" * 11)
    assert len(load_capture(folder)) == 5
    (folder / "sparse" / "0" / "points3D.bin").unlink()
    assert len(load_capture(folder)) == 5


def test_what_is_no_model_is_refused(tmp_path):
    with pytest.raises(ValueError, match="not a COLMAP model"):
        read_model(tmp_path)


def test_pycolmaps_log_level_is_left_alone(tmp_path):
    before = pycolmap.logging.minloglevel
    load_capture(_write(tmp_path / "c", model_of(KINDS)))
    assert pycolmap.logging.minloglevel == before


def test_without_pycolmap_the_extra_is_named(tmp_path, monkeypatch):
    folder = _write(tmp_path / "c", model_of(KINDS))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[capture\]"):
        load_capture(folder)


@pytest.mark.parametrize("text", [False, True])
def test_names_with_spaces_run_to_the_end_of_the_line(tmp_path, text):
    names = ["A-DJI_V_map (1).png", "A-DJI_V_map (2).png", "walk 1/a  b.png"]
    folder = _write(tmp_path / "c", model_of([(name, "PINHOLE") for name in names]), text=text)
    capture = load_capture(folder, downscale=1, normalize=False)
    assert capture.names == tuple(f"images/{name}" for name in names)
    binary = load_capture(_write(tmp_path / "d", model_of([(name, "PINHOLE") for name in names])), normalize=False)
    np.testing.assert_allclose(capture.cameras.camera_to_world, binary.cameras.camera_to_world, atol=1e-12)


def test_text_models_of_other_programs_are_read(tmp_path):
    """RealityScan's exponents of three digits and line ends, a byte order mark, comments between, points or none."""
    folder = _write(tmp_path / "c", model_of([("a b.png", "PINHOLE"), ("c.png", "PINHOLE")]), text=True)
    wanted = load_capture(folder, normalize=False)
    file = folder / "sparse" / "0" / "images.txt"
    photos = [line.split(None, 9) for line in file.read_text().splitlines() if line.rstrip().endswith(".png")]
    lines = ["# made elsewhere", ""]
    for number, (key, *values, camera, name) in enumerate(photos):
        numbers = [f"{float(value):.15e}".replace("e-0", "e-00").replace("e+0", "e+00") for value in values]
        lines += [" ".join([key, *numbers, camera, name]), "1.5 2.5 -1" if number else "", "# between"]
    file.write_bytes(("\ufeff" + "\r\n".join(lines)).encode())
    found = load_capture(folder, normalize=False)
    assert found.names == wanted.names == ("images/a b.png", "images/c.png")
    np.testing.assert_allclose(found.cameras.camera_to_world, wanted.cameras.camera_to_world, atol=1e-12)
    file.write_text("1 1 0 0 0 0 0 0 1\n\n")
    with pytest.raises(ValueError, match=r"images\.txt has a line that is no photo: '1 1 0 0 0 0 0 0 1'"):
        load_capture(folder)


def test_smaller_copies_of_a_model_s_photos_will_do(tmp_path):
    """The layout of mip-NeRF 360 with images_4 alone: the cameras are those of the full size."""
    folder = _write(tmp_path / "c", model_of([("a.JPG", "PINHOLE"), ("b.JPG", "PINHOLE")]))
    whole = load_capture(folder, downscale=1, normalize=False)
    shutil.rmtree(folder / "images")
    for name in "ab":
        (folder / "images_4").mkdir(exist_ok=True)
        Image.new("RGB", (WIDTH // 4, HEIGHT // 4)).save(folder / "images_4" / f"{name}.JPG")
    for options in ({}, {"photos": folder / "images_4"}):
        found = load_capture(folder, downscale=1, normalize=False, **options)
        np.testing.assert_allclose(found.cameras.intrinsics, whole.cameras.intrinsics / 4)
        assert found.names == whole.names
