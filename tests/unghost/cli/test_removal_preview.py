"""The preview's three views: what lies where, and that none is mirrored."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

from unghost.cleaning.keep_mask import KeepMask
from unghost.cli.removal_preview import GAP, SIDE, occupied_cells, preview_png

SHAPE = (6, 8, 10)  # x, y, z


def views(cells, occupied):
    """The three pictures, one pixel a cell, ``(rows, columns, 3)`` in [0, 1]."""
    mask = KeepMask(np.array([[0.0] * 3, SHAPE]), 1.0, cells)
    sheet = np.asarray(Image.open(io.BytesIO(preview_png(mask, occupied)))) / 255.0
    scale, left, found = -(-SIDE // max(SHAPE)), GAP, []
    for across, up in ((1, 2), (0, 2), (0, 1)):  # from +x, from -y, from above
        width, height = SHAPE[across] * scale, SHAPE[up] * scale
        bottom = len(sheet) - GAP
        found.append(sheet[bottom - height : bottom, left : left + width][scale // 2 :: scale, scale // 2 :: scale])
        left += width + GAP
    return found


@pytest.mark.parametrize("cell", [(5, 1, 8), (0, 7, 0), (2, 3, 4)])
def test_a_ghost_is_orange_where_it_is(cell):
    cells = np.ones(SHAPE, dtype=bool)
    cells[cell] = False
    x, y, z = cell
    for view, (across, up) in zip(views(cells, ~cells), ((y, z), (x, z), (x, y))):
        orange = view[..., 0] - view[..., 2] > 0.1
        assert np.argwhere(orange).tolist() == [[len(view) - 1 - up, across]]  # the first row is the top


@pytest.mark.parametrize(
    ("view", "near", "far"), [(0, (5, 2, 2), (0, 6, 6)), (1, (1, 0, 2), (4, 7, 6)), (2, (1, 2, 9), (4, 6, 0))]
)
def test_what_is_nearer_is_lighter(view, near, far):
    def darkest(cell):
        lone = np.zeros(SHAPE, dtype=bool)
        lone[cell] = True
        return views(np.ones(SHAPE, dtype=bool), lone)[view].min()

    assert darkest(far) < darkest(near) < 1.0


def test_a_torch_field_is_shown_as_a_numpy_one_is():
    mask = KeepMask(np.array([[0.0, 0, 0], [1, 1, 1]]), 0.25, np.ones((4, 4, 4), bool))
    net = torch.nn.Linear(3, 1)
    with torch.no_grad():
        net.weight.copy_(torch.tensor([[40.0, 0.0, 0.0]]))
        net.bias.fill_(-20.0)

    def density_fn(p):
        return torch.relu(net(p))

    found = occupied_cells(mask, density_fn)
    assert (found == occupied_cells(mask, lambda p: np.maximum(40 * p[:, 0] - 20, 0))).all()
    assert found.sum() == 32
