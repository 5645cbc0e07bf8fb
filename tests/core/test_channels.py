import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.channels import (
    CHANNEL_NAMES,
    LEAST_KNOWN,
    UNKNOWN,
    check_channels,
    coarse_channel,
    coincident_weights,
    encode_surroundings,
    encode_view_count,
    evidence_share,
    full_channel,
    pool_surroundings,
    stack_channels,
    surroundings_lattice,
)
from unghost.core.frames import cube_lattices, random_rotations


@pytest.mark.parametrize(
    "names", [(), ("surroundings",), ("signed_opacity", "depth"), ("signed_opacity", "view_count", "view_count")]
)
def test_impossible_channels_are_refused(names):
    with pytest.raises(ValueError, match="here: channels must start with 'signed_opacity' and be among"):
        check_channels(names, caller="here")
    assert check_channels(list(CHANNEL_NAMES), caller="here") == CHANNEL_NAMES


def test_views_by_hand():
    # -1/2 + 3/2 log2(1 + n) / 8: none, one, three, 255 and more
    found = encode_view_count(np.array([0, 1, 3, 255, 256, 10**6]))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [-0.5, -0.5 + 1.5 / 8, -0.125, 1.0, 1.0, 1.0], atol=1e-6)
    every = encode_view_count(np.arange(256, dtype=np.uint8))
    assert (np.diff(every) > 0).all()
    assert every.min() == LEAST_KNOWN
    assert UNKNOWN not in every


def test_evidence_by_hand():
    # log2(1 + 8 r) / 8: nothing, 1/8 of a typical cell, a typical one (log2 9), 31.875 times that and more
    share = evidence_share(np.array([0.0, 0.125, 1.0, 31.875, 1e9]))
    assert share.dtype == np.float32
    np.testing.assert_allclose(share, [0.0, 0.125, 3.169925 / 8, 1.0, 1.0], atol=1e-6)
    assert (np.diff(evidence_share(np.linspace(0, 31.8, 400))) > 0).all()


def test_surroundings_by_hand():
    np.testing.assert_allclose(encode_surroundings(np.array([-1.0, 0.0, 1.0])), [-0.5, 0.25, 1.0])
    assert encode_surroundings(np.linspace(-1, 1, 99)).min() >= LEAST_KNOWN > UNKNOWN


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_full_channel_can_be_taken_apart_exactly(seed):
    coarse = np.random.default_rng(seed).uniform(-1, 1, (2, 16, 16, 16)).astype(np.float32)
    full = full_channel(coarse)
    assert full.shape == (2, 32, 32, 32)
    assert np.array_equal(coarse_channel(full), coarse)
    assert full[1, 5, 6, 31] == coarse[1, 2, 3, 15]


def test_stacking():
    rng = np.random.default_rng(0)
    signed = rng.uniform(-1, 1, (2, 32, 32, 32))
    coarse, views = (
        encode_surroundings(rng.uniform(-1, 1, (2, 16, 16, 16))),
        encode_view_count(np.full(signed.shape, 3)),
    )
    names = ("signed_opacity", "view_count", "surroundings")
    stacked = stack_channels(names, signed, {"surroundings": coarse, "view_count": views})
    assert stacked.shape == (2, 3, 32, 32, 32)
    assert stacked.dtype == np.float32
    np.testing.assert_array_equal(stacked[:, 0], signed.astype(np.float32))
    np.testing.assert_array_equal(stacked[:, 1], views)
    np.testing.assert_array_equal(stacked[:, 2], full_channel(coarse))
    assert (stack_channels(names, signed, {"view_count": views})[:, 2] == UNKNOWN).all()
    assert stack_channels(names[:1], signed, {"view_count": views}).shape == (2, 1, 32, 32, 32)
    assert stack_channels(names, signed[:0], {}).shape == (0, 3, 32, 32, 32)


def test_the_surroundings_are_those_of_three_edges():
    rng = np.random.default_rng(1)
    centers, edges, rotations = rng.normal(size=(2, 3)), np.array([0.3, 2.0]), random_rotations(rng, 2)
    lattice = surroundings_lattice(centers, edges, rotations)
    np.testing.assert_array_equal(lattice, cube_lattices(centers, 3 * edges, rotations))
    reach = np.abs(np.einsum("nab,nijka->nijkb", rotations, lattice - centers[:, None, None, None]))
    np.testing.assert_allclose(reach.max(axis=(1, 2, 3, 4)), 1.5 * edges * 31 / 32)


def test_pooling_is_the_mean_of_eight():
    signed = np.zeros((1, 32, 32, 32), np.float32)
    signed[0, 6:8, 2:4, 30:32] = np.arange(8).reshape(2, 2, 2)
    pooled = pool_surroundings(signed)
    assert pooled.shape == (1, 16, 16, 16)
    assert pooled[0, 3, 1, 15] == 3.5
    assert np.count_nonzero(pooled) == 1


@pytest.mark.parametrize(("source", "target"), [(16, 8), (16, 4), (8, 8), (8, 4), (4, 8)])
def test_interpolation_keeps_what_is_linear(source, target):
    part, weights = coincident_weights(source, target)
    assert part.start + part.stop == source
    assert weights.shape == (target, part.stop - part.start)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-6)
    places = 3 * ((np.arange(source) + 0.5) / source - 0.5)
    wanted = (np.arange(target) + 0.5) / target - 0.5
    np.testing.assert_allclose(weights @ places[part], wanted, atol=1e-6)
