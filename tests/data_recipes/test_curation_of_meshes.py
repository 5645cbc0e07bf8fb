"""Shards of mesh cubes: where each comes from, and what a bad mesh costs."""

import dataclasses
import hashlib
import shutil

import numpy as np
import pytest

from unghost.core.occupancy import SURFACE_LABEL
from unghost.core.shards.packing import dequantize_signed, unpack_frame, unpack_labels
from unghost.core.shards.storage import read_shard
from unghost.data_recipes.curation import SampleError, curate, sample_pair
from unghost.data_recipes.meshes.crops import cut_cubes
from unghost.data_recipes.meshes.files import load_mesh
from unghost.data_recipes.meshes.library import Mesh
from unghost.data_recipes.recipe import load_recipe


def add_row(root, line):
    with (root / "manifest.csv").open("a", encoding="utf-8") as stream:
        stream.write("\n" + line)


def test_mesh_recipes_need_a_folder(tmp_path):
    with pytest.raises(ValueError, match="mesh_root must name their folder, got None"):
        curate(load_recipe("meshes"), tmp_path, count=1, seed=0)
    with pytest.raises(FileNotFoundError, match=r"manifest.csv is not a file"):
        curate(load_recipe("meshes"), tmp_path / "out", count=1, seed=0, mesh_root=tmp_path)


def test_mesh_pairs_carry_their_mesh_as_group(tmp_path, mesh_root, mesh_recipe):
    shard = read_shard(curate(mesh_recipe, tmp_path / "out", count=16, seed=0, mesh_root=mesh_root)[0], verify=True)
    assert set(shard.group.tolist()) == {0, 2}
    assert shard.provenance["recipe"]["licences"] == ["CC0-1.0", "MIT-0"]
    assert str(tmp_path) not in str(shard.provenance)  # a shard names no folder of the machine


@pytest.mark.slow
def test_every_mesh_cube_names_its_source(tmp_path, mesh_root, mesh_recipe):
    shard = read_shard(curate(mesh_recipe, tmp_path / "out", count=16, seed=0, mesh_root=mesh_root)[0], verify=True)
    assert shard.provenance["rejected"] == []
    for row, source in zip(shard.group.tolist(), shard.source.tolist()):
        known = shard.provenance["sources"][source]
        digest = hashlib.sha256((mesh_root / f"balls/{row}.ply").read_bytes()).hexdigest()
        licence = {0: "CC0-1.0", 2: "MIT-0"}[row]
        assert known == {"path": f"balls/{row}.ply", "sha256": digest, "licence": licence, "row": row}


def test_a_cube_can_be_cut_again_from_its_frame(tmp_path, mesh_root, mesh_recipe):
    recipe = dataclasses.replace(mesh_recipe, clean_share=1.0, max_dilation=0)
    shard = read_shard(curate(recipe, tmp_path / "out", count=12, seed=0, mesh_root=mesh_root)[0], verify=True)
    labels, filled = unpack_labels(np.array(shard.labels)), 0
    for cube, numbers, fraction, source in zip(labels, shard.frames, shard.edge_fraction, shard.source):
        frame = unpack_frame(numbers)
        mesh = load_mesh(mesh_root / shard.provenance["sources"][source]["path"])
        np.testing.assert_array_equal(cut_cubes(mesh, [frame])[0], cube == SURFACE_LABEL)
        assert np.float32(frame.edge_length) == fraction
        filled += bool((cube == SURFACE_LABEL).any())
    assert filled > 6


@pytest.mark.slow
def test_a_bad_mesh_costs_that_mesh_and_is_reported(tmp_path, mesh_root, whole_bytes, mesh_recipe):
    for name in ("broken.ply", "changed.ply"):
        shutil.copy(mesh_root / "balls/0.ply", mesh_root / name)
    (mesh_root / "broken.ply").write_bytes((mesh_root / "broken.ply").read_bytes()[:-40])
    lines = (mesh_root / "manifest.csv").read_text(encoding="utf-8").splitlines()
    lines = [f"{line},{'sha256' if number == 0 else ''}" for number, line in enumerate(lines)]
    lines += ["broken.ply,train,CC0-1.0,", "absent.ply,train,CC0-1.0,", f"changed.ply,train,CC0-1.0,{'0' * 64}"]
    (mesh_root / "manifest.csv").write_text("\n".join(lines), encoding="utf-8")
    heard = []
    one = curate(mesh_recipe, tmp_path / "one", count=40, seed=0, mesh_root=mesh_root, log=heard.append)
    two = curate(mesh_recipe, tmp_path / "two", count=40, seed=0, mesh_root=mesh_root, workers=2)
    assert whole_bytes(one[0]) == whole_bytes(two[0])
    shard = read_shard(one[0], verify=True)
    assert set(shard.group.tolist()) == {0, 2}
    assert [note["path"] for note in shard.provenance["rejected"]] == ["broken.ply", "absent.ply", "changed.ply"]
    assert [line.split(" was passed over: ")[0] for line in heard] == ["broken.ply", "absent.ply", "changed.ply"]
    assert f"manifest.csv says {'0' * 64}" in heard[2]
    assert str(tmp_path) not in (one[0] / "manifest.json").read_text(encoding="utf-8")
    signed, _, _, _, group = sample_pair(mesh_recipe, 17, seed=0, mesh_root=mesh_root)
    assert group == shard.group[17]
    np.testing.assert_allclose(dequantize_signed(shard.inputs[17]), signed, atol=1 / 255 + 1e-6)
    again = []
    curate(mesh_recipe, tmp_path / "one", count=40, seed=0, mesh_root=mesh_root, log=again.append)
    assert again == heard


