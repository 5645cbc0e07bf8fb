import json
import os
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.cleaning.keep_mask import KeepMask

BOX = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 1.0]])


def halves(details=None):
    cells = np.ones((4, 2, 2), bool)
    cells[2:] = False  # x >= 1 goes
    return KeepMask(BOX, 0.5, cells, details or {"occupied": 8, "removed": 2, "regions": []})


POSITIONS = np.array([[0.3, 0.5, 0.5], [1.7, 0.5, 0.5], [3.0, 0.5, 0.5], [np.nan, 0.5, 0.5], [2.0, 1.0, 1.0]])
KEPT = [True, False, True, True, False]


def test_keep_by_hand_outside_and_not_finite_unchanged():
    assert halves().keep(POSITIONS).tolist() == KEPT
    kept = halves().keep(torch.as_tensor(POSITIONS, dtype=torch.float32).view(5, 1, 3))
    assert kept.dtype is torch.bool
    assert kept.view(-1).tolist() == KEPT


@pytest.mark.parametrize("trailing", [True, False])
def test_apply_gives_what_it_got(trailing):
    def numpy_fn(p):
        value = np.full(p.shape[:-1], 7.0, np.float32)
        return value[..., None] if trailing else value

    cleaned = halves().apply(numpy_fn)(POSITIONS)
    assert cleaned.shape == ((5, 1) if trailing else (5,))
    assert cleaned.dtype == np.float32
    assert cleaned.reshape(-1).tolist() == [7.0 * kept for kept in KEPT]


def test_apply_to_tensors_keeps_the_gradient():
    level = torch.tensor(7.0, requires_grad=True)
    cleaned = halves().apply(lambda p: level.expand(*p.shape[:-1], 1))(torch.as_tensor(POSITIONS))
    assert cleaned.view(-1).tolist() == [7.0 * kept for kept in KEPT]
    cleaned.sum().backward()
    assert level.grad.item() == 3


def test_apply_names_a_wrong_shape():
    with pytest.raises(ValueError, match=r"KeepMask.apply: density_fn must return shape"):
        halves().apply(lambda p: p)(POSITIONS)


def test_apply_grid_at_any_resolution():
    mask = halves()
    for shape in ((4, 2, 2), (8, 4, 4), (6, 1, 3)):
        values = np.full((*shape, 2), 3, np.int16)
        cleaned = mask.apply_grid(values)
        assert cleaned.dtype == np.int16
        assert (cleaned[: shape[0] // 2] == 3).all()
        assert (cleaned[shape[0] // 2 :] == 0).all()
        assert (values == 3).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), shape=st.tuples(*[st.integers(1, 9)] * 3))
def test_saved_and_loaded_is_the_same(tmp_path_factory, seed, shape):
    cells = np.random.default_rng(seed).random(shape) < 0.5
    mask = KeepMask(np.array([[-1.0] * 3, np.array(shape) * 0.1 - 1.0]), 0.1, cells, {"occupied": 3, "removed": 1})
    path = tmp_path_factory.mktemp("masks") / "keep.npz"
    mask.save(path)
    again = KeepMask.load(path)
    assert (again.cells == cells).all()
    assert (again.aabb == mask.aabb).all()
    assert again.pitch == mask.pitch
    assert again.summary() == mask.summary()
    assert os.listdir(path.parent) == ["keep.npz"]


def test_a_failed_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "keep.npz"
    halves().save(path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="JSON"):
        halves({"occupied": float("nan")}).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["keep.npz"]


def write_npz(path, manifest, cells):
    np.savez(path, manifest=np.frombuffer(json.dumps(manifest).encode(), np.uint8), cells=cells)


def test_foreign_and_broken_files_are_named(tmp_path):
    path = tmp_path / "keep.npz"
    with pytest.raises(FileNotFoundError):
        KeepMask.load(path)
    halves().save(path)
    whole = path.read_bytes()
    good = {
        "format": "unghost-keep-mask",
        "format_version": 1,
        "aabb": BOX.tolist(),
        "pitch": 0.5,
        "shape": [4, 2, 2],
        "details": {},
    }
    bits = np.zeros(2, np.uint8)
    write_npz(path, good, bits)
    KeepMask.load(path)
    for content in (b"", b"not a file", whole[: len(whole) // 2], pickle.dumps([1, 2])):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"keep\.npz is not a keep mask, or is truncated"):
            KeepMask.load(path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(ValueError, match=r"keep\.npz is not a keep mask"):
        KeepMask.load(path)
    np.savez(path, manifest=np.array([{"a": 1}], dtype=object), cells=bits)  # a pickle inside
    with pytest.raises(ValueError, match=r"keep\.npz is not a keep mask"):
        KeepMask.load(path)
    for change, cells, message in (
        ({"format": "other"}, bits, "format must be"),
        ({"format_version": 2}, bits, "has version 2, this release reads 1"),
        ({"shape": [4, 2, 200]}, bits, "do not fit shape"),
        ({"shape": [-4, -2, 2]}, bits, "do not fit shape"),
        ({"pitch": 0.1}, bits, "cover the box"),
        ({"aabb": [[0, 0, 0], [0, 1, 1]]}, bits, "min < max"),
        ({}, np.zeros(2, np.int64), "do not fit shape"),
    ):
        write_npz(path, good | change, cells)
        with pytest.raises(ValueError, match=message):
            KeepMask.load(path)


def test_summary():
    assert halves().summary()["removed_share"] == 0.25
    assert halves({"occupied": 0, "removed": 0}).summary()["removed_share"] == 0.0


def test_construction_errors():
    with pytest.raises(ValueError, match="cover the box"):
        KeepMask(BOX, 0.5, np.ones((3, 2, 2), bool))
    with pytest.raises(ValueError, match="must be bool"):
        KeepMask(BOX, 0.5, np.ones((4, 2, 2)))
    with pytest.raises(ValueError, match="pitch must be finite"):
        KeepMask(BOX, 0.0, np.ones((4, 2, 2), bool))


def test_what_was_removed_in_a_box_can_be_taken_back():
    rng = np.random.default_rng(2)
    box = np.array([[0.0, 0, 0], [4, 3, 2]])
    mask = KeepMask(box, 0.5, rng.random((8, 6, 4)) < 0.5, {"removed": 9})
    first, second = [[0.0, 0, 0], [1.0, 3, 2]], [[3.9, 0, 0], [9.0, 1.3, 2]]  # the latter's last layer has no centre
    restored = mask.restored([first])
    assert restored.cells[:2].all()
    assert (restored.cells[2:] == mask.cells[2:]).all()
    twice = restored.restored([second])
    assert twice.cells.sum() == restored.cells.sum()
    assert twice.details == {"removed": 9, "restored": [first, second]}
    assert mask.details == {"removed": 9}
    assert mask.restored([]) is mask
    with pytest.raises(ValueError, match=r"KeepMask\.restored: boxes"):
        mask.restored([[[1, 0, 0], [0, 1, 1]]])
