import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unghost.core.cameras import Cameras, look_at
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.points import read_points, read_tracks

CAPTURES = Path(__file__).resolve().parents[4] / "shared" / "data" / "captures"


def binary(points):
    """``points3D.bin`` by its published layout: (id, xyz, error, [(image, keypoint)])."""
    data = struct.pack("<Q", len(points))
    for number, xyz, error, track in points:
        data += struct.pack("<Q3d3BdQ", number, *xyz, 9, 9, 9, error, len(track))
        data += b"".join(struct.pack("<II", *entry) for entry in track)
    return data


POINTS = [(7, (0.0, 0.5, -1.0), 0.4, [(3, 0), (1, 12)]), (2, (1.0, 0.0, 0.0), -1.0, [(3, 1), (3, 2), (9, 4)])]
TEXT = "# points\n7 0 .5 -1 9 9 9 .4 3 0 1 12\n\n2 1 0 0 9 9 9 -1 3 1 3 2 9 4\n"


@pytest.mark.parametrize("name", ["points3D.bin", "points3D.txt"])
def test_both_formats_say_the_same(tmp_path, name):
    file = tmp_path / name
    file.write_bytes(binary(POINTS) if name.endswith(".bin") else b"\xef\xbb\xbf" + TEXT.replace("\n", "\r\n").encode())
    tracks = read_tracks(file)
    assert tracks.xyz.tolist() == [[0.0, 0.5, -1.0], [1.0, 0.0, 0.0]]
    assert tracks.error[0] == 0.4
    assert np.isnan(tracks.error[1])  # COLMAP's -1
    assert tracks.point.tolist() == [0, 0, 1, 1, 1]
    assert tracks.image.tolist() == [3, 1, 3, 3, 9]
    assert tracks.number.tolist() == [7, 2]


def test_a_file_that_is_cut_anywhere_is_refused(tmp_path):
    data, file = binary(POINTS), tmp_path / "points3D.bin"
    for length in range(len(data)):
        file.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"cut short|more than its"):
            read_tracks(file)
    file.write_bytes(data + b"\0")
    with pytest.raises(ValueError, match="1 bytes after its 2 points"):
        read_tracks(file)
    file.write_bytes(struct.pack("<Q", 1 << 60))
    with pytest.raises(ValueError, match="more than its 8 bytes can hold"):
        read_tracks(file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0 9 9 9\n", "line 1 of .* got 7 words"),
        ("1 0 0 0 9 9 9 .4 3\n", "got 9 words"),
        ("1 0 0 zero 9 9 9 .4\n", "holds what is no number"),
        ("one 0 0 0 9 9 9 .4\n", "holds what is no number"),
        ("1 0 0 nan 9 9 9 .4\n", "not finite"),
        ("1 0 0 0 9 9 9 .4 3.5 1\n", "holds what is no number"),
    ],
)
def test_text_that_is_no_point_is_refused(tmp_path, text, message):
    (tmp_path / "points3D.txt").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_tracks(tmp_path / "points3D.txt")


def test_no_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file"):
        read_tracks(tmp_path / "points3D.bin")


@pytest.fixture
def model(tmp_path):
    """A text model of three photos, one in a folder and with a space in its name."""
    pytest.importorskip("pycolmap")
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 100 80 90 90 50 40\n", encoding="utf-8")
    rows = [(1, "b.jpg"), (3, "walk/a.jpg"), (9, "c.jpg")]
    lines = "".join(f"{number} 1 0 0 0 0 0 {number} 1 {name}\n\n" for number, name in rows)
    (tmp_path / "images.txt").write_text(lines, encoding="utf-8")
    (tmp_path / "points3D.txt").write_text(TEXT, encoding="utf-8")
    return tmp_path


def cameras(count):
    origins = np.stack([np.full(count, 3.0), np.arange(count), np.zeros(count)], axis=1)
    return Cameras.create(look_at(origins, np.zeros((count, 3))), np.array([90.0, 90.0, 50.0, 40.0]), 100, 80)


def test_photos_are_found_by_name_and_others_are_left_out(model):
    points = read_points(model, ["images/walk/a.jpg", "images/b.jpg"], cameras(2))
    assert len(points) == 2
    assert points.point.tolist() == [0, 0, 1]
    assert points.camera.tolist() == [0, 1, 0]  # the photo c.jpg is not asked for; a repeated observation counts once
    assert np.isfinite(points.uncertainty[0])
    assert points.uncertainty[1] == np.inf


def test_the_transform_of_a_capture_is_applied(model):
    transform = np.diag([2.0, 2.0, 2.0, 1.0])
    transform[:3, 3] = [1.0, 0.0, -1.0]
    moved = read_points(model, ["b.jpg"], cameras(1), transform=transform)
    assert moved.xyz.tolist() == [[1.0, 1.0, -3.0], [3.0, 0.0, -1.0]]


