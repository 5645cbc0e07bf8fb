"""Sound mesh files: what is read is what is in them."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.data_recipes.meshes.files import load_mesh, normalise, read_mesh_file
from unghost.data_recipes.meshes.reading import MeshEmpty, MeshRejected, triangulate

trimesh = pytest.importorskip("trimesh")

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason="no data folder beside the project")


@pytest.mark.parametrize("suffix", ["obj", "off", "ply", "stl", "glb"])
def test_agrees_with_trimesh_on_sound_files(tmp_path, suffix):
    """Two bodies, moved: the same triangles as trimesh has, at unit size."""
    body = trimesh.util.concatenate(
        [
            trimesh.creation.icosphere(subdivisions=2),
            trimesh.creation.box(extents=(1, 2, 7)).apply_translation([9, 0, 0]),
        ]
    )
    body.export(tmp_path / f"body.{suffix}")
    read = read_mesh_file(tmp_path / f"body.{suffix}")
    assert read.extent == pytest.approx(10.5, rel=1e-6)  # from -1 to 9.5 along x
    np.testing.assert_allclose(read.center, [4.25, 0, 0], atol=1e-6)
    np.testing.assert_allclose(read.triangles * read.extent + read.center, body.triangles, atol=1e-5)
    assert np.ptp(read.triangles.reshape(-1, 3), axis=0) == pytest.approx([1, 2 / 10.5, 7 / 10.5], rel=1e-6)
    assert read.dropped == 0


@pytest.mark.parametrize("ascii_", [True, False])
def test_text_and_binary_ply_and_stl(tmp_path, ascii_):
    ball = trimesh.creation.icosphere(subdivisions=1)
    (tmp_path / "a.ply").write_bytes(trimesh.exchange.ply.export_ply(ball, encoding="ascii" if ascii_ else "binary"))
    ball.export(tmp_path / "a.stl", file_type="stl_ascii" if ascii_ else "stl")
    for name in ("a.ply", "a.stl"):
        read = read_mesh_file(tmp_path / name)
        np.testing.assert_allclose(read.triangles * read.extent + read.center, ball.triangles, atol=1e-6)


def test_the_hash_is_of_the_bytes_and_side_files_have_their_own(tmp_path, samples):
    import hashlib

    tree = samples.gltf(buffers=[{"byteLength": 56, "uri": "the%20data.bin"}])
    data = samples.corners.tobytes() + samples.strip.tobytes()
    (tmp_path / "the data.bin").write_bytes(data)
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    read = read_mesh_file(tmp_path / "a.gltf")
    assert read.sha256 == hashlib.sha256((tmp_path / "a.gltf").read_bytes()).hexdigest()
    assert read.side_files == (("the%20data.bin", hashlib.sha256(data).hexdigest()),)
    assert len(read.triangles) == 2


def test_node_transforms_are_applied(written, samples):
    """Two squares, one moved by 3: 4 long. Scale 2 of the parent makes no difference after normalising."""
    nodes = [{"children": [1, 2], "scale": [2, 2, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]
    read = read_mesh_file(written(samples.gltf(nodes=nodes), "gltf"))
    assert read.extent == pytest.approx(8)
    assert len(read.triangles) == 4
    assert np.ptp(read.triangles.reshape(-1, 3), axis=0) == pytest.approx([1, 0.25, 0])


@pytest.mark.parametrize("order", ["little", "big"])
def test_binary_ply_of_mixed_polygons(written, order, area):
    """A square and a triangle whose lists are 4, 3 long: a reader that takes the first length for all misreads it."""
    mark = "<" if order == "little" else ">"
    header = (
        f"ply\nformat binary_{order}_endian 1.0\nelement vertex 5\nproperty double x\nproperty double y\n"
        "property double z\nelement face 3\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
    )
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [4, 0, 0]], dtype=mark + "f8")
    rows = [([0, 1, 2, 3], 9), ([1, 4, 2], 8), ([1, 2, 4], 7)]
    body = b"".join(bytes([len(r)]) + np.array(r, dtype=mark + "i4").tobytes() + bytes([red]) for r, red in rows)
    read = read_mesh_file(written(header.encode() + points.tobytes() + body, "ply"))
    assert len(read.triangles) == 4
    assert area(read.triangles * read.extent).sum() == pytest.approx(4 + 2 + 2)


def test_concave_polygons_are_cut_inside(area):
    """An L of area 3, from each starting corner; fans from four of its six corners would cover more."""
    ell = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for first in range(6):
        for ring in (ell, ell[::-1]):
            ring = np.roll(ring, first, axis=0) @ turn.T + 5
            pieces = triangulate(ring, np.array([6]), np.arange(6))
            assert pieces.shape == (4, 3, 3)
            assert area(pieces).sum() == pytest.approx(3)


@given(st.integers(0, 2**32 - 1), st.integers(4, 24))
@settings(max_examples=30, deadline=None)
def test_star_shaped_polygons_keep_their_area(area, seed, n):
    rng = np.random.default_rng(seed)
    angles = (np.arange(n) + rng.uniform(0, 0.9, n)) * 2 * np.pi / n
    radii = rng.uniform(0.2, 1, n)
    x, y = radii * np.cos(angles), radii * np.sin(angles)
    exact = np.abs(x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2  # the centre sees every edge ...
    if np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() < np.pi:  # ... unless an edge passes behind it
        pieces = triangulate(np.stack([x, y, 0 * x], axis=1), np.array([n]), np.arange(n))
        assert area(pieces).sum() == pytest.approx(exact)


def newell(ring):
    """Vector area of a polygon ``(n, 3)``."""
    return np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0) / 2


def assert_cut_inside(ring, area):
    """Turned as the polygon and covering its area once: no overlap, nothing outside."""
    pieces = triangulate(ring, np.array([len(ring)]), np.arange(len(ring)))
    vectors = np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]) / 2
    whole = newell(ring)
    np.testing.assert_allclose(vectors.sum(axis=0), whole, rtol=1e-9, atol=1e-12)
    assert area(pieces).sum() == pytest.approx(np.linalg.norm(whole), rel=1e-9)
    return pieces


def spiral(n, *, pitch, turns):
    """A ribbon of ``n`` corners wound about the origin."""
    angles = np.linspace(0, 2 * np.pi * turns, n // 2)
    radii = 1 + pitch * angles / (2 * np.pi)
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    return np.concatenate([radii[:, None] * circle, ((radii + pitch / 2)[:, None] * circle)[::-1]])


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.booleans(), st.floats(-6, 6))
@settings(max_examples=40, deadline=None)
def test_spirals_in_any_plane_keep_their_area(area, seed, half, turned, exponent):
    rng = np.random.default_rng(seed)
    ring = spiral(2 * half + 20, pitch=rng.uniform(0.2, 2), turns=(2 * half + 20) / 40)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    ring = np.roll(ring, rng.integers(len(ring)), axis=0)[:: -1 if turned else 1] @ turn.T * 10**exponent
    pieces = assert_cut_inside(ring, area)
    assert len(pieces) == len(ring) - 2


def test_a_spiral_of_many_corners_and_one_of_too_many(area):
    assert_cut_inside(spiral(5000, pitch=1.0, turns=50), area)
    ring = spiral(20_002, pitch=1.0, turns=50)
    with pytest.raises(MeshRejected, match="a concave polygon of 20002 corners, more than 20000"):
        triangulate(ring, np.array([len(ring)]), np.arange(len(ring)))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_quads_with_any_reflex_corner_are_cut_inside(area, seed):
    """A triangle with a fourth corner inside it, put between any two of its corners, is a concave quad."""
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(3)) * 0.97 + 0.01
    corners = rng.normal(size=(3, 3))
    ring = np.insert(corners, rng.integers(1, 4), weights @ corners, axis=0)[:: rng.choice([-1, 1])]
    pieces = assert_cut_inside(np.roll(ring, rng.integers(4), axis=0), area)
    assert len(pieces) == 2


def test_a_hole_reached_by_a_slit_stays_open(area):
    """A square of side 4 with a square hole of side 2: the polygon touches itself along the slit."""
    outer = [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [0, 0, 0]]
    hole = [[1, 1, 0], [1, 3, 0], [3, 3, 0], [3, 1, 0], [1, 1, 0]]
    ring = np.array([*outer, *hole], dtype=float)
    for first in range(10):
        assert area(assert_cut_inside(np.roll(ring, first, axis=0), area)).sum() == pytest.approx(12)


def test_straight_corners_and_spikes_add_no_area(area):
    """An L with a corner amid every edge, and one with a hair that goes out and back."""
    ell = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
    amid = (ell + np.roll(ell, -1, axis=0)) / 2
    straight = np.stack([ell, amid], axis=1).reshape(-1, 3)
    hair = np.insert(ell, 1, [[1, 0, 0], [1, -1, 0], [1, 0, 0]], axis=0)
    for ring in (straight, hair):
        assert area(assert_cut_inside(ring, area)).sum() == pytest.approx(3)


def test_polygons_that_cross_themselves_stay_fans():
    """No cut covers them once, so that none is better: a pentagram and a bow tie, beside a sound triangle."""
    angles = np.arange(5) * 4 * np.pi / 5
    star = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    bow = np.array([[0, 0, 0], [3, 2, 0], [3, 0, 0], [0, 1, 0]], dtype=float)
    vertices = np.concatenate([star, bow, [[0, 0, 1], [1, 0, 1], [0, 1, 1]]])
    pieces = triangulate(vertices, np.array([5, 4, 3]), np.arange(12))
    fan = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [5, 6, 7], [5, 7, 8], [9, 10, 11]]
    np.testing.assert_array_equal(pieces, vertices[fan])


def test_polygons_keep_their_order(area):
    """Concave and convex ones of 3 to 6 corners, mixed: each one's triangles stand where it stood."""
    ell = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
    dart = np.array([[0, 0, 0], [1, 1, 0], [0, 3, 0], [-1, 1, 0]]) * np.array([1, -1, 1]) + [0, 3, 0]
    notch = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 0.5, 0], [0, 2, 0]])
    square, corner = ell[[0, 1, 1, 5]] + [[0, 0, 0], [0, 0, 0], [0, 2, 0], [0, 0, 0]], ell[[0, 1, 5]]
    rings = [ell, square, dart, corner, notch, square, ell, notch]
    rings = [ring + np.array([0, 0, 10 * i]) for i, ring in enumerate(rings)]
    counts = np.array([len(ring) for ring in rings])
    pieces = triangulate(np.concatenate(rings), counts, np.arange(counts.sum()))
    heights = np.repeat(10.0 * np.arange(len(rings)), counts - 2)
    np.testing.assert_array_equal(pieces[:, :, 2], heights[:, None].repeat(3, axis=1))
    for i, ring in enumerate(rings):
        assert area(pieces[heights == 10 * i]).sum() == pytest.approx(np.linalg.norm(newell(ring)))


