from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from unghost.splats.ply import KEEP_SCORE, Gaussians, read_splat_ply, write_splat_ply

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "splats"
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


@pytest.mark.parametrize("name", ["x", "opacity", "scale_1", "rot_0"])
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


HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float opacity\nend_header\n"
PROPERTY = "property float opacity"


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", "an empty file"),
        ("solid cube", "of no known format"),
        (HEADER.replace("end_header", "end"), "a .ply whose header has no end"),
        (HEADER.replace("end_header\n", "end_header"), "no PLY header"),
        (HEADER.replace("binary_little_endian", "ascii"), "an ASCII .ply of 3D Gaussians.*plyfile"),
        (HEADER.replace("binary_little_endian", "binary_big_endian"), "a big-endian .ply .*plyfile"),
        (HEADER.replace("binary_little_endian", "binary"), "line 'format binary 1.0'"),
        (HEADER.replace(PROPERTY, f"{PROPERTY}\nproperty list uchar int i"), "vertex has a list property"),
        (HEADER.replace(PROPERTY, f"{PROPERTY}\nproperty list float int i"), "line 'property list float"),
        (HEADER.replace("element vertex", "element f 2\nproperty list uchar int i\nelement vertex"), "f has a list"),
        (HEADER.replace(PROPERTY, f"{PROPERTY}\n{PROPERTY}"), "a property twice"),
        (HEADER.replace(PROPERTY, f"{PROPERTY}\nelement vertex 1"), "one element vertex, got vertex, vertex"),
        (HEADER.replace(PROPERTY, f"{PROPERTY}\nproperty half x"), "line 'property half x'"),
        (HEADER.replace("vertex 1", "vertex -1"), "line 'element vertex -1'"),
        (HEADER.replace("format binary_little_endian 1.0\n", ""), "names no format"),
        (HEADER.replace("vertex 1", "vertex " + "9" * 30), "lacks the properties"),
        (HEADER, "lacks the properties x, y"),
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
    ("name", "value", "valid"),
    [
        ("x", np.nan, False),
        ("y", np.inf, False),
        ("opacity", np.nan, False),
        ("opacity", np.inf, True),
        ("opacity", -np.inf, True),
        ("scale_1", 90.0, False),
        ("scale_1", np.nan, False),
        ("scale_1", -1000.0, True),
        ("scale_1", -np.inf, True),
        ("rot_2", np.nan, False),
        ("rot_2", np.inf, False),
    ],
)
def test_which_values_can_be_judged(tmp_path, name, value, valid):
    rows = table()
    rows[name][[4, 9]] = value
    gaussians = read_splat_ply(write(tmp_path / "a.ply", rows)).gaussians()
    assert len(gaussians) == 20
    assert np.flatnonzero(~gaussians.valid).tolist() == ([] if valid else [4, 9])
    assert np.isfinite(gaussians.aabb()).all()
    assert len(gaussians.only(gaussians.valid)) == (20 if valid else 18)


def test_opacities_at_the_ends(tmp_path):
    rows = table(2)
    rows["opacity"] = [np.inf, -np.inf]
    np.testing.assert_allclose(read_splat_ply(write(tmp_path / "a.ply", rows)).gaussians().opacity(), [1, 0], atol=1e-9)


def test_a_rotation_of_no_length():
    turns = [[0, 0, 0, 0], [2, 0, 0, 0]]
    gaussians = Gaussians.create(np.zeros((2, 3)), np.ones((2, 3)), turns, np.zeros(2))
    assert gaussians.valid.tolist() == [False, True]
    with pytest.raises(ValueError, match="not one of 1 Gaussians is finite"):
        gaussians.only(~gaussians.valid).aabb()
    with pytest.raises(ValueError, match=r"must have shapes \(N, 3\)"):
        Gaussians.create([[0, 0, 0]], [[1, 1, 1]], [[1, 0, 0]], [0.0])


def test_two_scales_are_a_disc(tmp_path):
    rows = table()
    two = rows[[name for name in NAMES if name != "scale_2"]]
    two = np.array([tuple(row) for row in two], [(name, "<f4") for name in two.dtype.names])
    flat = read_splat_ply(write(tmp_path / "two.ply", two)).gaussians()
    rows["scale_2"] = -np.inf
    same = read_splat_ply(write(tmp_path / "three.ply", rows)).gaussians()
    for part in ("means", "extents", "rotations", "logits"):
        np.testing.assert_array_equal(getattr(flat, part), getattr(same, part))
    assert (flat.extents[:, 2] == 0).all()
    assert flat.valid.all()


