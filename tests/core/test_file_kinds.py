"""Every kind of file that people hand to ``clean`` is told by its content, whatever its name."""

import gzip
import json
import struct
import zipfile
import zlib

import numpy as np
import pytest

from unghost.core import file_kinds as kinds
from unghost.core.file_kinds import file_kind, not_readable


def ply(*lines, form="binary_little_endian"):
    return "\n".join(["ply", f"format {form} 1.0", *lines, "end_header", ""]).encode() + bytes(256)


def floats(*names):
    return [f"property float {name}" for name in names]


SPLAT_VERTEX = ["element vertex 4", *floats("x", "y", "z", "opacity", "scale_0", "rot_0")]
POINT_VERTEX = ["element vertex 4", *floats("x", "y", "z"), "property uchar red"]


def splat_rows(count):
    rng = np.random.default_rng(0)
    rows = np.zeros(count, [("place", "<f4", 3), ("extent", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])
    rows["place"], rows["extent"] = rng.normal(size=(count, 3)), rng.uniform(0.01, 0.1, (count, 3))
    rows["rgba"] = rng.integers(0, 256, (count, 4))
    turn = rng.normal(size=(count, 4))
    rows["turn"] = np.clip(np.round(turn / np.linalg.norm(turn, axis=1, keepdims=True) * 128 + 128), 0, 255)
    return rows.tobytes()


def ksplat(sections=1, splats=10):
    header = bytearray(4096)
    header[1] = 1
    header[4:20] = struct.pack("<4I", sections, sections, splats, splats)
    return bytes(header) + bytes(1024 * sections) + bytes(24 * splats)


SNAPSHOT = b"\x82\xa8encoding\x81\xa5otype\xa8HashGrid\xa8snapshot\x80"

FILES = {
    "SPLATS": ply(*SPLAT_VERTEX),
    "COMPRESSED_PLY": ply("element chunk 1", *floats("min_x"), "element vertex 4", "property uint packed_position"),
    "SPZ": gzip.compress(b"NGSP" + bytes(60)),
    "SPLAT": splat_rows(50),
    "KSPLAT": ksplat(),
    "SOG": json.dumps({"means": {"files": ["means_l.webp"]}}).encode(),
    "ASCII_PLY": ply(*SPLAT_VERTEX, form="ascii"),
    "BIG_ENDIAN_PLY": ply(*SPLAT_VERTEX, form="binary_big_endian"),
    "MESH_PLY": ply(*POINT_VERTEX, "element face 2", "property list uchar int vertex_indices"),
    "POINTS_PLY": ply(*POINT_VERTEX, "element face 0", "property list uchar int vertex_indices"),
    "BROKEN_PLY": b"ply\nformat ascii 1.0\nelement vertex 4\n",
    "LFS_POINTER": b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
    "NPY": b"\x93NUMPY\x01\x00" + bytes(120),
    "SNAPSHOT": gzip.compress(SNAPSHOT),
    "CHECKPOINT": b"\x80\x02}q\x00.",
    "BROKEN_ZIP": b"PK\x03\x04" + bytes(200),
    "ARCHIVE": gzip.compress(b"a tar, say"),
    "GLTF": b"glTF" + bytes(60),
    "EMPTY": b"",
    "UNKNOWN": b"solid cube\nfacet normal 0 0 1\n",
}


@pytest.mark.parametrize("suffix", [".ply", ".NPZ", ".splat", ""])
@pytest.mark.parametrize("name", FILES)
def test_the_content_decides(tmp_path, name, suffix):
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(FILES[name])
    kind = file_kind(path)
    assert kind is getattr(kinds, name)
    error = str(not_readable(path, kind, caller="clean"))
    assert error == f"clean: {path} is {kind.name}: {kind.advice}"
    assert "pickle" not in error


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("SPZ", b"NGSP\x04\x00\x00\x00" + bytes(60)),  # version 4 is not packed as a whole
        ("SNAPSHOT", SNAPSHOT),
        ("SNAPSHOT", zlib.compress(SNAPSHOT)),
        ("SPLATS", ply(*SPLAT_VERTEX, "element face 2", "property list uchar int vertex_indices")),
        ("SPLATS", ply(*SPLAT_VERTEX).replace(b"\n", b"\r\n")),
        ("SPLATS", ply(*(line.replace("vertex 4", "vertex 0") for line in SPLAT_VERTEX))),
        ("SPLAT", splat_rows(5000)),
        ("UNKNOWN", splat_rows(50)[:-1]),
        ("UNKNOWN", np.random.default_rng(1).bytes(32 * 500)),
        ("UNKNOWN", bytes(32 * 500)),
        ("UNKNOWN", ksplat(sections=3)[: 4096 + 1024]),
        ("UNKNOWN", b"\x1f\x8bno gzip"),
        ("UNKNOWN", b'{"frames": []}'),
    ],
)
def test_more_of_them(tmp_path, name, content):
    (tmp_path / "a").write_bytes(content)
    assert file_kind(tmp_path / "a") is getattr(kinds, name)


@pytest.mark.parametrize(
    ("name", "members"),
    [
        ("GRID", ["density.npy", "aabb.npy"]),
        ("GRID", ["other.npy"]),
        ("KEEP_MASK", ["manifest.npy", "cells.npy"]),
        ("SOG", ["meta.json", "means_l.webp"]),
        ("SOG", ["scene/meta.json", "scene/means_l.webp"]),
        ("CHECKPOINT", ["archive/data.pkl", "archive/data/0"]),
        ("ARCHIVE", ["point_cloud.ply"]),
    ],
)
def test_zip_archives(tmp_path, name, members):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for member in members:
            archive.writestr(member, b"0")
    assert file_kind(tmp_path / "a.zip") is getattr(kinds, name)


def test_folders_and_nothing(tmp_path):
    assert file_kind(tmp_path) is kinds.FOLDER
    (tmp_path / "meta.json").write_text("{}")
    (tmp_path / "means_l.webp").write_bytes(b"")
    assert file_kind(tmp_path) is kinds.SOG
    with pytest.raises(FileNotFoundError, match=r"clean: no file .*none"):
        file_kind(tmp_path / "none", caller="clean")


def test_every_kind_says_what_to_do():
    found = [value for value in vars(kinds).values() if isinstance(value, kinds.FileKind)]
    assert len(found) == len({kind.name for kind in found}) > 15
    assert all(kind.advice and "\n" not in kind.name + kind.advice for kind in found)
