import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.fields.hash_grid import HashConfig, HashField, hash_encode, level_corners, level_rows

RESOLUTIONS, ROWS = (3, 6, 12), 256  # 64 and 343 -> 256 and 2197 -> 256 rows: one level without collisions, two with


def table_of(features=2, dtype=torch.float32, seed=0):
    rows = sum(level_rows(resolution, ROWS) for resolution in RESOLUTIONS)
    table = torch.randn(rows, features, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    return table.requires_grad_()


def slow_encode(table, unit, resolutions, rows):
    """The paper's equations a point, a level and a corner at a time, in Python's integers of any length."""
    out, first = [], 0
    for resolution in resolutions:
        nodes = (resolution + 1) ** 3
        level = []
        for point in unit.tolist():
            scaled = [value * resolution for value in point]
            cell = [min(max(int(np.floor(value)), 0), resolution - 1) for value in scaled]
            total = 0.0
            for corner in np.ndindex(2, 2, 2):
                x, y, z = (low + step for low, step in zip(cell, corner))
                if nodes <= rows:
                    row = (x * (resolution + 1) + y) * (resolution + 1) + z
                else:
                    row = (x ^ (y * 2654435761) ^ (z * 805459861)) % rows
                weight = np.prod([s - c if step else 1 - (s - c) for s, c, step in zip(scaled, cell, corner)])
                total = total + weight * table[first + row]
            level.append(total)
        out.append(torch.stack(level))
        first += min(nodes, rows)
    return torch.cat(out, dim=1)


def test_value_and_gradient_equal_the_slow_twin():
    table, oracle = table_of(dtype=torch.float64), table_of(dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    unit = torch.rand(60, 3, generator=generator, dtype=torch.float64)
    unit[:4] = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5], [1 / 3, 2 / 3, 1]])
    weight = torch.randn(60, 6, generator=generator, dtype=torch.float64)
    value, expected = hash_encode(table, unit, RESOLUTIONS, ROWS), slow_encode(oracle, unit, RESOLUTIONS, ROWS)
    torch.testing.assert_close(value, expected)
    (value * weight).sum().backward()
    (expected * weight).sum().backward()
    torch.testing.assert_close(table.grad, oracle.grad)
    assert (table.grad != 0).any(dim=1).float().mean() > 0.3


def test_gradient_equals_finite_differences():
    rows = level_rows(2, 32) + level_rows(4, 32)
    table = torch.randn(rows, 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64).requires_grad_()
    unit = torch.rand(9, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda values: hash_encode(values, unit, (2, 4), 32), (table,))


def test_corner_rows_by_hand():
    # resolution 6 has 343 nodes > 256 rows. The cell of (0.5, 0.2, 0.9) * 6 = (3, 1.2, 5.4) is (3, 1, 5).
    index, weights = level_corners(torch.tensor([[0.5, 0.2, 0.9]]), 6, 256)
    # primes mod 256: 2654435761 = 177, 805459861 = 149. 3 ^ 177 ^ (5 * 149 = 745) = 178 ^ 745 = 603, mod 256 = 91
    assert index[0, 0].item() == 91
    np.testing.assert_allclose(weights[0, 0].item(), 1.0 * 0.8 * 0.6, rtol=1e-4)
    np.testing.assert_allclose(weights.sum().item(), 1.0, rtol=1e-6)


@given(st.integers(2, 160), st.integers(4, 17), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_rows_stay_in_their_level_and_weights_sum_to_one(resolution, log_rows, seed):
    unit = torch.rand(50, 3, generator=torch.Generator().manual_seed(seed))
    index, weights = level_corners(unit, resolution, 2**log_rows)
    assert index.dtype == torch.int32
    assert index.min() >= 0
    assert index.max() < level_rows(resolution, 2**log_rows)
    torch.testing.assert_close(weights.sum(1), torch.ones(50))
    assert weights.min() > -1e-4


def test_levels_grow_geometrically_to_the_resolution():
    # growth (96 / 12) ** (1 / 3) = 2
    assert HashConfig(96, base_resolution=12, levels=4).resolutions == (12, 24, 48, 96)
    assert HashConfig(96, levels=1).resolutions == (96,)
    for resolution in (64, 160):
        levels = HashConfig(resolution).resolutions
        assert levels[0] == 12
        assert levels[-1] == resolution
        assert list(levels) == sorted(set(levels))


def test_field_pitch_is_the_finest_cell():
    assert HashField(HashConfig(80)).field_pitch == pytest.approx(4 / 80)
    assert HashField(HashConfig(80, contract=False)).field_pitch == pytest.approx(2 / 80)
    # along a line within one cell of the finest of equal levels the features are linear
    field = HashField(HashConfig(10, base_resolution=10, levels=1, contract=False))
    line = torch.tensor([[0.02 + 0.05 * t, 0.1, 0.1] for t in range(4)])  # the cell reaches from 0 to 0.2
    steps = field.encode(line).diff(dim=0)
    torch.testing.assert_close(steps[0], steps[1])
    assert steps[0].abs().max() > 0
    beyond = field.encode(torch.tensor([[0.19, 0.1, 0.1], [0.24, 0.1, 0.1]])).diff(dim=0)[0]
    assert not torch.allclose(beyond, steps[0])


def test_no_points_keep_the_graph_and_nan_gives_nan():
    table = table_of()
    value = hash_encode(table, torch.zeros(0, 3), RESOLUTIONS, ROWS)
    assert value.shape == (0, 6)
    value.sum().backward()
    assert not table.grad.any()
    unit = torch.full((2, 3), 0.4)
    unit[0, 1] = float("nan")
    value = hash_encode(table, unit, RESOLUTIONS, ROWS)
    assert value[0].isnan().all()
    assert value[1].isfinite().all()


def test_a_wrong_table_is_refused():
    with pytest.raises(ValueError, match=r"hash_encode: table must have 576 rows for \(3, 6, 12\), got 5"):
        hash_encode(torch.zeros(5, 2), torch.zeros(1, 3), RESOLUTIONS, ROWS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resolution": 3}, "HashConfig: resolution must be >= 4, got 3"),
        ({"resolution": 10}, r"base_resolution must lie in \[1, resolution = 10\], got 12"),
        ({"levels": 0}, "levels and features must be >= 1, got 0 and 2"),
        ({"rows": 1000}, r"rows must be a power of two in \[2, 2\^20\], got 1000"),
        ({"rows": 2**21}, r"rows must be a power of two in \[2, 2\^20\], got 2097152"),
        ({"initial_opacity": 1.5}, r"initial_opacity must lie in \(0, 1\), got 1.5"),
        ({"width": 0}, "width and hidden must be >= 1, got 0 and 1"),
    ],
)
def test_bad_configs_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        HashConfig(**arguments)
