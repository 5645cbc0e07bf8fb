import dataclasses
import errno
import hashlib
import pathlib
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from unghost.core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL
from unghost.core.shards import ARRAYS, dequantize_signed, read_shard, unpack_frame, unpack_labels
from unghost.data_recipes import pairs
from unghost.data_recipes.curate import SampleError, curate, damage, sample_pair
from unghost.data_recipes.mesh_files import load_mesh
from unghost.data_recipes.meshes import Mesh
from unghost.data_recipes.recipe import Recipe, load_recipe

RECIPE = Recipe(parts=(1, 3))


def arrays(folder):
    shard = read_shard(folder, verify=True)
    return {name: np.array(getattr(shard, name)) for name in ARRAYS}


def test_same_bytes_for_one_and_two_workers(tmp_path):
    one = curate(RECIPE, tmp_path / "one", count=40, seed=3)
    two = curate(RECIPE, tmp_path / "two", count=40, seed=3, workers=2)
    for file in ("manifest.json", *(f"{name}.npy" for name in ARRAYS)):
        assert (one[0] / file).read_bytes() == (two[0] / file).read_bytes()


def test_shard_rows_are_the_single_samples(tmp_path):
    shard = read_shard(curate(RECIPE, tmp_path, count=12, seed=9)[0], verify=True)
    labels = unpack_labels(np.array(shard.labels))
    for index in (0, 5, 11):
        signed, expected, severity, fraction, group = sample_pair(RECIPE, index, seed=9)
        np.testing.assert_allclose(dequantize_signed(shard.inputs[index]), signed, atol=1 / 255 + 1e-6)
        np.testing.assert_array_equal(labels[index], expected)
        assert (shard.severity[index], shard.edge_fraction[index]) == (np.float32(severity), np.float32(fraction))
        assert shard.group[index] == group == index


def test_seeds_and_samples_differ():
    first = sample_pair(RECIPE, 0, seed=0)[0]
    assert not np.array_equal(first, sample_pair(RECIPE, 1, seed=0)[0])
    assert not np.array_equal(first, sample_pair(RECIPE, 0, seed=1)[0])


def test_shares_of_clean_and_soft_inputs():
    pairs = [sample_pair(RECIPE, index, seed=1) for index in range(150)]
    untouched = [signed for signed, _, severity, _, _ in pairs if severity == 0]
    soft = [np.abs(signed).min() < 1 for signed, _, severity, _, _ in pairs if severity > 0]
    assert 0.03 < len(untouched) / 150 < 0.2
    assert 0.35 < np.mean(soft) < 0.65
    for signed, labels, severity, _, _ in pairs:
        if severity == 0:
            np.testing.assert_array_equal(signed, np.where(labels == SURFACE_LABEL, 1.0, -1.0))
        hard = np.abs(signed).min() == 1
        assert hard or not (labels == SURFACE_LABEL).any() or (labels == IGNORE_LABEL).any()
        assert not hard or not (labels == IGNORE_LABEL).any()
    assert any((labels == FREE_LABEL).all() for _, labels, _, _, _ in pairs)  # truly empty


def test_ignored_voxels_are_the_neighbours_of_a_soft_surface():
    recipe = dataclasses.replace(RECIPE, clean_share=0.0, soft_share=1.0)
    clean = np.zeros((32, 32, 32), dtype=bool)
    clean[10, 10, 10] = True
    _, labels, _ = damage(np.random.default_rng(0), clean, recipe)
    expected = np.zeros_like(clean, dtype=np.uint8)
    expected[8:13, 8:13, 8:13] = IGNORE_LABEL
    expected[9:12, 9:12, 9:12] = SURFACE_LABEL  # soft_dilation is 1
    np.testing.assert_array_equal(labels, expected)


def test_empty_field_encodes_to_minus_one():
    empty = dataclasses.replace(RECIPE, empty_share=1.0, clean_share=1.0)
    signed, labels, _, _, _ = sample_pair(empty, 0, seed=0)
    assert (labels == FREE_LABEL).all()
    assert (signed == -1).all()


