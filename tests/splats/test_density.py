import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.splats import density as splats
from unghost.splats.density import CUT, MOST_LOGIT, SplatField
from unghost.splats.ply import Gaussians


def cloud(count, seed=0, *, low=0.01, high=0.3, spread=1.0):
    rng = np.random.default_rng(seed)
    extents = np.exp(rng.uniform(np.log(low), np.log(high), (count, 3)))
    return Gaussians.create(
        rng.uniform(-spread, spread, (count, 3)), extents, rng.normal(size=(count, 4)), rng.normal(size=count) * 3
    )


def slowly(gaussians, points, pitch):
    """The sum of the module's formula, splat by splat, with covariances and their inverses."""
    total = np.zeros(len(points))
    for mean, extent, turn, logit in zip(gaussians.means, gaussians.extents, gaussians.rotations, gaussians.logits):
        covariance = turn @ np.diag(extent**2) @ turn.T + (pitch / 2) ** 2 * np.eye(3)
        apart = points - mean
        square = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(covariance), apart)
        thinnest = np.sqrt(np.linalg.eigvalsh(covariance)[0])
        peak = -np.log1p(-1 / (1 + np.exp(-logit))) / (np.sqrt(2 * np.pi) * thinnest)
        total += np.where(square < CUT**2, peak * np.exp(-square / 2), 0.0)
    return total


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 1000), pitch=st.sampled_from([1e-3, 0.05, 0.5]), spread=st.sampled_from([0.01, 1.0, 50.0]))
def test_the_sum(seed, pitch, spread):
    gaussians = cloud(40, seed, low=1e-3, high=2.0, spread=spread)
    rng = np.random.default_rng(seed + 1)
    points = np.concatenate([rng.uniform(-spread, spread, (150, 3)), gaussians.means + rng.normal(size=(40, 3)) * 0.05])
    found = SplatField(gaussians, pitch=pitch).density_fn(points)[:, 0]
    expected = slowly(gaussians, points, pitch)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * expected.max())
    near_cut = np.abs(found - expected) > 1e-4 * expected.max() + 1e-5 * expected
    assert near_cut.mean() < 0.02  # in float32 a point may fall on the other side of the cut


@pytest.mark.parametrize("logit", [-math.inf, -3.0, 0.0, 2.0, 40.0, math.inf])
@pytest.mark.parametrize("extent", [0.0, 1e-4, 0.02, 0.3])
def test_seen_face_on_the_opacity_is_the_splats(logit, extent):
    """A disc 0.3 wide and ``extent`` thick, crossed through its centre along its thin axis."""
    disc = Gaussians.create([[0.1, 0.2, 0.3]], [[0.3, 0.3, extent]], [[1.0, 0, 0, 0]], [logit])
    field = SplatField(disc, pitch=0.05)
    z = np.linspace(-2, 2, 40001)
    line = np.stack([np.full_like(z, 0.1), np.full_like(z, 0.2), z + 0.3], axis=1)
    depth = float(field.density_fn(line).astype(np.float64).sum() * (z[1] - z[0]))
    assert depth == pytest.approx(
        np.logaddexp(0, min(logit, MOST_LOGIT)), rel=3e-3
    )  # the cut takes 0.27 % of a Gaussian


def test_no_disc_falls_between_samples():
    """However thin and wherever, on samples a pitch apart a disc absorbs what it should, to a tenth."""
    pitch = 0.1
    z = np.arange(-20, 20) * pitch
    line = np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=1)
    for shift in np.linspace(0, pitch, 11):
        disc = Gaussians.create([[0, 0, shift]], [[0.5, 0.5, 1e-6]], [[1.0, 0, 0, 0]], [0.0])
        depth = SplatField(disc, pitch=pitch).density_fn(line).sum() * pitch
        assert depth == pytest.approx(np.log(2), rel=0.1)


def test_opaque_is_what_float32_rounds_to_one():
    logits = np.array([MOST_LOGIT - 1.0, MOST_LOGIT + 0.7])
    opacity = (1.0 / (1.0 + np.exp(-logits))).astype(np.float32)
    assert opacity[0] < 1.0 == opacity[1]


