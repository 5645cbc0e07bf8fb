import csv
import fnmatch
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from unghost.data_recipes.meshes.files import read_mesh_file
from unghost.data_recipes.meshes.guard import GuardLimits, MeshGuard, mesh_paths, read_folder
from unghost.data_recipes.meshes.repair import RepairOptions, topology

pytest.importorskip("trimesh")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="the guard needs POSIX")

ROOT = Path(__file__).resolve().parents[3]
SHARED = ROOT.parent / "shared" / "data"
CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
FACES = "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"


def tangle(corners):
    """A face of random corners, which crosses itself: cutting it into triangles takes quadratic time."""
    ring = np.random.default_rng(0).random((corners, 2))
    return "".join(f"v {x} {y} 0\n" for x, y in ring), "f " + " ".join(map(str, range(1, corners + 1))) + "\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "a.obj").write_text(CUBE + FACES)
    (tmp_path / "b.obj").write_text(CUBE.replace("1", "nan") + FACES)
    (tmp_path / "c.obj").write_text(CUBE)
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "d.ply").write_bytes(b"ply\n")
    (tmp_path / "deep" / "e.OBJ").write_text(CUBE + FACES)
    (tmp_path / "notes.txt").write_text("no mesh")
    vertices, face = tangle(20_000)
    (tmp_path / "slow.obj.kept").write_text(vertices + face * 40)
    return tmp_path


@pytest.mark.slow
def test_a_bad_mesh_costs_itself(folder):
    outcomes = list(read_folder(folder))
    assert [(o.path.as_posix(), o.status) for o in outcomes] == [
        ("a.obj", "loaded"),
        ("b.obj", "rejected"),
        ("c.obj", "empty"),
        ("deep/d.ply", "rejected"),
        ("deep/e.OBJ", "loaded"),
    ]
    assert [o.reason for o in outcomes] == [
        "",
        "54 coordinates of corners are not finite",
        "no triangles",
        "the PLY header does not end with a line end_header",
        "",
    ]
    assert [o.mesh is None for o in outcomes] == [False, True, True, True, False]


@pytest.mark.slow
def test_what_comes_back_is_what_reading_gives(folder):
    here = read_mesh_file(folder / "a.obj")
    with MeshGuard(folder) as guard:
        there = guard.read("a.obj").mesh
        again = guard.read(folder / "a.obj").mesh
    for read in (there, again):
        np.testing.assert_array_equal(read.triangles, here.triangles)
        np.testing.assert_array_equal(read.center, here.center)
        assert (read.extent, read.dropped, read.sha256, read.side_files) == (1, 0, here.sha256, ())
    assert guard.starts == 1
    assert guard.pid is None


@pytest.mark.slow
def test_named_files_may_be_missing_or_outside(folder):
    (folder / "deep" / "link.obj").symlink_to(folder / "a.obj")
    outcomes = list(read_folder(folder / "deep", ["absent.obj", "../a.obj", folder / "a.obj", "link.obj", "."]))
    assert {o.status for o in outcomes} == {"rejected"}
    assert "is not a file" in outcomes[0].reason
    assert [o.reason for o in outcomes[1:4]] == ["the path leads outside the folder"] * 3
    assert "no regular file" in outcomes[4].reason
    with pytest.raises(NotADirectoryError, match="is not a folder"):
        MeshGuard(folder / "a.obj")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        (GuardLimits(cpu_seconds=1), "it computed for longer than 1 s"),
        (GuardLimits(wall_seconds=1), "it took longer than 1 s"),
    ],
)
def test_a_file_that_takes_too_long_is_left_and_the_next_one_read(folder, limits, reason):
    (folder / "slow.obj.kept").rename(folder / "aslow.obj")
    with MeshGuard(folder) as guard:
        assert guard.read("a.obj").status == "loaded"
        guard.limits = limits
        outcome = guard.read("aslow.obj")
        assert (outcome.status, outcome.reason) == ("rejected", reason)
        assert outcome.seconds >= 0.9
        guard.limits = GuardLimits()
        assert guard.read("a.obj").status == "loaded"
        assert guard.starts == 2


