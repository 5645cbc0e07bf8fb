import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unghost.fields.adapters.sdf import laplace_density, logistic_density, sdf_density_fn


def test_laplace_by_hand():
    # beta 0.5, alpha 4: outside 4/2 exp(-1/0.5), on the surface 4/2, inside 4 (1 - exp(-1/0.5)/2)
    found = laplace_density(np.array([1.0, 0.0, -1.0]), beta=0.5, alpha=4.0)
    np.testing.assert_allclose(found, [2 * np.exp(-2), 2.0, 4 * (1 - np.exp(-2) / 2)], rtol=1e-15)


def test_logistic_by_hand():
    found = logistic_density(np.array([0.5, 0.0, -0.5]), sharpness=4.0)
    np.testing.assert_allclose(found, [4 / (1 + np.exp(2)), 2.0, 4 / (1 + np.exp(-2))], rtol=1e-15)


def test_logistic_is_the_density_of_neus_head_on():
    """NeuS eq. 10: rho = -(d Phi_s / dt) / Phi_s for f(p(t)) falling by one a unit."""
    t = np.linspace(-0.5, 0.5, 20001)
    phi = 1 / (1 + np.exp(20 * t))  # Phi_s(f) with f = -t
    rho = -np.gradient(phi, t) / phi
    np.testing.assert_allclose(logistic_density(-t, sharpness=20.0)[1:-1], rho[1:-1], rtol=1e-5)


def test_a_wall_absorbs_what_the_integral_says():
    """A half space of Laplace density, crossed from far outside to depth L: alpha (L + beta/2 exp(-L/beta))."""
    edges = np.linspace(-3.0, 0.5, 400_001)
    middle = (edges[1:] + edges[:-1]) / 2
    depth = (laplace_density(-middle, beta=0.1, alpha=3.0) * np.diff(edges)).sum()
    assert depth == pytest.approx(3.0 * (0.5 + 0.1 / 2 * np.exp(-5.0)), rel=1e-6)


@given(
    distance=st.floats(-1e30, 1e30) | st.sampled_from([0.0, -0.0, 5e-324, np.inf, -np.inf]),
    width=st.floats(1e-3, 1e3),
)
def test_bounded_and_falling(distance, width):
    further = distance + abs(distance) * 0.1 if np.isfinite(distance) else distance
    for near, far in [
        [density(np.array(d)) for d in (distance, further)]
        for density in (
            lambda d: laplace_density(d, beta=width),
            lambda d: logistic_density(d, sharpness=1 / width),
        )
    ]:
        assert 0.0 <= far <= near <= 1 / width * (1 + 1e-12)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["laplace", "logistic"])
def test_torch_agrees_with_numpy_and_keeps_its_type(dtype, name):
    distance = np.linspace(-2, 2, 41)
    options = {"beta": 0.25} if name == "laplace" else {"sharpness": 4.0}
    function = laplace_density if name == "laplace" else logistic_density
    found = function(torch.from_numpy(distance).to(dtype), **options)
    assert found.dtype == dtype
    np.testing.assert_allclose(
        found.double().numpy(), function(distance, **options), atol=4 * {torch.float16: 2e-3}.get(dtype, 2e-6)
    )


@pytest.mark.parametrize("options", [{"beta": 0.3}, {"beta": 0.3, "alpha": 7.0}, {"sharpness": 3.0}])
def test_gradients(options):
    function = logistic_density if "sharpness" in options else laplace_density
    distance = torch.tensor([-2.0, -0.4, -1e-3, 1e-3, 0.3, 2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: function(d, **options), distance)


def test_the_gradient_on_the_surface_and_far_away():
    distance = torch.tensor([0.0, -1e4, 1e4], requires_grad=True)
    laplace_density(distance, beta=0.1).sum().backward()
    assert distance.grad.tolist() == pytest.approx([-50.0, 0.0, 0.0])  # -alpha / (2 beta)


def test_a_field_of_either_kind_keeps_the_shape():
    points = np.zeros((2, 3, 3))
    assert sdf_density_fn(lambda p: p[..., :1], beta=0.1)(points).shape == (2, 3, 1)
    assert sdf_density_fn(lambda p: p[..., 0], sharpness=9.0)(points).shape == (2, 3)


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({}, "either beta or sharpness"),
        ({"beta": 0.1, "sharpness": 3.0}, "either beta or sharpness"),
        ({"sharpness": 3.0, "alpha": 3.0}, "alpha belongs to beta"),
        ({"beta": 0.0}, r"beta must be finite and > 0, got 0\.0"),
        ({"beta": 0.1, "alpha": np.inf}, "alpha must be finite"),
        ({"sharpness": np.nan}, "sharpness must be finite"),
    ],
)
def test_refused(options, rule):
    with pytest.raises(ValueError, match=rule):
        sdf_density_fn(lambda p: p[..., 0], **options)
