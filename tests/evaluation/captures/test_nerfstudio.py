"""What nerfstudio 1.1.5 reads: its rules for lists and lenses are spelled out here, and our reader agrees."""

import json

import numpy as np
import pytest
from PIL import Image

from unghost.core.cameras import Cameras
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.nerfstudio import write_nerfstudio
from unghost.evaluation.captures.transforms import write_transforms

NAMES = ("images/frame_00001.png", "images/frame_1_00001.png", "images/frame_00002.png", "images/frame_1_00002.png")


def _poses(count):
    poses = np.tile(np.eye(4)[:3], (count, 1, 1))
    poses[:, :, 3] = np.random.default_rng(0).normal(size=(count, 3))
    return poses


def released(folder, names=NAMES, *, lenses=None):
    """A capture named as the released ones are, without lists; 16 x 12 photos."""
    frames = []
    for number, (name, pose) in enumerate(zip(names, _poses(len(names)))):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (16, 12), (number, 0, 0)).save(folder / name)
        own = {} if lenses is None else {"fl_x": lenses[number]}
        frames.append({"file_path": f"./{name}", **own, "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]})
    shared = {"fl_x": 20.0, "fl_y": 21.0, "cx": 8.0, "cy": 6.5, "k1": 0.03, "p2": 0.001, "k4": 1e-5}
    (folder / "transforms.json").write_text(json.dumps({"w": 16, "h": 12, **shared, "frames": frames}))
    return folder


def whole(folder, **options):
    return load_capture(folder, downscale=1, normalize=False, **options)


def as_nerfstudio_reads(folder, split):
    """Sorted by name; all three lists or none; a shared lens wins over a frame's own, which must then be complete."""
    meta = json.loads((folder / "transforms.json").read_text())
    frames = sorted(meta["frames"], key=lambda frame: folder / frame["file_path"])
    listed = {folder / name for name in meta[f"{split}_filenames"]}
    assert listed <= {folder / frame["file_path"] for frame in frames}
    chosen = [frame for frame in frames if folder / frame["file_path"] in listed]
    bends = ("k1", "k2", "k3", "k4", "p1", "p2")
    lens = np.array(
        [[meta[key] if key in meta else frame[key] for key in ("fl_x", "fl_y", "cx", "cy")] for frame in chosen]
    )
    source = [meta if any(key in meta for key in ("k1", "k2", "k3", "p1", "p2")) else frame for frame in chosen]
    bend = np.array([[each.get(key, 0.0) for key in bends] for each in source])
    assert meta["camera_model"] == "OPENCV"
    assert all((folder / frame["file_path"]).is_file() for frame in chosen)
    origins = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    return (
        [frame["file_path"] for frame in chosen],
        np.array([f["transform_matrix"] for f in chosen]),
        lens,
        bend,
        origins,
    )


@pytest.mark.parametrize("lenses", [None, [20.0, 20.0, 22.0, 24.0]])
@pytest.mark.parametrize("photos", ["copy", "link"])
def test_a_released_capture_becomes_one_that_stock_nerfstudio_splits(tmp_path, lenses, photos):
    capture = whole(released(tmp_path / "in", lenses=lenses))
    out = tmp_path / "out"
    write_nerfstudio(capture, out, train=capture.split("train"), evaluation=capture.split("eval"), photos=photos)
    for split, indices in (("train", [0, 2]), ("val", [1, 3]), ("test", [1, 3])):
        names, poses, lens, bend, origins = as_nerfstudio_reads(out, split)
        assert names == [NAMES[index] for index in indices]
        np.testing.assert_array_equal(poses[:, :3], capture.cameras.camera_to_world[indices])
        np.testing.assert_array_equal(lens, capture.cameras.intrinsics[indices])
        np.testing.assert_array_equal(bend, capture.cameras.distortion[indices])
        assert len(origins) == 4
    again = whole(out)
    assert {name: [again.names[k] for k in found] for name, found in again.splits.items()} == {
        "train": [NAMES[0], NAMES[2]],
        "eval": [NAMES[1], NAMES[3]],
    }
    np.testing.assert_array_equal(again.images([again.names.index(NAMES[3])])[0, 0, 0] * 255, [3, 0, 0])
    assert (out / NAMES[0]).is_symlink() == (photos == "link")


def test_photos_of_neither_sweep_do_not_enter_the_normalisation(tmp_path):
    capture = whole(released(tmp_path / "in"))
    write_nerfstudio(capture, tmp_path / "out", train=[0], evaluation=[3])
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == [
        "frame_00001.png",
        "frame_1_00002.png",
    ]
    origins = as_nerfstudio_reads(tmp_path / "out", "train")[-1]
    np.testing.assert_array_equal(origins, capture.cameras.origins[[0, 3]])
    assert np.abs(load_capture(tmp_path / "out").cameras.origins).max() == pytest.approx(1)


def test_files_called_alike_get_their_folders_names(tmp_path):
    names = ("images/walk/1.png", "images/back/1.png", "2.png", "images/back/3.png")
    capture = whole(released(tmp_path / "in", names))
    write_nerfstudio(capture, tmp_path / "out", train=[0, 2], evaluation=[1, 3])
    train, *_ = as_nerfstudio_reads(tmp_path / "out", "train")
    scored, *_ = as_nerfstudio_reads(tmp_path / "out", "test")
    assert (train, scored) == (["images/2.png", "images/walk_1.png"], ["images/back_1.png", "images/back_3.png"])


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path):
    folder = released(tmp_path / "in")
    capture, out = whole(folder), tmp_path / "out"
    with pytest.raises(ValueError, match="both sweeps need photos, got 1 and 0"):
        write_nerfstudio(capture, out, train=[0], evaluation=[])
    with pytest.raises(ValueError, match="photos must be one of copy, link, got 'move'"):
        write_nerfstudio(capture, out, train=[0], evaluation=[1], photos="move")
    for scaled in (load_capture(folder, downscale=2, normalize=False), load_capture(folder, downscale=1)):
        with pytest.raises(ValueError, match="read with downscale=1 and normalize=False"):
            write_nerfstudio(scaled, out, train=[0], evaluation=[1])
    with pytest.raises(ValueError, match=r"in is there already and not empty"):
        write_nerfstudio(capture, folder, train=[0], evaluation=[1])
    (folder / NAMES[1]).unlink()
    with pytest.raises(FileNotFoundError):
        write_nerfstudio(capture, out, train=[0], evaluation=[1])
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
    out.mkdir()  # an empty folder is as good as none
    write_nerfstudio(capture, out, train=[0], evaluation=[2])
    assert len(load_capture(out)) == 2


def test_numbers_survive_to_the_last_bit(tmp_path):
    generator = np.random.default_rng(1)
    cameras = Cameras.create(_poses(3), generator.uniform(1, 2, (3, 4)), 16, 12, generator.normal(size=(3, 6)) * 1e-3)
    names = [f"{number}.png" for number in range(3)]
    write_transforms(tmp_path / "transforms.json", cameras, names, {"train_filenames": names[:1]}, note="text")
    for name in names:
        Image.new("RGB", (16, 12)).save(tmp_path / name)
    again = whole(tmp_path)
    np.testing.assert_array_equal(again.cameras.camera_to_world, cameras.camera_to_world)
    np.testing.assert_array_equal(again.cameras.intrinsics, cameras.intrinsics)
    np.testing.assert_array_equal(again.cameras.distortion, cameras.distortion)
    assert again.split("train").tolist() == [0]
    assert json.loads((tmp_path / "transforms.json").read_text())["note"] == "text"


def test_fisheyes_are_written_as_fisheyes(tmp_path):
    bend = np.array([0.05, -0.01, 0.002, -0.0005, 0, 0])
    cameras = Cameras.create(_poses(3), np.array([10.0, 11.0, 8.0, 6.0]), 16, 12, bend, fisheye=True)
    names = [f"{number}.png" for number in range(3)]
    write_transforms(tmp_path / "transforms.json", cameras, names, {})
    for name in names:
        Image.new("RGB", (16, 12)).save(tmp_path / name)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    assert (meta["camera_model"], meta["k4"], meta["w"]) == ("OPENCV_FISHEYE", -0.0005, 16)
    capture = whole(tmp_path)
    assert capture.cameras.fisheye.all()
    write_nerfstudio(capture, tmp_path / "out", train=[0, 1], evaluation=[2])
    assert json.loads((tmp_path / "out" / "transforms.json").read_text())["camera_model"] == "OPENCV_FISHEYE"
    np.testing.assert_array_equal(whole(tmp_path / "out").cameras.rays(1)[1], cameras.rays(1)[1])
    some = Cameras.create(_poses(3), np.ones(4), 16, 12, fisheye=[True, False, False])
    with pytest.raises(ValueError, match=r"1 of the 3 cameras are fisheyes .*one camera_model a file"):
        write_transforms(tmp_path / "some.json", some, names, {})
    assert not (tmp_path / "some.json").exists()


def test_sizes_that_differ_stand_with_each_frame(tmp_path):
    width, height = [16, 12, 16], [12, 16, 12]
    cameras = Cameras.create(_poses(3), np.array([10.0, 10.0, 7.0, 7.0]), width, height)
    names = [f"{number}.png" for number in range(3)]
    write_transforms(tmp_path / "transforms.json", cameras, names, {"train_filenames": names[:1]})
    for name, size in zip(names, zip(width, height)):
        Image.new("RGB", size).save(tmp_path / name)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    assert not {"w", "h"} & set(meta)
    assert [(frame["w"], frame["h"]) for frame in meta["frames"]] == list(zip(width, height))
    assert meta["fl_x"] == 10.0
    write_nerfstudio(whole(tmp_path), tmp_path / "out", train=[0, 1], evaluation=[2])
    again = whole(tmp_path / "out")
    np.testing.assert_array_equal(again.cameras.sizes, cameras.sizes)
    np.testing.assert_array_equal(again.cameras.intrinsics, cameras.intrinsics)


@pytest.mark.parametrize("photos", ["copy", "link"])
def test_masks_depths_points_and_further_keys_go_along(tmp_path, photos):
    folder = released(tmp_path / "in")
    meta = json.loads((folder / "transforms.json").read_text())
    applied = np.eye(4)[:3].tolist()
    meta |= {"applied_transform": applied, "applied_scale": 2.0, "ply_file_path": "sparse/pc.ply", "cameras": 1}
    meta |= {"camera_angle_x": 0.7, "train_filenames": [NAMES[0]]}
    for number, frame in enumerate(meta["frames"]):
        frame |= {"mask_path": f"./masks/{number}.png", "colmap_im_id": number, "depth_file_path": f"d{number}/x.npy"}
        for key in ("mask_path", "depth_file_path"):
            (folder / frame[key]).parent.mkdir(exist_ok=True)
            (folder / frame[key]).write_text(f"{key} of {number}")
    (folder / "sparse").mkdir()
    (folder / "sparse" / "pc.ply").write_text("points")
    (folder / "transforms.json").write_text(json.dumps(meta))
    out = tmp_path / "out"
    write_nerfstudio(whole(folder), out, train=[0, 2], evaluation=[3], photos=photos)
    written = json.loads((out / "transforms.json").read_text())
    assert (written["applied_transform"], written["applied_scale"], written["cameras"]) == (applied, 2.0, 1)
    assert (out / written["ply_file_path"]).read_text() == "points"
    assert "camera_angle_x" not in written
    assert written["train_filenames"] == [NAMES[0], NAMES[2]]
    assert [frame["colmap_im_id"] for frame in written["frames"]] == [0, 2, 3]
    for frame in written["frames"]:
        for key in ("mask_path", "depth_file_path"):
            assert (out / frame[key]).read_text() == f"{key} of {frame['colmap_im_id']}"
            assert (out / frame[key]).is_symlink() == (photos == "link")
    assert written["frames"][0]["mask_path"] == "masks/0.png"  # nerfstudio looks for masks_2/0.png, too
    assert len({frame["depth_file_path"] for frame in written["frames"]}) == 3
    again = tmp_path / "again"
    write_nerfstudio(whole(out), again, train=[0, 1], evaluation=[2])
    assert json.loads((again / "transforms.json").read_text()) == written


def test_what_leads_to_no_file_is_said_to_be_lost(tmp_path, recwarn):
    folder = released(tmp_path / "in")
    meta = json.loads((folder / "transforms.json").read_text())
    meta["ply_file_path"] = "gone.ply"
    for number, frame in enumerate(meta["frames"]):
        frame["mask_path"] = f"masks/{number}.png"
    (folder / "masks").mkdir()
    (folder / "masks" / "2.png").write_text("mask")
    (folder / "transforms.json").write_text(json.dumps(meta))
    write_nerfstudio(whole(folder), tmp_path / "out", train=[0, 2], evaluation=[3])
    said = [str(each.message) for each in recwarn]
    assert any("mask_path leads to no file in 2 of 3 frames and is left out there" in each for each in said)
    assert any("ply_file_path leads to no file in 1 of 1" in each for each in said)
    written = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert ["mask_path" in frame for frame in written["frames"]] == [False, True, False]
    assert "ply_file_path" not in written