def test_only_concave_polygons_need_earcut(monkeypatch):
    monkeypatch.setitem(sys.modules, "mapbox_earcut", None)
    ell = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
    assert len(triangulate(ell, np.array([4]), np.array([0, 1, 4, 5]))) == 2
    with pytest.raises(ImportError, match=r"mapbox_earcut: pip install unghost\[recipes\]"):
        triangulate(np.roll(ell, 1, axis=0), np.array([6]), np.arange(6))


def test_far_from_the_origin_in_double_precision(written, samples):
    read = read_mesh_file(
        written(samples.square_obj.replace("v 0", "v 100000000").replace("v 2", "v 100000002"), "obj")
    )
    assert read.extent == 2
    assert read.center.tolist() == [100000001, 1, 0]


def test_normalise_by_hand():
    soup = np.array([[[1, 1, 1], [5, 1, 1], [1, 3, 1]], [[1, 1, 1], [3, 1, 1], [5, 1, 1]]], dtype=float)
    kept = soup.copy()
    triangles, center, extent, dropped = normalise(soup)
    assert (extent, dropped) == (4, 1)
    assert center.tolist() == [3, 2, 1]
    assert triangles.tolist() == [[[-0.5, -0.25, 0], [0.5, -0.25, 0], [-0.5, 0.25, 0]]]
    np.testing.assert_array_equal(soup, kept)


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        ("obj", "v 0 0 0\nv 1 0 0\nl 1 2\n"),
        ("off", "OFF 1 0 0\n0 0 0\n"),
        ("ply", lambda s: s.triangle_ply.replace("face 1", "face 0").replace("3 0 1 2\n", "")),
        ("stl", b"\0" * 84),
        ("stl", "solid\nendsolid\n"),
        ("gltf", {"asset": {"version": "2.0"}}),
        ("gltf", lambda s: s.gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]}])),
        ("dae", lambda s: s.dae(nodes="")),
    ],
)
def test_sound_files_without_triangles_are_empty(written, suffix, content):
    with pytest.raises(MeshEmpty, match="no triangles"):
        read_mesh_file(written(content, suffix))


