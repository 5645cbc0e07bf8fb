import functools

import pytest
import torch

from unghost.regularizer.losses import cubewise_mean, dsds_loss, stable_mean, visibility_loss


def test_dsds_by_hand_both_halves_alive():
    density = torch.tensor([[3.0, 0.5], [0.5, 3.0]], requires_grad=True)
    x0_pred = torch.tensor([[-0.2, -1.0], [0.0, 0.9]])
    loss = dsds_loss(density, x0_pred, target_density=2.0)
    # empty: the density itself; occupied (0 counts as occupied): 2 - 0.5 = 1.5, and nothing above w
    assert loss.tolist() == [[3.0, 0.5], [1.5, 0.0]]
    loss.sum().backward()
    assert density.grad.tolist() == [[1.0, 1.0], [-1.0, 0.0]]


def test_dsds_leaves_the_undecided_alone():
    density = torch.tensor([1.0, 1.0, 1.0], requires_grad=True)
    loss = dsds_loss(density, torch.tensor([-0.6, -0.1, 0.4]), target_density=4.0, threshold=-0.5, fill_threshold=0.0)
    assert loss.tolist() == [1.0, 0.0, 3.0]
    loss.sum().backward()
    assert density.grad.tolist() == [1.0, 0.0, -1.0]


def test_dsds_per_cube_target_and_no_gradient_to_the_prediction():
    density = torch.zeros(2, 3, requires_grad=True)
    x0_pred = torch.ones(2, 3, requires_grad=True)
    loss = dsds_loss(density, x0_pred, target_density=torch.tensor([[1.0], [2.0]]))
    assert loss.tolist() == [[1.0] * 3, [2.0] * 3]
    loss.sum().backward()
    assert x0_pred.grad is None


@pytest.mark.parametrize("threshold", [0.0, -0.3])
def test_gradcheck(threshold):
    generator = torch.Generator().manual_seed(0)
    density = (torch.rand(3, 2, 2, 2, generator=generator, dtype=torch.float64) * 2 + 0.05).requires_grad_()
    x0_pred = torch.rand(3, 2, 2, 2, generator=generator, dtype=torch.float64) * 2 - 1
    assert torch.autograd.gradcheck(
        lambda d: dsds_loss(d, x0_pred, target_density=1.0, threshold=threshold, fill_threshold=0.1), (density,)
    )
    views = torch.randint(0, 3, density.shape, generator=generator)
    assert torch.autograd.gradcheck(lambda d: visibility_loss(d, views, min_views=2), (density,))


def test_visibility_by_hand():
    density = torch.tensor([2.0, 3.0, 5.0])
    assert visibility_loss(density, torch.tensor([0, 1, 2])).tolist() == [2.0, 0.0, 0.0]
    assert visibility_loss(density, torch.tensor([0, 1, 2]), min_views=2).tolist() == [2.0, 3.0, 0.0]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_upcast(dtype):
    density = torch.full((4,), 60000.0 if dtype is torch.float16 else 1e30, dtype=dtype, requires_grad=True)
    loss = dsds_loss(density, -torch.ones(4), target_density=0.01)
    assert loss.dtype is torch.float32
    total = stable_mean(loss)
    assert torch.isfinite(total)
    total.backward()
    assert density.grad.dtype is dtype
    assert density.grad.tolist() == [0.25] * 4


def test_sums_of_huge_densities_do_not_overflow():
    density = torch.full((64,), 3e38, requires_grad=True)
    assert torch.isinf(dsds_loss(density, -torch.ones(64), target_density=1.0).sum())  # the naive reduction does
    total = stable_mean(dsds_loss(density, -torch.ones(64), target_density=1.0))
    assert total.item() == pytest.approx(3e38, rel=1e-6)
    total.backward()
    assert torch.isfinite(density.grad).all()


def test_huge_and_occupied_is_no_loss_and_no_nan():
    density = torch.tensor([1e30, 3e38], requires_grad=True)
    loss = dsds_loss(density, torch.ones(2), target_density=1.0)
    assert loss.tolist() == [0.0, 0.0]
    loss.sum().backward()
    assert density.grad.tolist() == [0.0, 0.0]


def test_stable_mean_of_nothing_is_zero():
    assert stable_mean(torch.zeros(0)).item() == 0.0