def test_two_photos_of_one_name_are_told_apart_or_not_used(model):
    points = read_points(model, ["x/b.jpg", "y/b.jpg", "walk/a.jpg"], cameras(3))
    assert sorted(set(points.camera.tolist())) == [2]


def test_a_track_of_an_unknown_image_is_refused(model):
    (model / "points3D.txt").write_text("1 0 0 0 9 9 9 .4 77 0\n", encoding="utf-8")
    with pytest.raises(ValueError, match="name 1 images that it lacks, first 77"):
        read_points(model, ["b.jpg"], cameras(1))


@pytest.mark.shared_data
@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no shared data")
@pytest.mark.parametrize("name", ["snowmiku_plush", "skull_flash"])
def test_real_points_project_into_the_photos_that_observed_them(name):
    pycolmap = pytest.importorskip("pycolmap")

    capture = load_capture(CAPTURES / name)
    folder = CAPTURES / name / "sparse" / "0"
    points = read_points(folder, capture.names, capture.cameras, transform=capture.transform)
    assert points.share_in_view(capture.cameras) > 0.999
    model = pycolmap.Reconstruction(folder)
    assert len(points) == len(model.points3D)
    assert len(read_tracks(folder / "points3D.bin").point) == model.compute_num_observations()


@pytest.fixture
def capture_folder(tmp_path):
    """A COLMAP model of two photos that look along +Z at points before them, and the photos."""
    pytest.importorskip("pycolmap")
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (tmp_path / "images").mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 32 24 30 30 16 12\n", encoding="utf-8")
    rows = ["1 1 0 0 0 0 0 0 1 a b.png\n\n", "2 1 0 0 0 -0.5 0 0 1 c.png\n\n"]  # the second camera is at x = .5
    (model / "images.txt").write_text("".join(rows), encoding="utf-8")
    (model / "points3D.txt").write_text("5 0 0 4 9 9 9 .5 1 0 2 0\n6 0.2 0.1 5 9 9 9 .5 1 1\n", encoding="utf-8")
    for name in ("a b.png", "c.png"):
        Image.new("RGB", (32, 24)).save(tmp_path / "images" / name)
    return tmp_path


def test_a_capture_has_the_points_of_its_model(capture_folder):
    capture = load_capture(capture_folder, downscale=2, normalize=True)
    points = capture.points
    assert points.xyz[0].tolist() == (capture.transform @ [0, 0, 4, 1])[:3].tolist()
    assert points.views().tolist() == [2, 1]
    assert points.share_in_view(capture.cameras) == 1.0
    assert points is capture.points


def test_beside_transforms_json_they_are_moved_with_it(capture_folder):
    from unghost.evaluation.captures.transforms import write_transforms

    plain = load_capture(capture_folder, downscale=1, normalize=False)
    turn = np.array([[0.0, 1, 0, 3], [1, 0, 0, 0], [0, 0, -1, 1]])
    poses = turn[:, :3] @ plain.cameras.camera_to_world
    poses[:, :, 3] = 2 * (poses[:, :, 3] + turn[:, 3])
    moved = Cameras.create(poses, plain.cameras.intrinsics, 32, 24)
    extra = {"applied_transform": turn.tolist(), "applied_scale": 2.0}
    write_transforms(capture_folder / "transforms.json", moved, plain.names, {}, **extra)
    capture = load_capture(capture_folder, downscale=1, normalize=False)
    np.testing.assert_allclose(capture.points.xyz[0], 2 * (turn @ [0, 0, 4, 1]))
    assert capture.points.share_in_view(capture.cameras) == 1.0
    meta = json.loads((capture_folder / "transforms.json").read_text())
    del meta["applied_transform"]
    (capture_folder / "transforms.json").write_text(json.dumps(meta))
    with pytest.warns(UserWarning, match=r"Capture.points: only 0% of the observations project"):
        _ = load_capture(capture_folder, downscale=1, normalize=False).points