@pytest.mark.parametrize(
    "changed",
    [
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.encode("utf-16"),
        lambda text: b"\xef\xbb\xbf" + text.encode(),
        lambda text: text.replace("f 1 2 ", "f 1/7/ \\\n 2//3 "),
        lambda text: text.replace("f 1 2 3 4", "f -4 -3 -2 -1"),
        lambda text: "# caf\xe9\n".encode("latin-1") + text.encode(),
        lambda text: "v 1e9 0 0\n" + text.replace("f 1 2 3 4", "f 2 3 4 5"),
    ],
)
def test_odd_but_sound_obj_files_are_the_same_square(written, samples, changed, area):
    read = read_mesh_file(written(changed(samples.square_obj), "obj"))
    assert read.extent == 2
    assert area(read.triangles).sum() == pytest.approx(1)


def test_what_no_scene_shows_does_not_matter(written, samples):
    """A broken accessor, a remote image and a material that is not there, none of which bears on the geometry."""
    tree = samples.gltf(
        images=[{"uri": "http://127.0.0.1:9/a.png"}], accessors=[*samples.accessor(), {"bufferView": 99}]
    )
    tree["meshes"][0]["primitives"][0]["material"] = 5
    tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = 77
    assert len(read_mesh_file(written(tree, "gltf")).triangles) == 2


