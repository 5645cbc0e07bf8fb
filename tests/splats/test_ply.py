import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from unghost.splats.ply import KEEP_SCORE, Gaussians, read_splat_ply, write_splat_ply

NAMES = [
    "x",
    "y",
    "z",
    "nx",
    "ny",
    "nz",
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(9)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
]


def table(count=20, seed=0, extra=()):
    rng = np.random.default_rng(seed)
    rows = np.empty(count, [(name, "<f4") for name in NAMES] + list(extra))
    for name in rows.dtype.names:
        rows[name] = rng.normal(size=count) if rows[name].dtype.kind == "f" else rng.integers(0, 200, count)
    return rows


def write(path, rows, **options):
    """With plyfile, as the reference program does."""
    PlyData([PlyElement.describe(rows, "vertex")], **({"byte_order": "<"} | options)).write(path)
    return path


def test_what_plyfile_wrote(tmp_path):
    rows = table(extra=[("label", "u1"), ("wide", "<f8")])
    splats = read_splat_ply(write(tmp_path / "a.ply", rows))
    assert len(splats) == 20
    assert splats.rows.dtype == rows.dtype
    assert splats.rows.tobytes() == rows.tobytes()


def test_activations(tmp_path):
    rows = table(3)
    rows["scale_0"], rows["scale_1"], rows["scale_2"] = np.log(0.5), np.log(0.25), 0.0
    rows["opacity"] = [0.0, np.log(3.0), 80.0]
    turn = np.sqrt(0.5)
    for i, part in enumerate((3 * turn, 0, 0, 3 * turn)):  # a quarter turn about z, not normalised
        rows[f"rot_{i}"] = part
    gaussians = read_splat_ply(write(tmp_path / "a.ply", rows)).gaussians()
    np.testing.assert_allclose(gaussians.extents, [[0.5, 0.25, 1.0]] * 3, rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacity(), [0.5, 0.75, 1.0], rtol=1e-6)
    np.testing.assert_allclose(gaussians.rotations[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_array_equal(gaussians.means, np.stack([rows[a] for a in "xyz"], axis=1))


def test_kept_rows_are_the_same_bytes(tmp_path):
    rows = table(1000, extra=[("label", "u1")])
    rows["f_rest_3"][7] = np.nan  # none of our business
    splats = read_splat_ply(write(tmp_path / "a.ply", rows, comments=["made by a test"]))
    keep = np.arange(1000) % 3 > 0
    score = np.linspace(-1, 1, 1000)
    write_splat_ply(tmp_path / "b.ply", splats, keep=keep, keep_score=score)
    again = PlyData.read(str(tmp_path / "b.ply"), mmap=False)
    assert again.comments == ["made by a test"]
    written = again["vertex"].data
    assert written.dtype.names == (*rows.dtype.names, KEEP_SCORE)
    for name in rows.dtype.names:
        assert written[name].tobytes() == rows[name][keep].tobytes()
    np.testing.assert_array_equal(written[KEEP_SCORE], score[keep].astype(np.float32))
    assert (tmp_path / "a.ply").stat().st_size > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]


def test_keeping_all_gives_the_file_back(tmp_path):
    path = write(tmp_path / "a.ply", table())
    write_splat_ply(tmp_path / "b.ply", read_splat_ply(path), keep=np.ones(20, bool))
    assert (tmp_path / "b.ply").read_bytes() == path.read_bytes()


def test_a_score_that_is_there_is_replaced(tmp_path):
    write_splat_ply(
        tmp_path / "b.ply",
        read_splat_ply(write(tmp_path / "a.ply", table())),
        keep=np.ones(20, bool),
        keep_score=np.zeros(20),
    )
    write_splat_ply(
        tmp_path / "c.ply", read_splat_ply(tmp_path / "b.ply"), keep=np.ones(20, bool), keep_score=np.ones(20)
    )
    splats = read_splat_ply(tmp_path / "c.ply")
    assert splats.rows.dtype.names == (*NAMES, KEEP_SCORE)
    assert splats.rows[KEEP_SCORE].tolist() == [1.0] * 20


def test_none_kept_and_none_there(tmp_path):
    splats = read_splat_ply(write(tmp_path / "a.ply", table()))
    write_splat_ply(tmp_path / "b.ply", splats, keep=np.zeros(20, bool))
    empty = read_splat_ply(tmp_path / "b.ply")
    assert len(empty) == 0
    assert len(empty.gaussians()) == 0
    with pytest.raises(ValueError, match="there are no Gaussians"):
        empty.gaussians().aabb()


def test_lines_may_end_in_two_bytes(tmp_path):
    path = write(tmp_path / "a.ply", table())
    head, body = path.read_bytes().split(b"end_header\n")
    other = tmp_path / "b.ply"
    other.write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    assert read_splat_ply(other).rows.tobytes() == table().tobytes()


def test_writing_refuses(tmp_path):
    path = write(tmp_path / "a.ply", table())
    splats, before = read_splat_ply(path), path.read_bytes()
    with pytest.raises(ValueError, match="is the file that is being read"):
        write_splat_ply(path, splats, keep=np.ones(20, bool))
    with pytest.raises(ValueError, match=r"keep must have shape \(20,\), got \(19,\)"):
        write_splat_ply(tmp_path / "b.ply", splats, keep=np.ones(19, bool))
    with pytest.raises(ValueError, match="keep must be bool, got float64"):
        write_splat_ply(tmp_path / "b.ply", splats, keep=np.ones(20))
    with pytest.raises(ValueError, match=r"keep_score must have shape"):
        write_splat_ply(tmp_path / "b.ply", splats, keep=np.ones(20, bool), keep_score=np.ones((20, 1)))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]


