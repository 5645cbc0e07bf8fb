import numpy as np
import pytest

from unghost.core.frames import unit_lattice
from unghost.core.occupancy import opacity_from_signed
from unghost.data_recipes.corruptions.softening import _blurring, _regridding, coarse_noise, soften
from unghost.data_recipes.corruptions.structured import corrupt, detached_blobs, fog_volumes

SHELL = np.abs(np.linalg.norm(unit_lattice(), axis=-1) - 0.3) < 0.05


def test_severity_zero_gives_the_bits():
    noisy = corrupt(np.random.default_rng(0), SHELL, 0.7)
    np.testing.assert_array_equal(soften(np.random.default_rng(1), SHELL, noisy, 0.0), np.where(noisy, 1.0, -1.0))


def test_range_type_repeatability_and_unchanged_arguments():
    noisy = corrupt(np.random.default_rng(0), SHELL, 0.7)
    kept = SHELL.copy(), noisy.copy()
    for seed in range(20):
        signed = soften(np.random.default_rng(seed), SHELL, noisy, 0.7)
        assert signed.dtype == np.float32
        assert signed.shape == SHELL.shape
        assert np.isfinite(signed).all()
        assert signed.min() >= -1.0
        assert signed.max() <= 1.0
    np.testing.assert_array_equal(signed, soften(np.random.default_rng(19), SHELL, noisy, 0.7))
    np.testing.assert_array_equal(SHELL, kept[0])
    np.testing.assert_array_equal(noisy, kept[1])


def test_it_is_soft():
    values = np.concatenate(
        [
            soften(np.random.default_rng(seed), SHELL, corrupt(np.random.default_rng(seed), SHELL, 0.8), 0.8).ravel()
            for seed in range(20)
        ]
    )
    assert ((values > -0.9) & (values < 0.9)).mean() > 0.15


def test_true_surfaces_stay_visible_and_ghosts_are_often_faint():
    surfaces, ghosts = [], []
    for seed in range(60):
        noisy = fog_volumes(np.random.default_rng(seed), SHELL, 0.9)
        opacity = opacity_from_signed(soften(np.random.default_rng(seed), SHELL, noisy, 0.9))
        surfaces.append(np.median(opacity[SHELL]))
        ghosts.append(np.median(opacity[noisy & ~SHELL]))
    assert min(surfaces) > 0.2
    assert np.quantile(ghosts, 0.2) < 0.3 < np.quantile(ghosts, 0.9)
    # neither is separable by a threshold alone: some ghosts are denser than some surfaces
    assert max(ghosts) > min(surfaces)


def test_opacity_does_not_tell_a_ghost_from_a_surface():
    """In a fair share of the cubes the ghosts are at least as opaque as a typical surface."""
    opaque = []
    for seed in range(150):
        noisy = detached_blobs(np.random.default_rng(seed), SHELL, 0.7)
        opacity = opacity_from_signed(soften(np.random.default_rng(seed), SHELL, noisy, 0.7))
        opaque.append(np.median(opacity[noisy & ~SHELL]) > 0.9 * np.median(opacity[SHELL]))
    assert 0.25 < np.mean(opaque) < 0.75


def test_empty_and_full_cubes():
    empty, full = np.zeros_like(SHELL), np.ones_like(SHELL)
    for clean, noisy in ((empty, empty), (empty, full), (full, empty), (full, full)):
        signed = soften(np.random.default_rng(0), clean, noisy, 1.0)
        assert np.isfinite(signed).all()
    assert soften(np.random.default_rng(3), empty, empty, 0.01).max() < -0.9


def test_smoothing_keeps_constants():
    for matrix in (_blurring(1.3, 32), _blurring(1e-9, 32), _regridding(2.7, 0.4, 32), _regridding(4.0, 3.9, 32)):
        np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-5)
        assert (matrix >= 0).all()
    np.testing.assert_allclose(_blurring(1e-9, 8), np.eye(8), atol=1e-7)


def test_coarse_noise_interpolates_its_nodes():
    noise = coarse_noise(np.random.default_rng(0), 4, 10)  # nodes at 0, 3, 6, 9
    nodes = np.random.default_rng(0).standard_normal((4, 4, 4), dtype=np.float32)
    np.testing.assert_allclose(noise[::3, ::3, ::3], nodes, atol=1e-6)
    np.testing.assert_allclose(noise[1, 0, 0], (2 * nodes[0, 0, 0] + nodes[1, 0, 0]) / 3, atol=1e-6)


def test_bad_arguments_are_named():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="boolean and of one shape"):
        soften(rng, SHELL, SHELL[:16], 0.5)
    with pytest.raises(ValueError, match=r"severity must lie in \[0, 1\], got -0.1"):
        soften(rng, SHELL, SHELL, -0.1)
