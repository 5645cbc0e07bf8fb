import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from unghost.core.frames import CubeFrame
from unghost.data_recipes.meshes.crops import sample_mesh_cubes
from unghost.data_recipes.meshes.files import load_mesh
from unghost.data_recipes.meshes.library import Mesh, select_meshes
from unghost.data_recipes.meshes.sources import MeshLibrary
from unghost.data_recipes.meshes.voxels import voxelize_triangles
from unghost.data_recipes.recipe import load_recipe

RECIPE = load_recipe("meshes")
SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason="no data folder beside the project")
SQUARE = np.array([[[0, 0, 0], [2, 0, 0], [2, 2, 0]], [[0, 0, 0], [2, 2, 0], [0, 2, 0]]], dtype=float)


def sample_mesh_cube(seed, mesh, recipe):
    """One clean cube of a mesh, and its frame."""
    occupancy, (frame,) = sample_mesh_cubes([np.random.default_rng(seed)], mesh, recipe)
    return occupancy[0], frame


@pytest.fixture
def mesh_root(tmp_path):
    """Six boxes, with a manifest that has every split, a licence that is not allowed and an unknown format."""
    trimesh = pytest.importorskip("trimesh")
    rows = ["path,split,licence"]
    for number, (split, licence) in enumerate(
        [("train", "CC0-1.0"), ("train", "CC-BY-3.0"), ("val", "CC0-1.0"), ("train", "MIT-0"), ("test", "MIT-0")]
    ):
        trimesh.creation.box(extents=(1, 1 + number, 2)).export(tmp_path / f"box{number}.ply")
        rows.append(f"box{number}.ply,{split},{licence}")
    rows.append("scan.dae,train,CC0-1.0")
    (tmp_path / "manifest.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return tmp_path


def test_normalised_to_longest_side_one():
    mesh = Mesh.from_triangles(SQUARE * [1, 3, 1] + 100)
    assert np.ptp(mesh.triangles.reshape(-1, 3), axis=0) == pytest.approx([1 / 3, 1, 0])
    np.testing.assert_allclose(mesh.triangles.min(axis=(0, 1)) + mesh.triangles.max(axis=(0, 1)), 0, atol=1e-12)


def test_surface_points_are_uniform_in_area():
    lopsided = np.concatenate([SQUARE, SQUARE[:1] * 0.5 + [0, 0, 1]])  # areas 2, 2, 0.5
    mesh = Mesh.from_triangles(lopsided)
    rng = np.random.default_rng(0)
    points = np.array([mesh.surface_point(rng)[0] for _ in range(4000)])
    assert (points[:, 2] > 0).mean() == pytest.approx(0.5 / 4.5, abs=0.02)
    flat = points[points[:, 2] < 0]
    quarters = [((flat[:, 0] > 0) == a) & ((flat[:, 1] > 0) == b) for a in (True, False) for b in (True, False)]
    np.testing.assert_allclose([q.mean() for q in quarters], 0.25, atol=0.03)
    np.testing.assert_allclose(np.abs(mesh.surface_point(rng)[1]), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("triangles", "message"),
    [
        (np.zeros((0, 3, 3)), "longest side must be finite and > 0"),
        (np.zeros((4, 3, 3)), "longest side must be finite and > 0"),
        (np.full((1, 3, 3), np.nan), "corners must be finite, got 9"),
        (np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0]]]), "at least one triangle must have an area"),
        (np.zeros((3, 3)), r"must have shape \(F, 3, 3\)"),
    ],
)
def test_meshes_without_a_surface_are_refused(triangles, message):
    with pytest.raises(ValueError, match=message):
        Mesh.from_triangles(triangles)


def test_leaving_far_triangles_out_changes_nothing():
    rng = np.random.default_rng(0)
    mesh = Mesh.from_triangles(rng.uniform(-1, 1, size=(200, 1, 3)) + rng.normal(size=(200, 3, 3)) * 0.1)
    for i in range(10):
        occupancy, frame = sample_mesh_cube(i, mesh, dataclasses.replace(RECIPE, max_dilation=0))
        np.testing.assert_array_equal(occupancy, voxelize_triangles(frame.to_local(mesh.triangles)))


def test_frame_and_cube_agree():
    """Points on the mesh inside the cube fall into occupied voxels of ``CubeFrame.voxel_index``."""
    mesh = Mesh.from_triangles(SQUARE + np.array([[0, 0, 0], [0, 0, 0.3], [0, 0, 0.1]]))
    rng = np.random.default_rng(1)
    points = np.array([mesh.surface_point(rng)[0] for _ in range(3000)])
    seen = 0
    for i in range(20):
        occupancy, frame = sample_mesh_cube(i, mesh, RECIPE)
        assert isinstance(frame, CubeFrame)
        index = frame.voxel_index(points)
        index = index[((index >= 0) & (index < 32)).all(axis=1)]
        assert occupancy[tuple(index.T)].all()
        seen += len(index)
    assert seen > 100