def test_collada_keeps_its_geometry_without_its_materials(written, samples):
    bound = "<instance_geometry url='#g'><bind_material><technique_common><instance_material symbol='m' target='#no'/>"
    bound += "</technique_common></bind_material></instance_geometry>"
    moved = f"<node><translate>0 3 0</translate>{bound}</node><node>{bound}</node>"
    read = read_mesh_file(written(samples.dae(nodes=moved), "dae"))
    assert len(read.triangles) == 4
    assert read.extent == pytest.approx(4)


def test_load_mesh_is_the_drop_in(written, samples):
    mesh = load_mesh(written(samples.square_obj, "obj"))
    assert np.ptp(mesh.triangles.reshape(-1, 3), axis=0).tolist() == [1, 1, 0]
    assert len(mesh.cumulative_areas) == 2
    with pytest.raises(ValueError, match=r"load_mesh: .*mesh\.obj: line 1: 'nonsense'"):
        load_mesh(written("nonsense", "obj"))


@needs_shared
@pytest.mark.shared_data
def test_real_meshes_agree_with_trimesh(area):
    """Every 25th file of the shared folder: as many triangles, the same bounds and area, and the manifest's hash."""
    root = SHARED / "meshes"
    with (root / "manifest.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if not row["path"].lower().endswith(".dae")]
    for row in rows[::25]:
        read = read_mesh_file(root / row["path"], root=root)
        assert read.sha256 == row["sha256"]
        scene = trimesh.load_scene(root / row["path"], process=False, skip_materials=True)
        plain = np.concatenate(
            [
                trimesh.transform_points(scene.geometry[name].vertices, matrix)[scene.geometry[name].faces]
                for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)
                if isinstance(scene.geometry[name], trimesh.Trimesh)
            ]
        )
        assert len(plain) == len(read.triangles) + read.dropped
        assert area(plain).sum() == pytest.approx(area(read.triangles).sum() * read.extent**2, rel=1e-9)
        assert np.ptp(plain.reshape(-1, 3), axis=0).max() == pytest.approx(read.extent)
