import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unghost.core.occupancy import (
    OccupancyRule,
    check_density,
    check_density_shape,
    occupancy_from_signed,
    opacity_from_density,
    opacity_from_signed,
    signed_from_occupancy,
    signed_from_opacity,
)

RULES = [OccupancyRule(), OccupancyRule.paper(), OccupancyRule("opacity", 0.5)]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("soft", [True, False])
def test_an_empty_field_encodes_to_minus_one(rule, soft):
    assert (rule.encode(np.zeros((2, 3), dtype=np.float32), 0.1, soft=soft) == -1.0).all()
    assert (rule.encode(torch.zeros(2, 3), 0.1, soft=soft) == -1.0).all()


def test_bits_round_trip_and_zero_counts_as_occupied():
    bits = np.array([True, False])
    np.testing.assert_array_equal(signed_from_occupancy(bits), np.float32([1, -1]))
    assert signed_from_occupancy(torch.tensor([True, False])).tolist() == [1.0, -1.0]
    np.testing.assert_array_equal(occupancy_from_signed(signed_from_occupancy(bits)), bits)
    assert occupancy_from_signed(np.array([0.0]))[0]


def test_opacity_by_hand():
    assert opacity_from_density(np.array([np.log(2.0) / 0.5]), 0.5)[0] == pytest.approx(0.5)
    assert opacity_from_density(np.array([1e-12]), 1.0)[0] == pytest.approx(1e-12, rel=1e-12)  # expm1, not 1 - exp
    assert opacity_from_density(np.array([1e30]), 1.0)[0] == 1.0
    assert opacity_from_density(np.array([1e308]), 1e3)[0] == 1.0  # without a warning
    opacity = np.linspace(0, 1, 11)
    np.testing.assert_allclose(opacity_from_signed(signed_from_opacity(opacity)), opacity, atol=1e-15)


@given(
    density=st.floats(0, 1e6),
    pitch=st.floats(1e-4, 1e2),
    unit=st.floats(1e-3, 1e3),
    threshold=st.floats(0.01, 0.99),
)
def test_the_opacity_rule_does_not_depend_on_the_unit(density, pitch, unit, threshold):
    rule = OccupancyRule("opacity", threshold)
    here = float(opacity_from_density(np.float64(density), pitch))
    there = float(opacity_from_density(np.float64(density / unit), pitch * unit))
    assert there == pytest.approx(here, rel=1e-9, abs=1e-12)
    assert rule.density_threshold(pitch) == pytest.approx(unit * rule.density_threshold(pitch * unit), rel=1e-9)


@given(pitch=st.floats(1e-4, 1e2), threshold=st.floats(0.01, 0.99))
def test_density_threshold_is_where_occupancy_begins(pitch, threshold):
    rule = OccupancyRule("opacity", threshold)
    edge = rule.density_threshold(pitch)
    assert not rule.occupied(np.float64(edge * (1 - 1e-6)), pitch)
    assert rule.occupied(np.float64(edge * (1 + 1e-6)), pitch)


def test_the_papers_rule():
    rule = OccupancyRule.paper()
    assert rule.density_threshold(123.0) == 0.01
    assert rule.occupied(np.array([0.009, 0.01, 0.011]), 5.0).tolist() == [False, False, True]
    assert rule.encode(np.array([0.009, 0.011]), 5.0, soft=True).tolist() == [-1.0, 1.0]  # always a bit


def test_numpy_and_torch_agree():
    density = np.random.default_rng(0).exponential(3.0, size=100)
    for rule in RULES:
        ours, theirs = rule.encode(density, 0.2), rule.encode(torch.from_numpy(density), 0.2)
        assert isinstance(theirs, torch.Tensor)
        np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-12)


def test_gradient_of_opacity_reaches_the_density():
    density = torch.tensor([0.0, 1.0, 7.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: opacity_from_density(d, 0.3), density)


@pytest.mark.parametrize(("kind", "threshold"), [("opacity", 0.0), ("opacity", 1.0), ("density", -1.0), ("x", 0.1)])
def test_impossible_rules_are_refused(kind, threshold):
    with pytest.raises(ValueError, match="OccupancyRule: "):
        OccupancyRule(kind, threshold)


def test_bad_densities_are_counted_and_placed():
    density = np.array([1.0, -2.0, np.nan, np.inf, -0.5])
    places = np.arange(15.0).reshape(5, 3)
    with pytest.raises(ValueError, match=r"clean: .* 1 NaN, 1 infinite, 2 negative of 5; first -2.0 at \[3.0, 4"):
        check_density(density, places, caller="clean")
    check_density(np.array([0.0, 1e30, 1e-310]), places[:3], caller="clean")


def test_density_shapes():
    places = np.zeros((4, 2, 3))
    assert check_density_shape(np.zeros((4, 2, 1)), places, caller="f").shape == (4, 2)
    assert check_density_shape(np.zeros((4, 2)), places, caller="f").shape == (4, 2)
    with pytest.raises(ValueError, match=r"must return shape \(4, 2, 1\) or \(4, 2\) .* got \(8,\)"):
        check_density_shape(np.zeros(8), places, caller="f")
    with pytest.raises(TypeError, match="must return an array or tensor, got float"):
        check_density_shape(1.0, places, caller="f")
