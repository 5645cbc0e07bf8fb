import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.frames import unit_lattice
from unghost.data_recipes.corruptions.structured import CORRUPTIONS, changed_fraction, corrupt, soften
from unghost.data_recipes.recipe import Recipe
from unghost.data_recipes.solids.compose import dilate, sample_cube

RADIUS = np.linalg.norm(unit_lattice(), axis=-1)
SHELL = np.abs(RADIUS - 0.3) < 0.03
ALL = {**CORRUPTIONS, "corrupt": corrupt}


@pytest.mark.parametrize("name", ALL)
def test_severity_zero_is_the_identity(name):
    for occupancy in (SHELL, np.zeros_like(SHELL), np.ones_like(SHELL)):
        np.testing.assert_array_equal(ALL[name](np.random.default_rng(0), occupancy, 0.0), occupancy)


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_flips_grow_with_severity_and_are_nested(name):
    for seed in range(4):
        flips = [CORRUPTIONS[name](np.random.default_rng(seed), SHELL, s) ^ SHELL for s in (0.05, 0.3, 0.6, 1.0)]
        for fewer, more in itertools.pairwise(flips):
            assert (fewer <= more).all()
        assert flips[-1].sum() > 100
        assert flips[-1].sum() > flips[0].sum()


@pytest.mark.parametrize("name", ALL)
def test_argument_is_unchanged_and_the_result_repeats(name):
    kept = SHELL.copy()
    first = ALL[name](np.random.default_rng(3), SHELL, 0.8)
    np.testing.assert_array_equal(SHELL, kept)
    np.testing.assert_array_equal(first, ALL[name](np.random.default_rng(3), SHELL, 0.8))
    assert first.dtype == bool
    assert not np.array_equal(first, ALL[name](np.random.default_rng(4), SHELL, 0.8))


@pytest.mark.parametrize("name", ALL)
def test_empty_and_full_cubes_survive(name):
    rng = np.random.default_rng(0)
    ghosts = ALL[name](rng, np.zeros_like(SHELL), 1.0)
    surface_only = name in ("holes", "rough_surface", "swollen_surface", "doubled_surface")
    assert ghosts.any() != surface_only or name == "corrupt"
    ALL[name](rng, np.ones_like(SHELL), 1.0)


@pytest.mark.parametrize(
    "name",
    [
        "detached_blobs",
        "fog_sheets",
        "fog_volumes",
        "touching_floaters",
        "streaks",
        "blocks",
        "doubled_surface",
        "swollen_surface",
    ],
)
def test_ghosts_only_add(name):
    assert (CORRUPTIONS[name](np.random.default_rng(1), SHELL, 1.0) >= SHELL).all()


def test_holes_only_remove():
    assert (CORRUPTIONS["holes"](np.random.default_rng(1), SHELL, 1.0) <= SHELL).all()


def test_detached_blobs_are_detached():
    for seed in range(5):
        added = CORRUPTIONS["detached_blobs"](np.random.default_rng(seed), SHELL, 1.0) & ~SHELL
        assert not (added & dilate(SHELL, 2)).any()


def test_rough_surface_stays_within_a_voxel_of_it():
    flips = CORRUPTIONS["rough_surface"](np.random.default_rng(0), SHELL, 1.0) ^ SHELL
    assert not (flips & ~dilate(SHELL, 1)).any()
    assert (flips & SHELL).any()
    assert (flips & ~SHELL).any()


def test_streaks_are_elongated():
    """The flips' largest principal extent exceeds the smallest, far more than that of blobs."""

    def ratio(name):
        values = []
        for seed in range(30):
            flips = CORRUPTIONS[name](np.random.default_rng(seed), np.zeros_like(SHELL), 0.6)
            spread = np.linalg.eigvalsh(np.cov(np.argwhere(flips).T))
            values.append(spread[-1] / spread[0])
        return np.median(values)

    assert ratio("streaks") > 1.5 * ratio("fog_volumes")