def without(name):
    return table()[[n for n in NAMES if n != name]].copy()


@pytest.mark.parametrize("name", ["x", "opacity", "scale_2", "rot_0"])
def test_properties_that_are_missing(tmp_path, name):
    rows = np.empty(20, [(n, "<f4") for n in NAMES if n != name])
    with pytest.raises(ValueError, match=f"lacks the properties {name}"):
        read_splat_ply(write(tmp_path / "a.ply", rows))


@pytest.mark.parametrize(
    ("change", "rule"), [(-1, "1 bytes shorter"), (-5000, "shorter|no PLY header"), (3, "3 bytes longer")]
)
def test_a_body_of_another_length(tmp_path, change, rule):
    path = write(tmp_path / "a.ply", table(100))
    data = path.read_bytes()
    path.write_bytes(data[:change] if change < 0 else data + b"\0" * change)
    with pytest.raises(ValueError, match=rule):
        read_splat_ply(path)


HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", "no PLY header"),
        ("solid cube", "no PLY header"),
        (HEADER.replace("end_header", "end"), "no PLY header"),
        (HEADER.replace("binary_little_endian", "ascii"), "line 'format ascii 1.0'"),
        (HEADER.replace("binary_little_endian", "binary_big_endian"), "line 'format binary_big_endian"),
        (HEADER.replace("property float x", "property list uchar int x"), "line 'property list"),
        (HEADER.replace("property float x", "property float x\nproperty float x"), "one twice"),
        (HEADER.replace("property float x", "property float x\nelement face 1"), "line 'element face 1'"),
        (HEADER.replace("vertex 1", "vertex -1"), "line 'element vertex -1'"),
        (HEADER.replace("format binary_little_endian 1.0\n", ""), "names no format"),
        (HEADER.replace("vertex 1", "vertex " + "9" * 30), "lacks the properties"),
        (HEADER, "lacks the properties y, z"),
    ],
)
def test_other_headers(tmp_path, text, rule):
    path = tmp_path / "a.ply"
    path.write_bytes(text.encode())
    with pytest.raises(ValueError, match=rule) as caught:
        read_splat_ply(path)
    assert str(path) in str(caught.value)


def test_a_count_beyond_all_memory(tmp_path):
    path = write(tmp_path / "a.ply", table())
    path.write_bytes(path.read_bytes().replace(b"vertex 20", b"vertex 99999999999999"))
    with pytest.raises(ValueError, match="bytes shorter than 99999999999999 rows"):
        read_splat_ply(path)


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="read_splat_ply: no file"):
        read_splat_ply(tmp_path / "none.ply")


@pytest.mark.parametrize(
    ("name", "value"), [("x", np.nan), ("opacity", np.inf), ("scale_1", 90.0), ("scale_1", -1000.0)]
)
def test_values_that_are_none(tmp_path, name, value):
    rows = table()
    rows[name][[4, 9]] = value
    with pytest.raises(ValueError, match="2 of 20 are not, the first is number 4"):
        read_splat_ply(write(tmp_path / "a.ply", rows)).gaussians()


def test_a_rotation_of_no_length():
    with pytest.raises(ValueError, match="1 of 1 are not"):
        Gaussians.create([[0, 0, 0]], [[1, 1, 1]], [[0, 0, 0, 0]], [0.0])
    with pytest.raises(ValueError, match=r"must have shapes \(N, 3\)"):
        Gaussians.create([[0, 0, 0]], [[1, 1, 1]], [[1, 0, 0]], [0.0])


def test_the_box_leaves_the_far_background_out():
    rng = np.random.default_rng(1)
    means = np.concatenate([rng.uniform(-1, 1, (1000, 3)), [[500.0, 0, 0]], [[0.0, -900, 0]]])
    count = len(means)
    gaussians = Gaussians.create(means, np.full((count, 3), 0.01), [[1, 0, 0, 0]] * count, np.zeros(count))
    box = gaussians.aabb()
    assert (np.abs(box) < 1.02).all()
    assert (np.abs(box) > 0.95).all()
    np.testing.assert_allclose(gaussians.aabb(share=1.0)[1, 0], 500.01)
    with pytest.raises(ValueError, match=r"share must lie in \(0, 1\]"):
        gaussians.aabb(share=0.0)


def test_the_box_does_not_care_for_what_is_transparent():
    means = np.concatenate([np.random.default_rng(2).uniform(-1, 1, (500, 3)), np.full((500, 3), 50.0)])
    logits = np.repeat([3.0, -20.0], 500)
    box = Gaussians.create(means, np.full((1000, 3), 0.01), [[1, 0, 0, 0]] * 1000, logits).aabb()
    assert (box < 1.1).all()