def test_a_folder_of_bad_meshes_only_ends_with_a_reason(tmp_path, mesh_root, mesh_recipe):
    for path in (mesh_root / "balls").iterdir():
        path.write_bytes(b"ply\n")
    with pytest.raises(
        SampleError, match=r"sample 0 of seed 0: .*none of the 2 meshes is usable; of balls/\d\.ply: rej"
    ):
        curate(mesh_recipe, tmp_path / "out", count=4, seed=0, mesh_root=mesh_root)
    assert not (tmp_path / "out" / "shard-00000").exists()


def test_a_mesh_whose_name_no_other_system_has_is_passed_over(tmp_path, mesh_root, mesh_recipe):
    shutil.copy(mesh_root / "balls/0.ply", mesh_root / "a:b.ply")
    add_row(mesh_root, "a:b.ply,train,CC0-1.0")
    heard = []
    folders = curate(mesh_recipe, tmp_path / "out", count=12, seed=0, mesh_root=mesh_root, log=heard.append)
    assert heard == [
        "a:b.ply was passed over: rejected: its path holds a character that is no part of a name on every system"
    ]
    assert set(read_shard(folders[0]).group.tolist()) == {0, 2}


def test_an_empty_mesh_folder_is_named(tmp_path, mesh_recipe):
    (tmp_path / "meshes").mkdir()
    with pytest.raises(FileNotFoundError, match=r"meshes.manifest\.csv is not a file"):
        curate(mesh_recipe, tmp_path / "out", count=4, seed=0, mesh_root=tmp_path / "meshes")
    (tmp_path / "meshes" / "manifest.csv").write_text("path,split,licence\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"no mesh of .*manifest\.csv has split 'train'"):
        curate(mesh_recipe, tmp_path / "out", count=4, seed=0, mesh_root=tmp_path / "meshes")
    assert not (tmp_path / "out").exists()


def test_another_mesh_manifest_is_another_curation(tmp_path, mesh_root, mesh_recipe):
    curate(mesh_recipe, tmp_path / "out", count=4, seed=0, mesh_root=mesh_root)
    add_row(mesh_root, "balls/1.ply,train,CC0-1.0")
    with pytest.raises(ValueError, match=r"\(mesh_manifest_sha256: '\w+', not '\w+'; meshes: 2, not 3\)"):
        curate(mesh_recipe, tmp_path / "out", count=4, seed=0, mesh_root=mesh_root)


@pytest.mark.slow
def test_a_recipe_can_have_its_meshes_repaired(tmp_path, mesh_root, mesh_recipe):
    """A ball with a triangle missing: repaired, it is whole again."""
    pytest.importorskip("pymeshlab")
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=1)
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(mesh_root / "balls/0.ply")
    for path in ("balls/1.ply", "balls/2.ply"):
        (mesh_root / path).unlink()
    plain = dataclasses.replace(mesh_recipe, clean_share=1.0, max_dilation=0, edge_fraction=(0.9, 1.0), empty_share=0)
    mended = dataclasses.replace(plain, repair=True)
    shards = [
        read_shard(curate(recipe, tmp_path / name, count=4, seed=0, mesh_root=mesh_root)[0])
        for name, recipe in (("plain", plain), ("mended", mended))
    ]
    for shard, faces in zip(shards, (ball.faces[1:], ball.faces)):
        whole = Mesh.from_triangles(ball.vertices[faces])
        for packed, numbers in zip(shard.labels, shard.frames):
            cube = unpack_labels(np.array(packed[None]))[0] == SURFACE_LABEL
            np.testing.assert_array_equal(cut_cubes(whole, [unpack_frame(numbers)])[0], cube)
