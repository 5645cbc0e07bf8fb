import gzip
import io
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.fields.adapters import instant_ngp
from unghost.fields.adapters.instant_ngp import CELLS, SHORTEST_STEP, InstantNgpGrid, load_instant_ngp, morton_index


def pack(value):
    """MessagePack of the few kinds that a snapshot has, always in the long form."""
    if isinstance(value, bool):
        return b"\xc3" if value else b"\xc2"
    if isinstance(value, int):
        return b"\xce" + struct.pack(">I", value)
    if isinstance(value, float):
        return b"\xcb" + struct.pack(">d", value)
    if isinstance(value, str):
        return b"\xdb" + struct.pack(">I", len(value)) + value.encode()
    if isinstance(value, bytes):
        return b"\xc6" + struct.pack(">I", len(value)) + value
    if isinstance(value, list):
        return b"\xdd" + struct.pack(">I", len(value)) + b"".join(map(pack, value))
    return b"\xdf" + struct.pack(">I", len(value)) + b"".join(pack(k) + pack(v) for k, v in value.items())


def snapshot(cells, **changes):
    """A whole snapshot of ``cells (cascades, 128^3)`` in Morton order; ``changes`` replace entries of "snapshot"."""
    inner = {
        "version": 1,
        "mode": "nerf",
        "params_binary": b"\x01" * 5000,
        "density_grid_size": 128,
        "density_grid_binary": np.asarray(cells, "<f2").tobytes(),
        "aabb": {"min": [0.0, 0.0, 0.0], "max": [1.0, 1.0, 1.0]},
        "nerf": {"aabb_scale": 1, "dataset": {"scale": 0.33, "offset": [0.5, 0.5, 0.5], "from_mitsuba": False}},
    }
    inner |= changes
    return {"encoding": {"otype": "HashGrid"}, "snapshot": {key: value for key, value in inner.items() if value != ""}}


def write(path, content, *, packed=False):
    data = pack(content)
    path.write_bytes(gzip.compress(data, 1) if packed else data)
    return path


def interleave(x, y, z):
    """Morton code bit by bit."""
    return sum(((x >> b & 1) << 3 * b) | ((y >> b & 1) << 3 * b + 1) | ((z >> b & 1) << 3 * b + 2) for b in range(7))


EMPTY = np.zeros((1, CELLS**3), "<f2")


def test_morton():
    order = morton_index()
    for cell in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (127, 127, 127), (5, 99, 64)]:
        assert order[cell] == interleave(*cell)
    assert morton_index(2).tolist() == [[[0, 4], [2, 6]], [[1, 5], [3, 7]]]
    assert sorted(order.ravel()) == list(range(CELLS**3))
    with pytest.raises(ValueError, match="power of two, got 100"):
        morton_index(100)


@pytest.mark.parametrize("packed", [False, True])
def test_one_cell(tmp_path, packed):
    cells = EMPTY.copy()
    cells[0, interleave(10, 20, 30)] = 0.5  # exactly half, in float16
    cells[0, interleave(0, 0, 1)] = -1.0
    grid = load_instant_ngp(write(tmp_path / "a.ingp", snapshot(cells), packed=packed))
    assert grid.density.shape == (1, CELLS, CELLS, CELLS)
    center = (np.array([10, 20, 30]) + 0.5) / CELLS
    assert grid.density_fn(center)[0] == pytest.approx(0.5 / SHORTEST_STEP, rel=1e-6)
    assert grid.density_fn(center[None, None] + [1 / CELLS, 0, 0]).tolist() == [[[0.0]]]
    assert np.argwhere(grid.unseen).tolist() == [[0, 0, 0, 1]]
    assert (grid.density >= 0).all()
    np.testing.assert_array_equal(grid.aabb, [[0, 0, 0], [1, 1, 1]])
    assert grid.field_pitch == 1 / 128


def test_cascades(tmp_path):
    """Each cascade holds its own number; the finest that holds a point answers."""
    cells = np.repeat(np.array([[1.0], [2.0], [4.0]]), CELLS**3, axis=1)
    box = {"min": [-1.5, -1.5, -1.5], "max": [2.5, 2.5, 1.0]}
    grid = load_instant_ngp(write(tmp_path / "a.msgpack", snapshot(cells, aabb=box)))
    points = [[0.5, 0.5, 0.5], [0.99, 0.5, 0.5], [1.01, 0.5, 0.5], [-0.49, 0, 0], [-0.51, 0, 0], [-1.49, 0, 0]]
    found = grid.density_fn(points)[:, 0] * SHORTEST_STEP
    np.testing.assert_allclose(found, [1, 1, 2, 2, 4, 4], rtol=1e-6)
    outside = [[-1.51, 0, 0], [0.5, 0.5, 1.01], [np.nan, 0, 0], [np.inf, 0, 0], [1e300, 0, 0]]
    assert grid.density_fn(outside)[:, 0].tolist() == [0.0] * 5
    corner = grid.density_fn(grid.aabb)[:, 0] * SHORTEST_STEP  # the box is closed
    np.testing.assert_allclose(corner, [4, 4], rtol=1e-6)
    density, where = grid.cascade(2)
    assert density.shape == (CELLS,) * 3
    np.testing.assert_array_equal(where, [[-1.5] * 3, [2.5] * 3])