def test_without_a_model_or_its_points_the_error_says_what_is_wanted(capture_folder):
    (capture_folder / "sparse" / "0" / "points3D.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"a COLMAP model without points .* run unghost points"):
        _ = load_capture(capture_folder).points
    (capture_folder / "sparse" / "0" / "points3D.txt").write_text("# Number of points: 0\n\n", encoding="utf-8")
    with pytest.raises(FileNotFoundError, match="a COLMAP model without points"):
        _ = load_capture(capture_folder).points
    other = capture_folder / "other"
    other.mkdir()
    Image.new("RGB", (32, 24)).save(other / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    lens = {"w": 32, "h": 24, "fl_x": 30, "fl_y": 30, "cx": 16, "cy": 12}
    (other / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    with pytest.raises(FileNotFoundError, match=r"has no COLMAP model \(sparse/0\) and no ply_file_path in transforms"):
        _ = load_capture(other).points


@pytest.mark.parametrize("place", ["", "sparse", "sparse/0", "colmap/sparse/0", "colmap/sparse"])
@pytest.mark.parametrize("ending", ["txt", "bin"])
def test_text_and_binary_models_are_read_wherever_the_poses_are(capture_folder, place, ending):
    import pycolmap

    source, target = capture_folder / "sparse" / "0", capture_folder / "elsewhere" / place
    target.mkdir(parents=True, exist_ok=True)
    (target if place == "" else capture_folder / "elsewhere").joinpath("images").mkdir(exist_ok=True)
    for path in (capture_folder / "images").iterdir():
        path.rename(capture_folder / "elsewhere" / "images" / path.name.replace(" ", ""))
    text = (source / "images.txt").read_text(encoding="utf-8").replace("a b.png", "ab.png")
    (source / "images.txt").write_text(text.replace("\n\n", "\n1 1 5 2 2 6\n"), encoding="utf-8")
    points = "5 0 0 4 9 9 9 .5 1 0 2 0\n6 0.2 0.1 5 9 9 9 .5 1 1 2 1\n"
    (source / "points3D.txt").write_text(points, encoding="utf-8")
    model = pycolmap.Reconstruction(source)
    (model.write_text if ending == "txt" else model.write_binary)(target)
    assert {path.suffix for path in target.glob("points3D*")} == {f".{ending}"}
    capture = load_capture(capture_folder / "elsewhere", downscale=1, normalize=False)
    order = np.argsort(capture.points.xyz[:, 0])
    np.testing.assert_allclose(capture.points.xyz[order], [[0, 0, 4], [0.2, 0.1, 5]])
    assert capture.points.views().tolist() == [2, 2]
    assert capture.points.share_in_view(capture.cameras) == 1.0


POINTS_IN_VIEW = np.array([[0.0, 0.0, -4.0], [0.5, 0.2, -5.0], [-0.3, 0.1, -3.0]])  # OpenGL cameras look along -Z


def write_ply(path, xyz, *, order="<"):
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = ["ply", f"format {name} 1.0", f"element vertex {len(xyz)}", *(f"property float {axis}" for axis in "xyz")]
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + np.asarray(xyz).astype(f"{order}f4").tobytes())


@pytest.fixture
def ply_folder(tmp_path):
    """A transforms.json of two photos that names a PLY of points before them."""

    def make(folder=tmp_path, **extra):
        folder.mkdir(exist_ok=True)
        frames = []
        for number, name in enumerate(("a.png", "b.png")):
            Image.new("RGB", (32, 24)).save(folder / name)
            pose = np.eye(4)
            pose[0, 3] = 0.4 * number
            frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        lens = {"w": 32, "h": 24, "fl_x": 20, "fl_y": 20, "cx": 16, "cy": 12}
        meta = {**lens, "ply_file_path": "sparse.ply", **extra, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(meta))
        write_ply(folder / "sparse.ply", POINTS_IN_VIEW)
        return folder

    return make


@pytest.mark.parametrize("normalize", [True, False])
def test_ply_file_path_gives_points_without_tracks(ply_folder, normalize):
    capture = load_capture(ply_folder(), downscale=1, normalize=normalize)
    points = capture.points
    expected = POINTS_IN_VIEW @ capture.transform[:3, :3].T + capture.transform[:3, 3]
    np.testing.assert_allclose(points.xyz, expected, atol=1e-6)
    assert len(points.point) == len(points.camera) == 0
    assert points.about == "3 points without tracks: they support density near them and give no sight lines"
    assert np.isinf(points.uncertainty).all()


def test_points_without_tracks_support_and_cross_nothing(ply_folder):
    from unghost.core.sight_lines import SightLines

    capture = load_capture(ply_folder(), downscale=1, normalize=False)
    lines = SightLines.build(capture.points, capture.cameras, aabb=[[-1, -1, -6], [1, 1, -1]], pitch=0.25)
    assert len(lines) == 0
    assert not lines.crossing_count.any()
    assert (lines.support(POINTS_IN_VIEW) > 0).all()
    assert not lines.support(np.array([[0.9, -0.9, -1.5]])).any()


def test_a_ply_is_moved_as_nerfstudio_does(ply_folder):
    """Its points are where ``applied_transform`` has put them; ``applied_scale`` alone is made."""
    turn = np.array([[0.0, 1, 0, 3], [1, 0, 0, 0], [0, 0, -1, 1]])
    folder = ply_folder(applied_transform=turn.tolist(), applied_scale=0.5)
    np.testing.assert_allclose(
        load_capture(folder, downscale=1, normalize=False).points.xyz, 0.5 * POINTS_IN_VIEW, atol=1e-6
    )


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_byte_orders_and_paths_of_other_machines(ply_folder, order):
    folder = ply_folder(ply_file_path="C:\\work\\room\\sparse.ply")
    write_ply(folder / "sparse.ply", POINTS_IN_VIEW, order=order)
    np.testing.assert_allclose(load_capture(folder, downscale=1, normalize=False).points.xyz, POINTS_IN_VIEW, atol=1e-6)


def test_a_model_with_tracks_wins_over_a_ply(capture_folder):
    from unghost.evaluation.captures.transforms import write_transforms

    plain = load_capture(capture_folder, downscale=1, normalize=False)
    write_transforms(
        capture_folder / "transforms.json", plain.cameras, plain.names, {}, ply_file_path="sparse/0/points3D.ply"
    )
    write_ply(capture_folder / "sparse" / "0" / "points3D.ply", [[0.0, 0.0, 4.0]])
    assert load_capture(capture_folder, downscale=1, normalize=False).points.views().tolist() == [2, 1]
    (capture_folder / "sparse" / "0" / "points3D.txt").write_text("# none\n", encoding="utf-8")
    points = load_capture(capture_folder, downscale=1, normalize=False).points
    assert points.xyz.tolist() == [[0.0, 0.0, 4.0]]
    assert len(points.point) == 0


def test_a_ply_that_is_missing_or_broken_is_named(ply_folder):
    folder = ply_folder()
    whole = (folder / "sparse.ply").read_bytes()
    (folder / "sparse.ply").unlink()
    capture = load_capture(folder, downscale=1)  # nothing is read before it is asked for
    with pytest.raises(
        FileNotFoundError, match=r"ply_file_path of transforms\.json names 'sparse\.ply', which must be"
    ):
        _ = capture.points
    for content, message in [
        (whole[:-4], r"sparse\.ply is not a PLY file that can be read: its body is 4 bytes shorter"),
        (b"", "no PLY header"),
        (whole.replace(b"float y", b"float v"), "lack the properties y"),
        (whole[:-4] + np.float32(np.nan).tobytes(), r"\(ply_file_path\) has 1 of 3 points that are not finite"),
    ]:
        (folder / "sparse.ply").write_bytes(content)
        with pytest.raises(ValueError, match=message):
            _ = capture.points
    write_ply(folder / "sparse.ply", np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"\(ply_file_path\) has no points"):
        _ = capture.points


@pytest.mark.parametrize("value", [7, "", ["sparse.ply"]])
def test_a_ply_file_path_that_is_no_path_is_refused(ply_folder, value):
    with pytest.raises(ValueError, match=r"ply_file_path of transforms\.json in .* must be a path, got"):
        _ = load_capture(ply_folder(ply_file_path=value), downscale=1).points


def test_a_ply_in_another_frame_is_warned_of(ply_folder):
    folder = ply_folder()
    write_ply(folder / "sparse.ply", -POINTS_IN_VIEW)
    with pytest.warns(UserWarning, match=r"Capture\.points: only 0% of the points are in view of any camera"):
        _ = load_capture(folder, downscale=1).points


def test_without_pycolmap_a_model_names_the_extra_and_a_ply_needs_none(
    capture_folder, ply_folder, tmp_path, monkeypatch
):
    import sys

    capture, other = load_capture(capture_folder, downscale=1), load_capture(ply_folder(tmp_path / "ply"), downscale=1)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[capture\]"):
        _ = capture.points
    assert len(other.points) == 3


def test_points_of_a_sweep_whose_poses_have_changed_since_are_warned_of(capture_folder):
    from unghost.evaluation.captures.points import points_folder

    stored = points_folder(capture_folder, "walk")
    stored.mkdir(parents=True)
    for path in (capture_folder / "sparse" / "0").iterdir():
        text = path.read_text(encoding="utf-8")
        for name in ("a b.png", "c.png"):
            text = text.replace(name, f"images/{name}")
        (stored / path.name).write_text(text.replace("5 0 0 4 9", "5 0 0 -4 9").replace("6 0.2 0.1 5", "6 9 0.1 5"))
    names = load_capture(capture_folder, downscale=1).names
    capture = load_capture(capture_folder, downscale=1, splits={"walk": names})
    with pytest.warns(UserWarning, match=r"Capture\.points_of: only 0% of the observations project"):
        points = capture.points_of("walk")
    assert points.views().tolist() == [2, 1]
