import csv
from pathlib import Path

import numpy as np
import pytest

from unghost.core.distances import signed as sd
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.harvest.run import room_scene
from unghost.data_recipes.meshes.objects import SKIN, draw_objects, solid_from_triangles

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("open3d")
pytest.importorskip("scipy")


def soup(mesh):
    return np.asarray(mesh.triangles, dtype=np.float64)


def test_a_closed_mesh_is_full_and_an_open_one_is_not():
    box = trimesh.creation.box(extents=(1.0, 0.6, 0.4))
    closed = solid_from_triangles(soup(box), cells=40)
    opened = solid_from_triangles(soup(box)[2:], cells=40)  # one of twelve triangles pairs is gone: a hole
    assert closed(np.zeros((1, 3)))[0] < -0.1
    assert opened(np.zeros((1, 3)))[0] > 0.1
    points = np.random.default_rng(0).uniform(-0.55, 0.55, size=(3000, 3))
    skin = SKIN * closed.pitch
    true = sd.box(points, [0.5, 0.3, 0.2]) - skin
    band = (np.abs(true) < 0.045) & (true > -skin / 2)  # where the corners' rounding of the inside does not matter
    np.testing.assert_allclose(closed(points)[band], true[band], atol=0.35 * closed.pitch)


def test_a_sheet_has_no_holes_between_the_nodes():
    tilt = trimesh.transformations.rotation_matrix(0.37, [0.3, 0.5, 0.8])
    sheet = trimesh.creation.box(extents=(1.0, 1.0, 1e-5))
    sheet.apply_transform(tilt)
    solid = solid_from_triangles(soup(sheet), cells=30)
    inner = np.random.default_rng(1).uniform(-0.45, 0.45, size=(4000, 3)) * [1, 1, 0]
    assert solid(inner @ tilt[:3, :3].T).max() < 0


def test_triangles_that_are_no_mesh():
    with pytest.raises(ValueError, match="cells"):
        solid_from_triangles(np.zeros((1, 3, 3)), cells=3)
    with pytest.raises(ValueError, match="extent"):
        solid_from_triangles(np.zeros((1, 3, 3)))


@pytest.fixture
def folder(tmp_path):
    """Two meshes of the train split, one of the test split, one that is no mesh."""
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.ply")
    trimesh.creation.box().export(tmp_path / "box.obj")
    trimesh.creation.cone(1, 2).export(tmp_path / "held.stl")
    (tmp_path / "broken.ply").write_text("no mesh")
    with (tmp_path / "manifest.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["path", "split", "licence", "sha256"])
        for path, split in (("ball.ply", "train"), ("held.stl", "test"), ("broken.ply", "train"), ("box.obj", "train")):
            writer.writerow([path, split, "CC0-1.0", ""])
    return Path(tmp_path)


@pytest.mark.slow
def test_objects_come_from_the_train_split_with_their_sources(folder):
    solids, sources = draw_objects(np.random.default_rng(0), folder, 6)
    assert len(solids) == len(sources) == 6
    assert {source["path"] for source in sources} == {"ball.ply", "box.obj"}
    again, _ = draw_objects(np.random.default_rng(0), folder, 6)
    for first, second in zip(solids, again):
        np.testing.assert_array_equal(first.values, second.values)


@pytest.mark.slow
def test_rooms_hold_them_and_say_so(folder):
    config = HarvestConfig(cubes=2, objects=(3, 3))
    with_meshes, told = room_scene(0, 0, config, folder)
    without, plain = room_scene(0, 0, config)
    assert [mesh["licence"] for mesh in told["meshes"]] == ["CC0-1.0"] * 3
    assert (told["licence"], plain["licence"]) == ("CC0-1.0 AND generated", "generated")
    assert plain["meshes"] == []
    assert (with_meshes["inputs"] != without["inputs"]).any()
