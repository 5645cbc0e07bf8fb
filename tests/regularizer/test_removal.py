"""The loss that holds down what ``clean`` would take out."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.cleaning.keep_mask import KeepMask
from unghost.regularizer.removal import RemovalLoss

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def mask_without(*cells):
    keep = np.ones((4, 4, 4), dtype=bool)
    for cell in cells:
        keep[cell] = False
    return KeepMask(BOX, 0.5, keep)


class Grid(torch.nn.Module):
    """Density of 4³ cells over the box."""

    def __init__(self, value=1.0):
        super().__init__()
        self.cells = torch.nn.Parameter(torch.full((4, 4, 4), float(value)))
        self.asked = []

    def forward(self, positions):
        self.asked.append(positions.detach())
        index = ((positions + 1) * 2).long().clamp(0, 3)
        return self.cells[index[:, 0], index[:, 1], index[:, 2]].relu()[:, None]


def test_the_value_is_the_weighted_mean_optical_depth_of_a_removed_cell():
    field = Grid(3.0)
    loss = RemovalLoss(mask_without((0, 1, 2), (3, 3, 3)), weight=0.25, samples=500)(field)
    assert loss.dtype == torch.float64
    assert loss.item() == pytest.approx(0.25 * 3.0 * 0.5, rel=1e-6)


def test_the_gradient_reaches_removed_cells_alone():
    field = Grid()
    RemovalLoss(mask_without((0, 1, 2), (3, 3, 3)), weight=1.0, samples=2000)(field).backward()
    moved = field.cells.grad != 0
    assert moved.sum() == 2
    assert moved[0, 1, 2]
    assert moved[3, 3, 3]
    share = field.cells.grad[moved] / 0.5
    assert share.sum().item() == pytest.approx(1.0, rel=1e-5)  # the mean over both, times the pitch
    assert (share - 0.5).abs().max() < 5 * 0.5 / np.sqrt(2000)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.integers(1, 300), st.floats(0.35, 1.0))
def test_all_positions_lie_where_something_is_to_go(seed, samples, side):
    # cells that do not divide the box: the lattice sticks out of it
    count = int(np.ceil(2 / side - 1e-9))
    rng = np.random.default_rng(seed)
    cells = rng.random((count,) * 3) < 0.5
    mask, field = KeepMask(BOX, side, cells), Grid()
    loss = RemovalLoss(mask, samples=samples, seed=seed)(field)
    asked = torch.cat([torch.zeros(0, 3), *field.asked])
    assert len(asked) <= samples
    assert not mask.keep(asked).any()
    assert 0 <= loss.item() <= 0.01 * side * (1 + 1e-9)


def test_steps_differ_and_repeat():
    first, again, other = (RemovalLoss(mask_without((1, 1, 1)), samples=10, seed=seed) for seed in (0, 0, 1))
    fields = [Grid() for _ in range(3)]
    for loss, field in zip((first, again, other), fields):
        loss(field), loss(field)
    assert torch.equal(fields[0].asked[0], fields[1].asked[0])
    assert torch.equal(fields[0].asked[1], fields[1].asked[1])
    assert not torch.equal(fields[0].asked[0], fields[0].asked[1])
    assert not torch.equal(fields[0].asked[0], fields[2].asked[0])
    resumed = RemovalLoss(mask_without((1, 1, 1)), samples=10)
    resumed.step = 1
    field = Grid()
    resumed(field)
    assert torch.equal(field.asked[0], fields[0].asked[1])


def test_losses_of_several_fields_are_added_at_the_same_positions():
    one, two = Grid(1.0), Grid(5.0)
    total = RemovalLoss(mask_without((0, 0, 0)), weight=1.0, samples=64)([one, two])
    assert total.item() == pytest.approx(6.0 * 0.5)
    assert torch.equal(one.asked[0], two.asked[0])


@pytest.mark.parametrize(("cells", "weight"), [((), 0.1), (((0, 0, 0),), 0.0)])
def test_nothing_to_do_asks_nothing(cells, weight):
    field = Grid()
    loss = RemovalLoss(mask_without(*cells), weight=weight)(field)
    assert loss.item() == 0.0
    assert not field.asked


def test_no_more_than_a_chunk_at_once():
    field = Grid()
    RemovalLoss(mask_without((0, 0, 0)), samples=25, chunk=10)(field)
    assert [len(part) for part in field.asked] == [10, 10, 5]


def test_what_the_photos_need_stays_and_what_they_do_not_goes():
    field = Grid(2.0)
    removal = RemovalLoss(mask_without((0, 0, 0), (3, 3, 3)), samples=256)
    optimizer = torch.optim.Adam(field.parameters(), lr=0.05)
    for _ in range(200):
        wanted = (torch.exp(-field.cells[0, 0, 0].relu()) - np.exp(-2.0)) ** 2  # a ray through the first cell
        loss = wanted + removal(field)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert field.cells[0, 0, 0] > 1.0
    assert field.cells[3, 3, 3] < 1e-2
    assert field.cells[1, 1, 1] == 2.0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_extreme_densities_do_not_overflow(dtype):
    density = torch.full((), torch.finfo(dtype).max, dtype=dtype, requires_grad=True)
    loss = RemovalLoss(mask_without((0, 0, 0)), samples=32)(lambda positions: density.expand(len(positions)))
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(density.grad)


def test_invalid_densities_are_refused_by_name_or_left_out():
    mask = mask_without((0, 0, 0))

    def field(positions):
        return torch.where(torch.arange(len(positions)) % 2 == 0, torch.nan, 4.0).requires_grad_()

    with pytest.raises(ValueError, match=r"RemovalLoss: .*NaN"):
        RemovalLoss(mask, samples=8)(field)
    assert RemovalLoss(mask, weight=1.0, samples=8, drop_invalid=True)(field).item() == pytest.approx(4 * 0.5 / 2)
    with pytest.raises(TypeError, match="RemovalLoss: density_fn must return a torch tensor, got ndarray"):
        RemovalLoss(mask)(lambda positions: np.ones(len(positions)))
    with pytest.warns(UserWarning, match=r"RemovalLoss: .*without a gradient"):
        RemovalLoss(mask)(lambda positions: torch.ones(len(positions)))


@pytest.mark.parametrize(
    ("over", "said"),
    [
        ({"weight": -0.1}, "weight must be finite and >= 0, got -0.1"),
        ({"weight": float("nan")}, "weight must be finite and >= 0, got nan"),
        ({"samples": 0}, "samples must be >= 1, got 0"),
        ({"chunk": 0}, "chunk must be >= 1, got 0"),
    ],
)
def test_arguments_out_of_range(over, said):
    with pytest.raises(ValueError, match=f"RemovalLoss: {said}"):
        RemovalLoss(mask_without((0, 0, 0)), **over)


@pytest.mark.parametrize("given_", [[], 3, [Grid(), 3]])
def test_something_else_than_a_callable(given_):
    with pytest.raises(TypeError, match="RemovalLoss: density_fn must be a callable or a non-empty list"):
        RemovalLoss(mask_without((0, 0, 0)))(given_)