@pytest.fixture(scope="module")
def numbered():
    """Two cascades of random cells in Morton order, and the grid."""
    cells = np.random.default_rng(5).random((2, CELLS**3), np.float32)
    density = np.stack([level[morton_index()] for level in cells])
    box = np.array([[-0.5] * 3, [1.5] * 3])
    return cells, InstantNgpGrid(density, np.zeros(density.shape, bool), box, 0.33, np.full(3, 0.5), True)


@settings(deadline=None)
@given(position=st.lists(st.floats(-0.49, 1.49), min_size=3, max_size=3))
def test_the_lookup_is_instant_ngps(numbered, position):
    """``cascaded_grid_idx_at``: centre, halve once a cascade, move back, multiply by 128, cut off."""
    cells, grid = numbered
    point = np.array(position)
    level = 0 if (np.abs(point - 0.5) < 0.5).all() else 1
    cell = (((point - 0.5) * 2.0**-level + 0.5) * CELLS).astype(int)
    assert grid.density_fn(point)[0] == cells[level, interleave(*map(int, cell))]


def test_coordinates_of_the_photos(tmp_path):
    """instant-ngp multiplies, moves, then turns x y z into y z x."""
    data = {"dataset": {"scale": 0.5, "offset": [0.5, 0.25, 0.0], "from_mitsuba": False}}
    grid = load_instant_ngp(write(tmp_path / "a", snapshot(EMPTY, nerf=data)))
    assert grid.to_ngp([2.0, 4.0, 6.0]).tolist() == [2.25, 3.0, 1.5]
    data["dataset"]["from_mitsuba"] = True
    grid = load_instant_ngp(write(tmp_path / "b", snapshot(EMPTY, nerf=data)))
    assert grid.to_ngp([2.0, 4.0, 6.0]).tolist() == [1.5, 2.25, 3.0]
    grid = load_instant_ngp(write(tmp_path / "c", snapshot(EMPTY, nerf="")))
    assert (grid.scale, grid.offset.tolist(), grid.cycled) == (0.33, [0.5, 0.5, 0.5], True)


NAN = EMPTY.copy()
NAN[0, 7] = np.nan


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        ({"snapshot": {"mode": "sdf"}}, "no snapshot with a density_grid_binary"),
        ({"other": 3}, "no snapshot with a density_grid_binary"),
        ([1, 2], "no snapshot with a density_grid_binary"),
        (snapshot(EMPTY, density_grid_size=64), "density_grid_size must be 128, got 64"),
        (snapshot(EMPTY, density_grid_binary=b""), "density grid of 0 bytes"),
        (snapshot(EMPTY, density_grid_binary=b"\0" * 1000), "density grid of 1000 bytes"),
        (snapshot(EMPTY, density_grid_binary=bytes(2 * CELLS**3 * 9)), "must be 1 to 8 cascades"),
        (snapshot(EMPTY, density_grid_binary=[0.0, 1.0]), "no snapshot with a density_grid_binary"),
        (snapshot(NAN), "1 cells of the density grid are NaN"),
        (snapshot(EMPTY, aabb={"min": [0.0, 0.0], "max": [1.0] * 3}), "aabb.min must be three finite numbers"),
        (snapshot(EMPTY, aabb={"min": [float("nan")] * 3, "max": [1.0] * 3}), "aabb.min must be three finite numbers"),
        (snapshot(EMPTY, aabb={"min": [2.0] * 3, "max": [3.0] * 3}), "min < max within its cascades"),
        (snapshot(EMPTY, nerf={"dataset": {"scale": 0.0}}), "scale must be finite and > 0"),
        (snapshot(EMPTY, nerf={"dataset": {"offset": "here"}}), "offset must be three finite numbers"),
    ],
)
def test_foreign(tmp_path, content, rule):
    path = write(tmp_path / "x.msgpack", content)
    with pytest.raises(ValueError, match=rule) as caught:
        load_instant_ngp(path)
    assert str(path) in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("share", [0.0, 1e-5, 0.5, 0.99])
def test_cut_short(tmp_path, packed, share):
    cells = np.random.default_rng(0).random((1, CELLS**3))
    whole = write(tmp_path / "whole", snapshot(cells), packed=packed).read_bytes()
    path = tmp_path / "cut"
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(ValueError, match="not a snapshot of instant-ngp, or is cut short"):
        load_instant_ngp(path)


@pytest.mark.parametrize("data", [b"\x1f\x8bnot gzip at all", b"PK\x03\x04", b"\x89PNG\r\n", b"{}", bytes(100)])
def test_other_files(tmp_path, data):
    path = tmp_path / "x"
    path.write_bytes(data)
    with pytest.raises(ValueError, match="not a snapshot of instant-ngp"):
        load_instant_ngp(path)


def test_what_unpacks_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr(instant_ngp, "MOST_BYTES", 1 << 22)
    buffer = io.BytesIO()
    with gzip.GzipFile(fileobj=buffer, mode="wb") as stream:
        stream.write(b"\x91\xc6" + struct.pack(">I", 1 << 23) + bytes(1 << 23))
    path = tmp_path / "bomb.ingp"
    path.write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="more than 4194304 bytes unpacked"):
        load_instant_ngp(path)


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="load_instant_ngp: no file"):
        load_instant_ngp(tmp_path / "none.ingp")


def test_positions_of_a_wrong_shape(tmp_path):
    grid = load_instant_ngp(write(tmp_path / "a", snapshot(EMPTY)))
    with pytest.raises(ValueError, match=r"must have shape \(\.\.\., 3\), got \(2,\)"):
        grid.density_fn([0.0, 0.0])