def test_errors_name_function_and_argument():
    density = torch.ones(4)
    with pytest.raises(ValueError, match=r"dsds_loss: x0_pred must have shape \(4,\), got \(4, 4\)"):
        dsds_loss(density, torch.ones(4, 4), target_density=1.0)
    with pytest.raises(ValueError, match="target_density must be finite"):
        dsds_loss(density, density, target_density=float("nan"))
    with pytest.raises(ValueError, match="target_density must be a number or have shape"):
        dsds_loss(torch.ones(4, 4), torch.ones(4, 4), target_density=torch.ones(1, 4))
    with pytest.raises(ValueError, match="fill_threshold must be finite and >= threshold"):
        dsds_loss(density, density, target_density=1.0, threshold=0.5, fill_threshold=0.0)
    with pytest.raises(ValueError, match="view_count must have shape"):
        visibility_loss(density, torch.ones(3))
    with pytest.raises(ValueError, match="min_views"):
        visibility_loss(density, torch.ones(4), min_views=0)
    with pytest.raises(TypeError, match="floating-point"):
        dsds_loss(torch.ones(4, dtype=torch.int64), density, target_density=1.0)


def one_by_one(density, x0_pred, factor, used):
    each = dsds_loss((density * factor).double(), x0_pred.double(), target_density=0.1, fill_threshold=0.3)
    return torch.where(used, each, torch.zeros_like(each)).sum() / used.sum()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_mean_cube_by_cube_is_the_mean(dtype):
    generator = torch.Generator().manual_seed(0)
    density = torch.rand(3, 4, 4, 4, generator=generator, dtype=dtype).requires_grad_()
    x0_pred = torch.rand(3, 4, 4, 4, generator=generator) * 2 - 1
    used = torch.rand(3, 4, 4, 4, generator=generator) > 0.2
    factor = torch.tensor([0.1, 2.0, 0.01], dtype=torch.float64)[:, None, None, None]
    loss = functools.partial(dsds_loss, target_density=0.1, fill_threshold=0.3)
    found = cubewise_mean(loss, density, x0_pred, factor, used)
    expected = one_by_one(density, x0_pred, factor, used)
    torch.testing.assert_close(found, expected)
    gradients = [torch.autograd.grad(3 * value, density)[0] for value in (found, expected)]
    assert gradients[0].dtype == dtype
    assert (gradients[1] != 0).any()
    torch.testing.assert_close(*gradients)
    assert not cubewise_mean(loss, density.detach(), x0_pred, factor, used).requires_grad
    nothing = cubewise_mean(loss, density, x0_pred, factor, torch.zeros_like(used))
    assert nothing.item() == 0
    assert (torch.autograd.grad(nothing, density)[0] == 0).all()


def test_the_mean_cube_by_cube_passes_gradcheck():
    density = torch.rand(2, 3, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    x0_pred = torch.linspace(-1, 1, 54).reshape(2, 3, 3, 3)
    factor = torch.tensor([0.5, 3.0], dtype=torch.float64)[:, None, None, None]
    loss = functools.partial(dsds_loss, target_density=0.1, fill_threshold=0.3)
    assert torch.autograd.gradcheck(
        lambda values: cubewise_mean(loss, values, x0_pred, factor, torch.ones(2, 3, 3, 3, dtype=torch.bool)), density
    )


@pytest.mark.parametrize("answer", [-1.0, 1.0])
@pytest.mark.parametrize(("value", "finite"), [(1e300, True), (1e308, False)])
def test_depths_beyond_float64_are_an_infinite_loss_with_a_finite_gradient(value, finite, answer):
    density = torch.full((1, 2, 2, 2), value, dtype=torch.float64, requires_grad=True)
    factor = torch.full((1, 1, 1, 1), 10.0, dtype=torch.float64)
    loss = functools.partial(dsds_loss, target_density=0.1)
    x0_pred = torch.full((1, 2, 2, 2), answer)
    found = cubewise_mean(loss, density, x0_pred, factor, torch.ones(1, 2, 2, 2, dtype=torch.bool))
    assert found.item() == pytest.approx((10.0 * value if finite else float("inf")) if answer < 0 else 0.0)
    found.backward()
    assert density.grad.flatten().tolist() == pytest.approx([10.0 / 8 if answer < 0 else 0.0] * 8)