@pytest.mark.slow
def test_a_file_that_needs_too_much_memory_is_rejected(folder):
    """A sound mesh of 1.2 million triangles (86 MB of corners) with 64 MB to read it in."""
    faces = np.zeros(1_200_000, dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, [0, 1, 2]
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4")
    (folder / "big.ply").write_bytes(header.encode() + points.tobytes() + faces.tobytes())
    with MeshGuard(folder, limits=GuardLimits(memory_megabytes=64)) as guard:
        assert guard.read("a.obj").status == "loaded"
        if not guard.memory_capped:
            pytest.skip("this platform does not limit memory")
        outcome = guard.read("big.ply")
        assert (outcome.status, outcome.reason) == ("rejected", "it needs more memory than is allowed")
        assert guard.read("a.obj").status == "loaded"
        assert guard.starts == 2
    with MeshGuard(folder, limits=GuardLimits(wall_seconds=600)) as guard:
        assert len(guard.read("big.ply").mesh.triangles) == len(faces)


@pytest.mark.slow
def test_a_reader_that_dies_between_files_is_started_again(folder):
    with MeshGuard(folder) as guard:
        assert guard.read("a.obj").status == "loaded"
        os.kill(guard.pid, signal.SIGKILL)
        assert guard.read("a.obj").status == "loaded"
        assert guard.starts == 2


@pytest.mark.slow
def test_a_reader_that_crashes_on_a_file_rejects_it(folder):
    (folder / "slow.obj.kept").rename(folder / "aslow.obj")
    with MeshGuard(folder) as guard:
        assert guard.read("a.obj").status == "loaded"
        crash = threading.Timer(1.0, os.kill, (guard.pid, signal.SIGSEGV))
        crash.start()
        outcome = guard.read("aslow.obj")
        crash.join()
        assert outcome.status == "rejected"
        assert outcome.reason == "the reader died of it (SIGSEGV)"
        assert guard.read("a.obj").status == "loaded"


@pytest.mark.slow
def test_nobody_is_called(folder):
    """A glTF whose buffer and image lie on a server that listens: no connection is made."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        url = f"http://127.0.0.1:{server.getsockname()[1]}/a.bin"
        tree = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "images": [{"uri": url}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "buffers": [{"byteLength": 36, "uri": url}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
        }
        (folder / "a.gltf").write_text(json.dumps(tree))
        (outcome,) = read_folder(folder, ["a.gltf"])
        assert outcome.status == "rejected"
        assert "no relative path" in outcome.reason
        with pytest.raises(TimeoutError):
            server.accept()


REFUSED = [
    "__import__('socket').create_connection(('127.0.0.1', 9), 1)",
    "__import__('urllib.request').request.urlopen('http://127.0.0.1:9/')",
    "__import__('subprocess').run(['true'])",
    "__import__('os').system('true')",
    "__import__('os').fork()",
    "open('inside/b', 'w')",
    "__import__('os').remove('inside/a')",
    "open('outside')",
    "open('inside/../outside')",
    "open('inside/link')",
]
ALLOWED = ["open('inside/a').close()", "__import__('colorsys')"]


def test_the_fence(tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "a").write_text("a")
    (tmp_path / "outside").write_text("b")
    (tmp_path / "inside" / "link").symlink_to(tmp_path / "outside")
    code = (
        "import sys, os, json, socket, urllib.request, subprocess\n"
        "from unghost.data_recipes.meshes.worker import Fence\n"
        "fence = Fence(); fence.root = os.path.realpath('inside')\n"
        "fence.libraries = tuple(p for p in fence.libraries if p != os.getcwd())\n"
        "sys.addaudithook(fence)\n"
        "def end(attempt):\n"
        "    try: eval(attempt)\n"
        "    except Exception as error: return str(error)\n"
        "print(json.dumps([end(attempt) for attempt in json.loads(sys.argv[1])]))"
    )
    path = os.pathsep.join(p or os.getcwd() for p in sys.path)
    run = subprocess.run(
        [sys.executable, "-B", "-c", code, json.dumps(REFUSED + ALLOWED)],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
    )
    ends = json.loads(run.stdout)
    for attempt, end in zip(REFUSED, ends, strict=False):
        assert "is forbidden while a mesh file is read" in str(end), attempt
    assert ends[len(REFUSED) :] == [None, None]
    assert (tmp_path / "inside" / "a").exists()
    assert not (tmp_path / "inside" / "b").exists()


def test_missing_trimesh_names_the_extra(folder, monkeypatch, tmp_path):
    (tmp_path / "trimesh.py").write_text("raise ImportError('not here')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with MeshGuard(folder) as guard, pytest.raises(ImportError, match=r"pip install unghost\[recipes\]"):
        guard.read("a.obj")


def test_a_reader_that_cannot_start_is_no_fault_of_the_file(folder, monkeypatch, tmp_path):
    (tmp_path / "trimesh.py").write_text("import os\nos._exit(3)")
    monkeypatch.syspath_prepend(str(tmp_path))
    with MeshGuard(folder) as guard, pytest.raises(RuntimeError, match=r"did not start .*exit status 3"):
        guard.read("a.obj")


@pytest.mark.parametrize(
    ("name", "value"),
    [("wall_seconds", 0), ("cpu_seconds", -1), ("memory_megabytes", 63), ("startup_seconds", float("inf"))],
)
def test_limits_have_ranges(name, value):
    with pytest.raises(ValueError, match=f"GuardLimits: {name} must be finite and > "):
        GuardLimits(**{name: value})


@pytest.mark.slow
def test_repair_behind_the_guard(folder):
    pytest.importorskip("pymeshlab")
    (folder / "open.obj").write_text(CUBE + FACES[10:] + "v 9 9 9\n")
    with MeshGuard(folder, repair=RepairOptions()) as guard:
        mended = guard.read("open.obj").mesh
        assert guard.read("b.obj").status == "rejected"
    assert topology(read_mesh_file(folder / "open.obj").triangles).boundary_edges == 4
    assert topology(mended.triangles).closed
    assert mended.extent == pytest.approx(1)
    assert mended.center == pytest.approx([0.5] * 3)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="no data folder beside the project")
@pytest.mark.shared_data
def test_every_hostile_file_ends_as_it_should():
    """All files, in one run, by the manifest, and by the table of choices where that leaves the outcome open."""
    root = SHARED / "hostile"
    with (root / "manifest.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    ends = {"load": "loaded", "empty": "empty", "reject": "rejected"}
    table = (ROOT / "docs" / "hostile_meshes.md").read_text(encoding="utf-8").split("## Choices")[1]
    choices = re.findall(r"^\| `(.+?)` \| (loaded|empty|rejected) \|", table, re.MULTILINE)
    assert len(choices) > 20
    limits = GuardLimits(cpu_seconds=10, memory_megabytes=1024)
    outcomes = list(read_folder(root, [row["path"] for row in rows], limits=limits))
    wrong = []
    for row, outcome in zip(rows, outcomes, strict=True):
        assert (outcome.status == "loaded") == (outcome.mesh is not None) == (not outcome.reason)
        chosen = next((end for pattern, end in choices if fnmatch.fnmatchcase(row["path"], pattern)), None)
        if ends.get(row["expect"], chosen) != outcome.status:
            wrong.append((row["path"], row["expect"], chosen, outcome.status, outcome.reason))
    assert not wrong
    assert len(outcomes) == len(rows) > 200


def test_the_order_of_a_folder_is_that_of_its_names(tmp_path):
    for name in ("b/a.obj", "a.stl", "B.PLY", "a/z.glb", "x.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert [p.as_posix() for p in mesh_paths(tmp_path)] == ["B.PLY", "a.stl", "a/z.glb", "b/a.obj"]