def test_finished_shards_are_skipped_and_missing_ones_made(tmp_path):
    folders = curate(RECIPE, tmp_path, count=20, seed=0, shard_length=8)
    assert [folder.name for folder in folders] == ["shard-00000", "shard-00001", "shard-00002"]
    assert [len(read_shard(folder)) for folder in folders] == [8, 8, 4]
    before = [arrays(folder) for folder in folders]
    stamps = [(folder / "manifest.json").stat().st_mtime_ns for folder in folders]
    shutil.rmtree(folders[1])
    assert curate(RECIPE, tmp_path, count=20, seed=0, shard_length=8) == folders
    for folder, wanted in zip(folders, before):
        for name, array in arrays(folder).items():
            np.testing.assert_array_equal(array, wanted[name])
    after = [(folder / "manifest.json").stat().st_mtime_ns for folder in folders]
    assert [a == b for a, b in zip(stamps, after)] == [True, False, True]


def test_another_curation_in_the_same_folder_is_refused(tmp_path):
    curate(RECIPE, tmp_path, count=4, seed=0)
    with pytest.raises(ValueError, match=r"holds another curation \(it differs in seed\)"):
        curate(RECIPE, tmp_path, count=4, seed=1)
    with pytest.raises(ValueError, match=r"differs in recipe"):
        curate(dataclasses.replace(RECIPE, soft_share=0.1), tmp_path, count=4, seed=0)


@pytest.mark.parametrize(
    ("name", "value"), [("count", 0), ("seed", -1), ("workers", 0), ("count", 2**31), ("shard_length", 0)]
)
def test_bad_numbers_are_named(tmp_path, name, value):
    with pytest.raises(ValueError, match=f"curate: {name} must be"):
        curate(RECIPE, tmp_path / "out", **{"count": 1, "seed": 0, "workers": 1, name: value})
    assert not (tmp_path / "out").exists()


def test_mesh_recipes_need_a_folder(tmp_path):
    with pytest.raises(ValueError, match="mesh_root must name their folder, got None"):
        curate(load_recipe("meshes"), tmp_path, count=1, seed=0)
    with pytest.raises(FileNotFoundError, match=r"manifest.csv is not a file"):
        curate(load_recipe("meshes"), tmp_path / "out", count=1, seed=0, mesh_root=tmp_path)


