"""Cameras in the files of other tools: Inria's cameras.json, and nerfstudio's own world."""

import json

import numpy as np
import pytest

from unghost.evaluation.captures.dataparser import EARLIER
from unghost.evaluation.captures.loading import load_cameras

LENS = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0}


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def poses(count=4):
    """OpenGL camera-to-world ``(count, 3, 4)``."""
    places = np.random.default_rng(9).normal(size=(count, 3, 1))
    return np.concatenate([np.stack([rotation(seed) for seed in range(count)]), places], axis=2)


def transforms(folder, cameras, **keys):
    folder.mkdir(parents=True, exist_ok=True)
    frames = [
        {"file_path": f"{k}.png", "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]} for k, pose in enumerate(cameras)
    ]
    (folder / "transforms.json").write_text(json.dumps({**LENS, **keys, "frames": frames}))
    return folder


def inria(cameras):
    """As the code of 3D Gaussian Splatting writes them: it inverts COLMAP's world-to-camera."""
    entries = []
    for number, pose in enumerate(cameras):
        world_to_camera = np.linalg.inv(np.vstack([pose * [1, -1, -1, 1], [0, 0, 0, 1]]))
        camera_to_world = np.linalg.inv(world_to_camera)
        entries.append(
            {
                **{"id": number, "img_name": f"{number:05d}", "width": 64, "height": 48, "fy": 61.0, "fx": 60.0},
                "position": camera_to_world[:3, 3].tolist(),
                "rotation": [row.tolist() for row in camera_to_world[:3, :3]],
            }
        )
    return entries


def test_inria_s_cameras_are_those_of_the_transforms(tmp_path):
    wanted = load_cameras(transforms(tmp_path / "t", poses()))
    (tmp_path / "model").mkdir()
    file = tmp_path / "model" / "cameras.json"
    file.write_text(json.dumps(inria(poses())))
    for place in (file, tmp_path / "model"):
        found = load_cameras(place)
        np.testing.assert_allclose(found.camera_to_world, wanted.camera_to_world, atol=1e-12)
        np.testing.assert_array_equal(found.intrinsics, wanted.intrinsics)
        assert (found.width, found.height, found.distortion.any()) == (64, 48, False)


def test_a_known_camera_of_inria_sees_what_is_before_it(tmp_path):
    """At (0, 0, -5), axes of the world: right +X, down +Y, forward +Z; the point lies right of and below the middle."""
    entry = {"id": 0, "img_name": "a", "width": 64, "height": 48, "fx": 60.0, "fy": 61.0}
    entry |= {"position": [0, 0, -5], "rotation": np.eye(3).tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    pixel, depth, seen = load_cameras(tmp_path).project(0, np.array([1.0, 0.5, 0.0]))
    np.testing.assert_allclose(pixel, [32 + 60 / 5, 24 + 61 * 0.5 / 5])
    assert (depth, seen) == (5.0, True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": None}, "entry 1 of .* has no rotation"),
        ({"rotation": [[1, 0], [0, 1]]}, r"entry 1 of .* must hold a position of 3 numbers"),
        ({"rotation": (2 * np.eye(3)).tolist()}, "must hold a rotation"),
        ({"fx": "wide"}, "entry 1 of .* must hold"),
        ({"img_name": "00000"}, None),  # twice: names do not matter
    ],
)
def test_what_is_wrong_with_cameras_json_is_named(tmp_path, change, message):
    entries = inria(poses())
    entries[1] = {key: value for key, value in {**entries[1], **change}.items() if value is not None}
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    if message is None:
        assert len(load_cameras(tmp_path)) == 4
    else:
        with pytest.raises(ValueError, match=message):
            load_cameras(tmp_path)


def test_a_list_of_something_else_is_refused(tmp_path):
    (tmp_path / "cameras.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match=r"entry 0 of .* has no position, .*a list must be Inria's"):
        load_cameras(tmp_path)


MOTION = np.concatenate([rotation(20), [[0.3], [-2.0], [1.0]]], axis=1)
APPLIED = np.concatenate([rotation(21), [[0.5], [0.0], [4.0]]], axis=1)


def homogeneous(matrix):
    return np.vstack([matrix, [0, 0, 0, 1]])


def trained(cameras, applied, applied_scale):
    """nerfstudio's order: COLMAP's world, applied_transform and applied_scale into the file, its own motion, scale.

    It states the product of the motions, and the product of the scales, from COLMAP's world on.
    """
    stored = np.stack([(homogeneous(applied) @ homogeneous(pose))[:3] for pose in cameras])
    stored[:, :, 3] *= applied_scale
    moved = np.stack([(homogeneous(MOTION) @ homogeneous(pose))[:3] for pose in stored])
    moved[:, :, 3] *= 0.31
    stated = (homogeneous(MOTION) @ homogeneous(applied))[:3]
    return stored, moved, {"transform": stated.tolist(), "scale": 0.31 * applied_scale}


@pytest.mark.parametrize(
    ("applied", "applied_scale", "keys"),
    [
        (np.eye(4)[:3], 1.0, {}),
        (APPLIED, 1.0, {"applied_transform": APPLIED.tolist()}),
        (APPLIED, 2.5, {"applied_transform": APPLIED.tolist(), "applied_scale": 2.5}),
        (np.array(EARLIER, float), 1.0, {"colmap": True}),  # a file that states none, with COLMAP's model beside it
    ],
)
def test_cameras_move_into_the_world_that_nerfstudio_trained_in(tmp_path, applied, applied_scale, keys):
    stored, moved, stated = trained(poses(), applied, applied_scale)
    folder = transforms(tmp_path / "data", stored, **{k: v for k, v in keys.items() if k != "colmap"})
    if "colmap" in keys:
        (folder / "colmap" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "export").mkdir()
    file, scene = tmp_path / "export" / "dataparser_transforms.json", tmp_path / "export" / "splat.ply"
    file.write_text(json.dumps(stated))
    np.testing.assert_allclose(load_cameras(folder).camera_to_world, stored)
    for options in ({"dataparser": file}, {"scene": scene}):
        found = load_cameras(folder, **options)
        np.testing.assert_allclose(found.camera_to_world, moved, atol=1e-12)
    np.testing.assert_allclose(load_cameras(folder, scene=scene, dataparser=False).camera_to_world, stored)
    (folder / file.name).write_text(file.read_text())  # the same beside both
    np.testing.assert_allclose(load_cameras(folder / "transforms.json", scene=scene).camera_to_world, moved, atol=1e-12)
    (folder / file.name).write_text(json.dumps({**stated, "scale": 1.0}))
    with pytest.raises(ValueError, match="differ: remove the one that is not of this scene"):
        load_cameras(folder, scene=scene)


def test_colmap_s_own_poses_are_where_the_stated_motion_begins(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(camera_id=1, model="PINHOLE", width=64, height=48, params=np.array([60.0, 61, 32, 24]))
    model.add_camera_with_trivial_rig(lens)
    for number, pose in enumerate(poses(), start=1):
        world = np.linalg.inv(homogeneous(pose * [1, -1, -1, 1]))
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(world[:3, :3]), world[:3, 3])
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number), rigid)
    (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
    model.write_binary(tmp_path / "colmap" / "sparse" / "0")
    _, moved, stated = trained(poses(), APPLIED, 1.0)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(stated))
    np.testing.assert_allclose(load_cameras(tmp_path).camera_to_world, moved, atol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "must hold a transform of 3 x 4 numbers and a scale"),
        ({"transform": [[1, 2], [3, 4]], "scale": 1}, "must hold a transform"),
        ({"transform": (2 * np.eye(4)[:3]).tolist(), "scale": 1}, "transform in .* must hold a rotation"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 0}, "scale in .* must be > 0, got 0"),
        ([], "must hold an object"),
    ],
)
def test_what_is_wrong_with_the_transform_is_named(tmp_path, content, message):
    folder = transforms(tmp_path / "t", poses())
    (folder / "dataparser_transforms.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        load_cameras(folder)


@pytest.mark.parametrize("spelled", ["Nerstudio 1.1.5", "Nerfstudio 1.2.0", None])
def test_splats_that_nerfstudio_exported_are_noticed_where_nothing_says_how_it_moved(tmp_path, spelled, recwarn):
    folder, scene = transforms(tmp_path / "t", poses()), tmp_path / "splat.ply"
    comment = "" if spelled is None else f"comment Generated by {spelled}\n"
    scene.write_bytes(f"ply\nformat binary_little_endian 1.0\n{comment}element vertex 0\nend_header\n".encode())
    load_cameras(folder, scene=scene)
    said = [str(each.message) for each in recwarn]
    assert len(said) == (spelled is not None)
    assert all("nerfstudio exported splat.ply" in each and "copy dataparser_transforms.json" in each for each in said)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": MOTION.tolist(), "scale": 1.0}))
    for options in ({}, {"dataparser": False}):
        load_cameras(folder, scene=scene, **options)
    assert len(recwarn) == len(said)
