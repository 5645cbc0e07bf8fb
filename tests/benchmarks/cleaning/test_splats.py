"""Options and parts of benchmarks/cleaning/splats.py."""

import numpy as np
import pytest
from unghost_tests.benches import check_short

from benchmarks.cleaning import splats


def test_short():
    check_short(splats, splats=5000, seeds=(900,))


def test_quaternions_turn_z_to_the_normals():
    normals = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, -1.0]])
    w, x, y, z = splats.facing(normals).T
    turned = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    np.testing.assert_allclose(turned, normals, atol=1e-12)


@pytest.mark.slow
def test_a_scene_has_its_share_of_floaters_and_a_row_counts_them(monkeypatch):
    scene = splats.make(900, splats.Options(splats=600, floaters=0.1))
    assert len(scene.kind) == 600
    assert np.bincount(scene.kind).tolist() == [540, 20, 20, 20]
    monkeypatch.setitem(splats.METHODS, "half", lambda gaussians: (scene.kind == 0) | (scene.kind == 2))
    row = splats.row_of("half", 900, scene)
    assert row["surface_kept"] == 1.0
    assert row["floater_recall"] == pytest.approx(2 / 3)
    assert (row["recall_blob"], row["recall_haze"], row["recall_needle"]) == (1.0, 0.0, 1.0)
