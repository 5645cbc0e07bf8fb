"""The parts of benchmarks/data/curate.py, each with little to do."""

import json
from collections import Counter

import numpy as np
import pytest
from unghost_tests.benches import check_short

from benchmarks.data import cube_makers, curate


@pytest.fixture
def bench(monkeypatch):
    module, ways = curate, cube_makers
    small = module.Mesh.from_triangles(module.bumpy_ball(2000))
    for each in (module, ways):
        monkeypatch.setattr(each, "ball", lambda faces=0: small)
    return module


def test_the_ball_is_closed_and_has_about_the_faces_asked_for(bench):
    soup = bench.bumpy_ball(1200)
    assert soup.shape == (1200, 3, 3)
    assert 60_000 < len(bench.bumpy_ball(bench.FACES)) < 80_000
    _, index = np.unique(np.round(soup.reshape(-1, 3), 9), axis=0, return_inverse=True)
    edges = Counter(tuple(edge) for f in index.reshape(-1, 3).tolist() for edge in zip(f, np.roll(f, -1).tolist()))
    assert all(edges[b, a] == count == 1 for (a, b), count in edges.items())


def test_our_cubes_are_checked_and_a_wrong_one_is_found(bench, monkeypatch):
    bench.check_meshes(2)
    ways = cube_makers
    monkeypatch.setattr(ways, "cut_cubes", lambda mesh, frames: np.ones((len(frames), 32, 32, 32), dtype=bool))
    with pytest.raises(AssertionError):
        bench.check_meshes(1)


@pytest.mark.slow
def test_solids_are_checked_and_wrong_ones_are_found(bench, monkeypatch):
    pytest.importorskip("manifold3d")
    csg = cube_makers.csg
    bench.check_solids(2)
    for name, wrong in (
        ("cut_cubes", lambda mesh, frames: np.zeros((len(frames), 32, 32, 32), dtype=bool)),
        ("fill_solid", lambda triangles, frame, surface: np.ones_like(surface)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(csg, name, wrong)
            with pytest.raises(AssertionError):
                bench.check_solids(2)


def test_winding_numbers_by_hand(bench):
    ways = cube_makers
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.3, -0.2], [3.0, 0.0, 0.0]])
    np.testing.assert_allclose(ways.winding_numbers(bench.bumpy_ball(1200), points), [1, 1, 0], atol=1e-9)


def test_agreement_by_hand(bench):
    a, b = np.zeros((3, 8), dtype=bool), np.zeros((3, 8), dtype=bool)
    a[0, :4], b[0, 2:6] = True, True  # 2 of 6; the next agree, the last are empty
    a[1], b[1] = True, True
    assert bench.agreement(np.packbits(a, axis=1), np.packbits(b, axis=1)) == pytest.approx((1 / 3 + 1) / 2)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(6))
def test_contenders_make_the_cubes_they_should(bench, number):
    contender = bench.CONTENDERS[number]
    for name in ("trimesh", "open3d"):
        if contender.name.endswith(name):
            pytest.importorskip(name)
    if contender.name.startswith("csg"):
        pytest.importorskip("manifold3d")
    count = 8
    found, seconds, peak = bench.timed(contender.method, 0, count)
    expected = np.concatenate([contender.same_as(i, i + 1) for i in range(count)])
    assert found.shape == (count, 4096)
    assert bench.agreement(found, expected) >= contender.least_iou
    assert seconds > 0
    assert peak > 10


@pytest.mark.slow
def test_rows_sweeps_and_picture(bench, tmp_path):
    pytest.importorskip("matplotlib")
    options = bench.Options(workers=1, cubes=64, quick=True, out=tmp_path)
    row = bench.measure(bench.CONTENDERS[3], options)
    assert row["method"] == "procedural/unghost"
    assert row["cubes"] == 64
    assert row["iou"] == 1.0
    assert row["cubes_per_second"] > 0
    rows = [row, {"method": "mesh/trimesh", "milliseconds": 50.0}, *bench.sweeps(options, 16)]
    assert {entry["sweep"] for entry in rows[2:]} == {"faces", "edge_fraction"}
    assert all(entry["faces"] <= 80_000 for entry in rows[2:] if entry["sweep"] == "faces")
    bench.plot(rows, tmp_path / "curate.png")
    assert (tmp_path / "curate.png").stat().st_size > 5000
    bench.write_results(tmp_path / "curate.json", bench.build_results(rows, seeds=[bench.SEED]))
    assert len(json.loads((tmp_path / "curate.json").read_text())["rows"]) == len(rows)


def test_short():
    check_short(curate, quick=True, cubes=1600)