def test_what_cannot_be_judged_is_left_out():
    """The field is that of the others, and finite."""
    whole = cloud(30, 2)
    means, turns = whole.means.copy(), whole.rotations.copy()
    means[3, 1], turns[7] = np.nan, np.nan
    some = Gaussians(means, whole.extents, turns, whole.logits)
    assert np.flatnonzero(~some.valid).tolist() == [3, 7]
    points = np.random.default_rng(3).uniform(-1, 1, (200, 3))
    found = SplatField(some, pitch=0.05).density_fn(points)
    np.testing.assert_array_equal(found, SplatField(whole.only(some.valid), pitch=0.05).density_fn(points))
    assert np.isfinite(found).all()
    assert (found != SplatField(whole, pitch=0.05).density_fn(points)).any()


def test_turned_with_the_splat():
    """A needle along x, turned by a quarter about z, lies along y."""
    half = np.sqrt(0.5)
    needle = Gaussians.create([[0, 0, 0]], [[1.0, 0.01, 0.01]], [[half, 0, 0, half]], [2.0])
    along, across = SplatField(needle, pitch=0.01).density_fn([[0, 0.5, 0], [0.5, 0, 0]])[:, 0]
    assert along > 1.0
    assert across == 0.0


def test_the_order_and_the_chunks_do_not_matter(monkeypatch):
    gaussians = cloud(200, 4)
    points = np.random.default_rng(5).uniform(-1, 1, (300, 3))
    whole = SplatField(gaussians, pitch=0.05).density_fn(points)
    order = np.random.default_rng(6).permutation(200)
    shuffled = Gaussians(
        *(part[order] for part in (gaussians.means, gaussians.extents, gaussians.rotations, gaussians.logits))
    )
    np.testing.assert_allclose(SplatField(shuffled, pitch=0.05).density_fn(points), whole, rtol=1e-5)
    monkeypatch.setattr(splats, "PAIRS", 7)
    np.testing.assert_allclose(SplatField(gaussians, pitch=0.05).density_fn(points), whole, rtol=1e-5)
    monkeypatch.undo()
    alone = np.concatenate([SplatField(gaussians, pitch=0.05).density_fn(point[None]) for point in points[:20]])
    np.testing.assert_allclose(alone, whole[:20], rtol=1e-5)


def test_pairs_are_looked_at_a_bounded_number_at_once(monkeypatch):
    monkeypatch.setattr(splats, "PAIRS", 1000)
    field = SplatField(cloud(500, 1), pitch=0.05)
    points = np.zeros((400, 3))
    sizes = [len(rows) for level in field._levels for rows, _ in splats._pairs(level, points)]
    assert max(sizes) == 1000
    assert sum(sizes) > 20_000


def test_far_away_and_enormous():
    """Cell numbers wrap round and lose digits; the density stays that of one splat."""
    for far in (1e6, 1e9, 1e25):
        lone = Gaussians.create([[far, -far, far]], [[0.1, 0.1, 0.1]], [[1.0, 0, 0, 0]], [0.0])
        field = SplatField(lone, pitch=0.01)
        peak = np.log(2) / (np.sqrt(2 * np.pi) * np.hypot(0.1, 0.005))
        assert field.density_fn([far, -far, far])[0] == pytest.approx(peak, rel=1e-5)
        assert field.density_fn(np.zeros((1, 3))).item() == 0.0
    huge = Gaussians.create([[0, 0, 0]], [[1e20, 1e20, 1e20]], [[1.0, 0, 0, 0]], [0.0])
    assert np.isfinite(SplatField(huge, pitch=0.01).density_fn([[1e19, 0, 0]])).all()


def test_shapes_and_what_is_not_finite():
    field = SplatField(cloud(10), pitch=0.1)
    assert field.density_fn(np.zeros((2, 5, 3))).shape == (2, 5, 1)
    assert field.density_fn(np.zeros((0, 3))).shape == (0, 1)
    found = field.density_fn([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 0]])[:, 0]
    assert np.isnan(found).tolist() == [True, True, False]
    none = Gaussians.create(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0))
    assert SplatField(none, pitch=0.1).density_fn(np.zeros((4, 3))).tolist() == [[0.0]] * 4
    with pytest.raises(ValueError, match=r"positions must have shape \(\.\.\., 3\), got \(2,\)"):
        field.density_fn([0.0, 0.0])
    with pytest.raises(ValueError, match=r"pitch must be finite and > 0, got 0\.0"):
        SplatField(cloud(10), pitch=0.0)