@pytest.mark.slow
def test_mean_overlap_falls_as_stated():
    """0.96 at severity 0.1, 0.89 at 0.5, 0.74 at 0.8, 0.6 at 1 (to within 0.03) on the recipe's own cubes."""
    cubes = [sample_cube(np.random.default_rng([5, i]), Recipe())[0] for i in range(150)]
    cubes = [occupancy for occupancy in cubes if occupancy.sum() > 100]
    for severity, expected in ((0.1, 0.96), (0.5, 0.89), (0.8, 0.74), (1.0, 0.60)):
        overlaps = []
        for i, clean in enumerate(cubes):
            noisy = corrupt(np.random.default_rng(i), clean, severity)
            overlaps.append((noisy & clean).sum() / (noisy | clean).sum())
        assert np.mean(overlaps) == pytest.approx(expected, abs=0.03)


def changed_share(family, clean, severity, seeds):
    """Mean share of voxels that change, over ``seeds`` generators."""
    return np.mean([(family(np.random.default_rng(seed), clean, severity) ^ clean).mean() for seed in range(seeds)])


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(sorted(CORRUPTIONS)),
    seed=st.integers(0, 2**31),
    levels=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    resolution=st.sampled_from([2, 3, 8, 17]),
    share=st.sampled_from([0.0, 0.01, 0.2, 0.9, 1.0]),
)
def test_what_changes_at_a_severity_also_changes_above_it(name, seed, levels, resolution, share):
    """Not on average only: with the same random numbers the flips are nested, for any cube and any two severities."""
    clean = np.random.default_rng(seed).random((resolution,) * 3) < share
    few, many = (CORRUPTIONS[name](np.random.default_rng(seed), clean, severity) ^ clean for severity in sorted(levels))
    assert (few <= many).all()
    assert not (CORRUPTIONS[name](np.random.default_rng(seed), clean, 0.0) ^ clean).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["corrupt", "soften"])
def test_the_mix_changes_more_with_severity_on_average(name):
    """For the mix only the average grows: its families' shares of a severity may be drawn anew."""
    clean = dilate(SHELL, 1)

    def family(rng, cube, severity):
        noisy = corrupt(rng, cube, severity)
        return noisy if name == "corrupt" else soften(rng, cube, noisy, severity) > -0.8

    changes = [changed_share(family, clean, severity, 60) for severity in (0.0, 0.1, 0.3, 0.5, 0.8, 1.0)]
    assert changes[0] == 0
    assert changes == sorted(changes)
    assert changes[-1] > 3 * changes[1]


@pytest.mark.parametrize("severity", [-0.1, 1.0001, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ALL)
def test_severity_outside_its_range_is_refused(name, severity):
    with pytest.raises(ValueError, match=r"severity must lie in \[0, 1\], got"):
        ALL[name](np.random.default_rng(0), SHELL, severity)


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_every_family_says_what_it_does(name):
    assert len(CORRUPTIONS[name].__doc__.split()) > 5


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), severity=st.floats(0, 1), share=st.sampled_from([0.0, 0.001, 0.1, 0.9, 1.0]))
def test_corrupt_takes_any_cube(seed, severity, share):
    rng = np.random.default_rng(seed)
    occupancy = rng.random((16, 16, 16)) < share
    assert corrupt(rng, occupancy, severity).shape == (16, 16, 16)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match=r"severity must lie in \[0, 1\], got 1.5"):
        changed_fraction(1.5)
    with pytest.raises(ValueError, match="occupancy must be a boolean cube"):
        corrupt(np.random.default_rng(0), np.zeros((4, 4, 4)), 0.5)
    with pytest.raises(ValueError, match="occupancy must be a boolean cube"):
        CORRUPTIONS["salt"](np.random.default_rng(0), np.zeros((4, 4, 5), dtype=bool), 0.5)