def test_empty_cubes_are_empty():
    mesh = Mesh.from_triangles(SQUARE)
    for i in range(20):
        assert not sample_mesh_cube(i, mesh, dataclasses.replace(RECIPE, empty_share=1.0))[0].any()


def test_node_transforms_are_applied(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    box = trimesh.creation.box(extents=(1, 1, 1))
    scene.add_geometry(box)
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    scene.export(tmp_path / "two.glb")
    mesh = load_mesh(tmp_path / "two.glb")
    assert len(mesh.triangles) == 24
    np.testing.assert_allclose(np.ptp(mesh.triangles.reshape(-1, 3), axis=0), [1, 0.25, 0.25], atol=1e-6)


def test_unreadable_files_name_themselves(tmp_path):
    pytest.importorskip("trimesh")
    with pytest.raises(FileNotFoundError, match=r"missing\.ply is not a file"):
        load_mesh(tmp_path / "missing.ply")
    (tmp_path / "broken.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(ValueError, match=r"broken\.ply"):
        load_mesh(tmp_path / "broken.ply")


def test_missing_trimesh_names_the_extra(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    code = (
        "import sys; sys.modules['trimesh'] = None\n"
        "from unghost.data_recipes.meshes.files import load_mesh\n"
        f"load_mesh({str(tmp_path / 'a.ply')!r})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "MissingExtra: load_mesh: reading meshes needs trimesh: pip install unghost[recipes]" in run.stderr


def test_only_the_allowed_licences_split_and_formats(mesh_root):
    names = {
        split: [entry.path.name for entry in select_meshes(dataclasses.replace(RECIPE, split=split), mesh_root)]
        for split in ("train", "val", "test")
    }
    assert names == {"train": ["box0.ply", "box3.ply"], "val": ["box2.ply"], "test": ["box4.ply"]}
    assert [entry.row for entry in select_meshes(RECIPE, mesh_root)] == [0, 3]


def test_bad_manifests(mesh_root, tmp_path_factory):
    with pytest.raises(ValueError, match="no mesh of"):
        select_meshes(dataclasses.replace(RECIPE, licences=("GPL-3.0",)), mesh_root)
    with pytest.raises(FileNotFoundError, match=r"manifest\.csv is not a file"):
        select_meshes(RECIPE, tmp_path_factory.mktemp("none"))
    (mesh_root / "manifest.csv").write_text("path,split,licence\n../a.ply,train,MIT-0\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"row 0 of .* leaves the folder"):
        select_meshes(RECIPE, mesh_root)
    (mesh_root / "manifest.csv").write_text("path,split\na.ply,train\n", encoding="utf-8")
    with pytest.raises(ValueError, match="lacks the columns licence"):
        select_meshes(RECIPE, mesh_root)


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        (b"", "lacks the columns path, split, licence"),
        (b"path,split,licence\na.ply,train\n", "row 0 of .* has more or fewer columns"),
        (b"path,split,licence\na.ply,train,MIT-0\nb,c.ply,train,MIT-0\n", "row 1 of .* has more or fewer columns"),
        (b"path,split,licence\n\xff.ply,train,MIT-0\n", "is not CSV in UTF-8"),
        (b"path,split,licence\n" + b"a" * 200_000 + b".ply,train,MIT-0\n", "is not CSV in UTF-8"),
    ],
)
def test_manifests_that_are_none_are_refused(mesh_root, content, rule):
    (mesh_root / "manifest.csv").write_bytes(content)
    with pytest.raises(ValueError, match=f"select_meshes: .*{rule}"):
        select_meshes(RECIPE, mesh_root)


def test_samples_share_meshes_in_runs_and_every_mesh_has_its_turn(mesh_root):
    recipe = dataclasses.replace(RECIPE, cubes_per_mesh=3)
    library = MeshLibrary(recipe, mesh_root)
    cubes, passed = library.draw([np.random.default_rng([0, i]) for i in range(12)], range(12), seed=0)
    library.close()
    assert not passed
    runs = np.array([cube.row for cube in cubes]).reshape(4, 3)
    assert (runs == runs[:, :1]).all()
    assert sorted(runs[:2, 0]) == sorted(runs[2:, 0]) == [0, 3]


@needs_shared
@pytest.mark.shared_data
def test_splits_of_the_real_manifest_are_disjoint_and_free():
    root = SHARED / "meshes"
    rows = [
        {entry.row for entry in select_meshes(dataclasses.replace(RECIPE, split=split), root)}
        for split in ("train", "val", "test")
    ]
    assert all(rows)
    assert sum(map(len, rows)) == len(set().union(*rows))


@needs_shared
@pytest.mark.shared_data
def test_real_meshes_load_and_give_cubes():
    entries = select_meshes(dataclasses.replace(RECIPE, split="val"), SHARED / "meshes")
    for entry in entries[::11]:
        mesh = load_mesh(entry.path)
        cubes = [sample_mesh_cube(i, mesh, RECIPE)[0] for i in range(8)]
        assert sum(occupancy.any() for occupancy in cubes) >= 5