def whole_bytes(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def mesh_root(tmp_path):
    """Three balls: rows 0 and 2 to train on, row 1 for validation."""
    trimesh = pytest.importorskip("trimesh")
    root = tmp_path / "meshes"
    (root / "balls").mkdir(parents=True)
    lines = ["path,split,licence"]
    for number in range(3):
        trimesh.creation.icosphere(subdivisions=1, radius=1 + number).export(root / f"balls/{number}.ply")
        lines.append(f"balls/{number}.ply,{'val' if number == 1 else 'train'},{'MIT-0' if number else 'CC0-1.0'}")
    (root / "manifest.csv").write_text("\n".join(lines), encoding="utf-8")
    return root


MESH_RECIPE = dataclasses.replace(load_recipe("meshes"), cubes_per_mesh=4)


def add_row(root, line):
    with (root / "manifest.csv").open("a", encoding="utf-8") as stream:
        stream.write("\n" + line)


def test_mesh_pairs_carry_their_mesh_as_group(tmp_path, mesh_root):
    shard = read_shard(curate(MESH_RECIPE, tmp_path / "out", count=16, seed=0, mesh_root=mesh_root)[0], verify=True)
    assert set(shard.group.tolist()) == {0, 2}
    assert shard.provenance["recipe"]["licences"] == ["CC0-1.0", "MIT-0"]
    assert str(tmp_path) not in str(shard.provenance)  # a shard names no folder of the machine


def test_every_mesh_cube_names_its_source(tmp_path, mesh_root):
    shard = read_shard(curate(MESH_RECIPE, tmp_path / "out", count=16, seed=0, mesh_root=mesh_root)[0], verify=True)
    assert shard.provenance["rejected"] == []
    for row, source in zip(shard.group.tolist(), shard.source.tolist()):
        known = shard.provenance["sources"][source]
        digest = hashlib.sha256((mesh_root / f"balls/{row}.ply").read_bytes()).hexdigest()
        licence = {0: "CC0-1.0", 2: "MIT-0"}[row]
        assert known == {"path": f"balls/{row}.ply", "sha256": digest, "licence": licence, "row": row}


def test_a_cube_can_be_cut_again_from_its_frame(tmp_path, mesh_root):
    recipe = dataclasses.replace(MESH_RECIPE, clean_share=1.0, max_dilation=0)
    shard = read_shard(curate(recipe, tmp_path / "out", count=12, seed=0, mesh_root=mesh_root)[0], verify=True)
    labels, filled = unpack_labels(np.array(shard.labels)), 0
    for cube, numbers, fraction, source in zip(labels, shard.frames, shard.edge_fraction, shard.source):
        frame = unpack_frame(numbers)
        mesh = load_mesh(mesh_root / shard.provenance["sources"][source]["path"])
        np.testing.assert_array_equal(mesh.voxelize(frame), cube == SURFACE_LABEL)
        assert np.float32(frame.edge_length) == fraction
        filled += bool((cube == SURFACE_LABEL).any())
    assert filled > 6


def test_procedural_cubes_have_no_source(tmp_path):
    shard = read_shard(curate(RECIPE, tmp_path, count=2, seed=0)[0])
    assert shard.source is shard.frames is shard.surroundings is shard.view_count is None
    assert "sources" not in shard.provenance


def test_exact_solids_come_by_tree_and_alone_as_together(tmp_path):
    pytest.importorskip("manifold3d")
    recipe = dataclasses.replace(load_recipe("csg"), cubes_per_mesh=3)
    shard = read_shard(curate(recipe, tmp_path, count=8, seed=0)[0], verify=True)
    assert shard.group.tolist() == [0, 0, 0, 1, 1, 1, 2, 2]
    for index in (2, 7):
        signed, labels, _, _, _ = sample_pair(recipe, index, seed=0)
        np.testing.assert_allclose(dequantize_signed(shard.inputs[index]), signed, atol=1 / 255 + 1e-6)
        np.testing.assert_array_equal(unpack_labels(np.array(shard.labels[index : index + 1]))[0], labels)


def test_a_bad_mesh_costs_that_mesh_and_is_reported(tmp_path, mesh_root):
    for name in ("broken.ply", "changed.ply"):
        shutil.copy(mesh_root / "balls/0.ply", mesh_root / name)
    (mesh_root / "broken.ply").write_bytes((mesh_root / "broken.ply").read_bytes()[:-40])
    lines = (mesh_root / "manifest.csv").read_text(encoding="utf-8").splitlines()
    lines = [f"{line},{'sha256' if number == 0 else ''}" for number, line in enumerate(lines)]
    lines += ["broken.ply,train,CC0-1.0,", "absent.ply,train,CC0-1.0,", f"changed.ply,train,CC0-1.0,{'0' * 64}"]
    (mesh_root / "manifest.csv").write_text("\n".join(lines), encoding="utf-8")
    heard = []
    one = curate(MESH_RECIPE, tmp_path / "one", count=40, seed=0, mesh_root=mesh_root, log=heard.append)
    two = curate(MESH_RECIPE, tmp_path / "two", count=40, seed=0, mesh_root=mesh_root, workers=2)
    assert whole_bytes(one[0]) == whole_bytes(two[0])
    shard = read_shard(one[0], verify=True)
    assert set(shard.group.tolist()) == {0, 2}
    assert [note["path"] for note in shard.provenance["rejected"]] == ["broken.ply", "absent.ply", "changed.ply"]
    assert [line.split(" was passed over: ")[0] for line in heard] == ["broken.ply", "absent.ply", "changed.ply"]
    assert f"manifest.csv says {'0' * 64}" in heard[2]
    assert str(tmp_path) not in (one[0] / "manifest.json").read_text(encoding="utf-8")
    signed, _, _, _, group = sample_pair(MESH_RECIPE, 17, seed=0, mesh_root=mesh_root)
    assert group == shard.group[17]
    np.testing.assert_allclose(dequantize_signed(shard.inputs[17]), signed, atol=1 / 255 + 1e-6)
    again = []
    curate(MESH_RECIPE, tmp_path / "one", count=40, seed=0, mesh_root=mesh_root, log=again.append)
    assert again == heard


def test_a_folder_of_bad_meshes_only_ends_with_a_reason(tmp_path, mesh_root):
    for path in (mesh_root / "balls").iterdir():
        path.write_bytes(b"ply\n")
    with pytest.raises(
        SampleError, match=r"sample 0 of seed 0: .*none of the 2 meshes is usable; of balls/\d\.ply: rej"
    ):
        curate(MESH_RECIPE, tmp_path / "out", count=4, seed=0, mesh_root=mesh_root)
    assert not (tmp_path / "out" / "shard-00000").exists()


def test_a_mesh_whose_name_no_other_system_has_is_passed_over(tmp_path, mesh_root):
    shutil.copy(mesh_root / "balls/0.ply", mesh_root / "a:b.ply")
    add_row(mesh_root, "a:b.ply,train,CC0-1.0")
    heard = []
    folders = curate(MESH_RECIPE, tmp_path / "out", count=12, seed=0, mesh_root=mesh_root, log=heard.append)
    assert heard == ["a:b.ply was passed over: rejected: its path holds a character that is no part of a name on "
                     "every system"]  # fmt: skip
    assert set(read_shard(folders[0]).group.tolist()) == {0, 2}


def test_an_empty_mesh_folder_is_named(tmp_path):
    (tmp_path / "meshes").mkdir()
    with pytest.raises(FileNotFoundError, match=r"meshes.manifest\.csv is not a file"):
        curate(MESH_RECIPE, tmp_path / "out", count=4, seed=0, mesh_root=tmp_path / "meshes")
    (tmp_path / "meshes" / "manifest.csv").write_text("path,split,licence\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"no mesh of .*manifest\.csv has split 'train'"):
        curate(MESH_RECIPE, tmp_path / "out", count=4, seed=0, mesh_root=tmp_path / "meshes")
    assert not (tmp_path / "out").exists()


def test_another_mesh_manifest_is_another_curation(tmp_path, mesh_root):
    curate(MESH_RECIPE, tmp_path / "out", count=4, seed=0, mesh_root=mesh_root)
    add_row(mesh_root, "balls/1.ply,train,CC0-1.0")
    with pytest.raises(ValueError, match=r"it differs in mesh_manifest_sha256, meshes"):
        curate(MESH_RECIPE, tmp_path / "out", count=4, seed=0, mesh_root=mesh_root)


def test_a_recipe_can_have_its_meshes_repaired(tmp_path, mesh_root):
    """A ball with a triangle missing: repaired, it is whole again."""
    pytest.importorskip("pymeshlab")
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=1)
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(mesh_root / "balls/0.ply")
    for path in ("balls/1.ply", "balls/2.ply"):
        (mesh_root / path).unlink()
    plain = dataclasses.replace(MESH_RECIPE, clean_share=1.0, max_dilation=0, edge_fraction=(0.9, 1.0), empty_share=0)
    mended = dataclasses.replace(plain, repair=True)
    shards = [
        read_shard(curate(recipe, tmp_path / name, count=4, seed=0, mesh_root=mesh_root)[0])
        for name, recipe in (("plain", plain), ("mended", mended))
    ]
    for shard, faces in zip(shards, (ball.faces[1:], ball.faces)):
        whole = Mesh.from_triangles(ball.vertices[faces])
        for packed, numbers in zip(shard.labels, shard.frames):
            cube = unpack_labels(np.array(packed[None]))[0] == SURFACE_LABEL
            np.testing.assert_array_equal(whole.voxelize(unpack_frame(numbers)), cube)


KILLED = """
import sys
from unghost.data_recipes.curate import curate
from unghost.data_recipes.recipe import Recipe

if __name__ == "__main__":
    curate(Recipe(parts=(1, 3)), sys.argv[1], count=200, seed=3, shard_length=25, workers=int(sys.argv[2]))
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path, workers):
    script, out = tmp_path / "killed.py", tmp_path / "out"
    script.write_text(KILLED, encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script), str(out), str(workers)]) as run:
        deadline = time.monotonic() + 120
        while not (out / "shard-00001").exists() and time.monotonic() < deadline and run.poll() is None:
            time.sleep(0.002)
        run.send_signal(signal.SIGKILL)
    assert run.returncode == -signal.SIGKILL
    survivors = sorted(path for path in out.iterdir() if path.suffix != ".partial")
    assert 2 <= len(survivors) < 8
    stamps = [(path / "manifest.json").stat().st_mtime_ns for path in survivors]
    (out / "shard-00007.partial").mkdir(exist_ok=True)  # as a kill while writing leaves it
    (out / "shard-00007.partial" / "inputs.npy").write_bytes(b"half")
    folders = curate(RECIPE, out, count=200, seed=3, shard_length=25)
    assert [(path / "manifest.json").stat().st_mtime_ns for path in survivors] == stamps
    assert sorted(out.iterdir()) == folders
    curate(RECIPE, tmp_path / "whole", count=200, seed=3, shard_length=25)
    assert whole_bytes(out) == whole_bytes(tmp_path / "whole")


def test_a_full_disk_costs_what_is_unfinished_only(tmp_path, monkeypatch):
    real = pathlib.Path.open

    def full(self, *args, **kwargs):  # fails with ENOSPC on writing, as a full disk does
        return real(pathlib.Path("/dev/full") if "shard-00002" in str(self) else self, *args, **kwargs)

    monkeypatch.setattr(pathlib.Path, "open", full)
    rule = r"curate: .*No space left on device.*; 2 of 4 shards are finished and stay: the same call goes on"
    with pytest.raises(OSError, match=rule) as caught:
        curate(RECIPE, tmp_path / "out", count=20, seed=0, shard_length=5)
    assert caught.value.errno == errno.ENOSPC
    monkeypatch.undo()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["shard-00000", "shard-00001"]
    curate(RECIPE, tmp_path / "out", count=20, seed=0, shard_length=5)
    curate(RECIPE, tmp_path / "whole", count=20, seed=0, shard_length=5)
    assert whole_bytes(tmp_path / "out") == whole_bytes(tmp_path / "whole")


def test_a_file_that_may_not_grow_is_named(tmp_path):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
    try:
        with pytest.raises(OSError, match=r"File too large.*; 0 of 1 shards are finished") as caught:
            curate(RECIPE, tmp_path / "out", count=16, seed=0)  # 16 inputs are 524,288 bytes
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("damage_done", ["cut", "flipped", "emptied"])
def test_a_damaged_shard_is_never_taken_for_finished(tmp_path, damage_done):
    folders = curate(RECIPE, tmp_path, count=10, seed=0, shard_length=5)
    path = folders[0] / ("manifest.json" if damage_done == "emptied" else "labels.npy")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes({"cut": content[:-9], "flipped": content, "emptied": b""}[damage_done])
    with pytest.raises(ValueError, match=f"read_shard: .*{path.name}"):
        curate(RECIPE, tmp_path, count=10, seed=0, shard_length=5)
    assert path.exists()  # nothing is thrown away unasked
    shutil.rmtree(folders[0])
    curate(RECIPE, tmp_path, count=10, seed=0, shard_length=5)
    read_shard(folders[0], verify=True)


def test_a_sample_that_fails_is_named(tmp_path, monkeypatch):
    real = pairs.sample_cube

    def failing(rng, recipe):
        if np.random.default_rng([0, 21]).bit_generator.state == rng.bit_generator.state:
            raise ZeroDivisionError("no such cube")
        return real(rng, recipe)

    monkeypatch.setattr(pairs, "sample_cube", failing)
    with pytest.raises(SampleError, match="curate: sample 21 of seed 0: ZeroDivisionError: no such cube"):
        curate(RECIPE, tmp_path / "out", count=30, seed=0)
    assert not list(tmp_path.rglob("shard*"))


def test_progress_goes_to_stderr_and_silence_is_the_default(tmp_path, capsys):
    curate(RECIPE, tmp_path / "quiet", count=2, seed=0)
    assert capsys.readouterr() == ("", "")
    curate(RECIPE, tmp_path / "loud", count=2, seed=0, progress=True)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "cube" in shown.err