def with_others(path, rows, *, lists):
    """Vertices between other elements, as plyfile writes them; ``lists``: one behind them has a list."""
    intrinsic = np.array([(1.5,), (2.5,)], [("intrinsic", "<f4")])
    size = np.array([(640, 1), (480, 2), (1, 3)], [("image_size", "<u4"), ("keep_score", "u1")])
    faces = np.empty(2, [("vertex_indices", "O"), ("flag", "u1")])
    faces["vertex_indices"][:] = [np.array([0, 1, 2], "i4"), np.array([1, 2, 3, 4], "i4")]
    faces["flag"] = [7, 8]
    elements = [
        PlyElement.describe(intrinsic, "intrinsic"),
        PlyElement.describe(rows, "vertex"),
        PlyElement.describe(size, "image_size"),
    ]
    elements += [PlyElement.describe(faces, "face")] if lists else []
    PlyData(elements, byte_order="<").write(path)
    return path


@pytest.mark.parametrize("lists", [False, True])
def test_other_elements_are_carried_through(tmp_path, lists):
    rows = table()
    path = with_others(tmp_path / "a.ply", rows, lists=lists)
    splats = read_splat_ply(path)
    assert splats.rows.tobytes() == rows.tobytes()
    write_splat_ply(tmp_path / "all.ply", splats, keep=np.ones(20, bool))
    assert (tmp_path / "all.ply").read_bytes() == path.read_bytes()
    keep = np.arange(20) % 2 == 0
    options = {"keep": keep, "keep_score": np.arange(20.0)}
    if lists:
        with pytest.warns(UserWarning, match=r"the element face of b\.ply is as it was"):
            write_splat_ply(tmp_path / "b.ply", splats, **options)
    else:
        write_splat_ply(tmp_path / "b.ply", splats, **options)
    before, after = (PlyData.read(str(tmp_path / name), mmap=False) for name in ("a.ply", "b.ply"))
    assert [element.name for element in after] == [element.name for element in before]
    assert after["vertex"].data[KEEP_SCORE].tolist() == np.arange(20)[keep].tolist()
    assert after["vertex"].data[NAMES].astype(rows.dtype).tobytes() == rows[keep].tobytes()
    assert after["image_size"].data.tobytes() == before["image_size"].data.tobytes()
    assert after["intrinsic"].data.tobytes() == before["intrinsic"].data.tobytes()
    if lists:
        assert [face.tolist() for face in after["face"]["vertex_indices"]] == [[0, 1, 2], [1, 2, 3, 4]]
    data = path.read_bytes()
    for change in (data[:-1], data[: len(data) - 40]) if not lists else (data[: data.index(b"end_header") + 90],):
        (tmp_path / "cut.ply").write_bytes(change)
        with pytest.raises(ValueError, match=r"shorter than 20 rows of .* and the elements intrinsic, image_size"):
            read_splat_ply(tmp_path / "cut.ply")


def test_an_element_with_as_many_rows_may_belong_to_the_splats(tmp_path):
    labels = np.zeros(20, [("label", "u1")])
    path = tmp_path / "a.ply"
    PlyData([PlyElement.describe(table(), "vertex"), PlyElement.describe(labels, "label")], byte_order="<").write(path)
    with pytest.warns(UserWarning, match="the element label"):
        write_splat_ply(tmp_path / "b.ply", read_splat_ply(path), keep=np.arange(20) > 0)
    write_splat_ply(tmp_path / "c.ply", read_splat_ply(path), keep=np.ones(20, bool))  # silent: nothing goes


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


@pytest.mark.skipif(not SHARED.is_dir(), reason="the shared data folder is absent")
@pytest.mark.shared_data
def test_files_of_other_programs(tmp_path):
    """Every .ply that is not compressed is read to its last row and given back; every other file is named."""
    files = [path for path in sorted(SHARED.rglob("*")) if path.suffix in (".ply", ".splat", ".spz", ".sog")]
    assert len(files) >= 10
    for path in files:
        if path.suffix == ".ply" and ".compressed" not in path.name:
            splats = read_splat_ply(path)
            assert splats.gaussians().valid.all()
            write_splat_ply(tmp_path / "all.ply", splats, keep=np.ones(len(splats), bool))
            assert (tmp_path / "all.ply").read_bytes() == path.read_bytes()
        else:
            with pytest.raises(ValueError, match=r"is a compressed splat file .*: convert it"):
                read_splat_ply(path)
