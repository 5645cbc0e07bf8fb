import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.data_recipes.meshes.box_tree import BoxTree, morton_codes


def soup(seed, count, spread):
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.5, 0.5, size=(count, 1, 3)) + rng.normal(size=(count, 3, 3)) * spread


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.sampled_from([1, 2, 15, 16, 17, 256, 257, 700]),
    spread=st.sampled_from([0.0, 1e-3, 0.1, 2.0]),
    edge=st.sampled_from([0.0, 1e-3, 0.1, 3.0]),
)
def test_finds_every_box_that_touches_and_hardly_another(seed, count, spread, edge):
    triangles = soup(seed, count, spread)
    lows = np.random.default_rng(seed + 1).uniform(-1, 1, size=(9, 3))
    highs = lows + edge
    query, row = BoxTree.build(triangles).touching(lows, highs)
    assert (np.diff(query) >= 0).all()
    found = np.zeros((9, count), dtype=int)
    np.add.at(found, (query, row), 1)
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    for slack, keeps in ((0.0, np.greater_equal), (1e-6, np.less_equal)):
        touches = ((low <= highs[:, None] + slack) & (high >= lows[:, None] - slack)).all(axis=2)
        assert keeps(found, touches).all()


def test_touching_at_a_point_that_float32_cannot_hold():
    corner = 1 / 3
    triangles = np.full((40, 3, 3), corner)
    for low, high in (([corner] * 3, [1.0] * 3), ([0.0] * 3, [corner] * 3)):
        _, row = BoxTree.build(triangles).touching(np.array([low]), np.array([high]))
        assert sorted(row) == list(range(40))


def test_no_boxes_asked_for():
    query, row = BoxTree.build(soup(0, 300, 0.1)).touching(np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(query) == len(row) == 0


def test_neighbours_on_the_curve_are_neighbours_in_space():
    points = np.random.default_rng(0).uniform(size=(4096, 3))
    along = points[np.argsort(morton_codes(points))]
    groups = along.reshape(-1, 16, 3)
    assert np.median(np.ptp(groups, axis=1).max(axis=1)) < 0.35  # 16 of 4096: a cube of edge (1/256)^(1/3) = 0.16
    assert morton_codes(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]])) == pytest.approx(
        [0, sum(8**b for b in range(10)), 2 * sum(8**b for b in range(10)), 8**10 - 1]
    )
