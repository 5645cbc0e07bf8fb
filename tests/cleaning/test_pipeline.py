import itertools
import json
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from scipy import ndimage

from unghost.cleaning.keep_mask import KeepMask
from unghost.cleaning.pipeline import CleanSettings, clean, grid_of, threshold_of
from unghost.core.occupancy import OccupancyRule

BOX = np.array([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]])
PITCH = 2 / 64


def room(positions):
    """A floor, a wall and a ball (solid: optical depth 2 a cell), two floaters and a fog sheet (0.3 a cell)."""
    x, y, z = np.moveaxis(np.asarray(positions, dtype=np.float64), -1, 0)
    true = (z < -0.4) | (x < -0.9) | ((x - 0.3) ** 2 + y**2 + (z + 0.2) ** 2 < 0.25**2)
    ghost = ((x + 0.3) ** 2 + (y - 0.5) ** 2 + (z - 0.1) ** 2 < 0.15**2) | (
        (x - 0.5) ** 2 + (y + 0.6) ** 2 + (z - 0.1) ** 2 < 0.1**2
    )
    ghost |= (abs(z - 0.4) < 0.04) & (abs(x) < 0.6) & (abs(y) < 0.6)
    return true, ghost & ~true


def room_density(positions):
    true, ghost = room(positions)
    return (2.0 / PITCH * true + 0.3 / PITCH * ghost).astype(np.float32)


def keep_what_reaches_the_border(channels):
    """Within a window: opaque things that leave it are real, what hangs free in it is not, faint things never are."""
    result = np.full_like(channels, -1.0)
    for window, out in zip(channels[:, 0], result[:, 0]):
        labels, _ = ndimage.label(window > 0.5, np.ones((3, 3, 3)))
        border = np.ones_like(labels, bool)
        border[1:-1, 1:-1, 1:-1] = False
        out[np.isin(labels, np.setdiff1d(labels[border], 0))] = 1.0
    return result


def score(mask):
    axes = [np.linspace(low, high, 2 * n + 1)[1::2] for low, high, n in zip(BOX[0], BOX[1], (64, 64, 32))]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    true, ghost = room(positions)
    kept = mask.keep(positions)
    return (ghost & ~kept).sum() / ghost.sum(), (true & kept).sum() / true.sum()


@pytest.mark.parametrize("kind", ["numpy_denoiser", "torch_denoiser"])
def test_the_rooms_ghosts_go_and_the_room_stays(kit, kind):
    denoiser = getattr(kit, kind)(keep_what_reaches_the_border)
    mask = clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH)
    recall, kept = score(mask)
    assert recall >= 0.99
    assert kept >= 0.99
    summary = mask.summary()
    assert summary["region_count"] == len(summary["regions"]) == 3
    assert summary["removed"] == sum(region["voxels"] for region in summary["regions"])
    assert 0 < summary["removed_share"] < 0.5
    low, high = np.array(summary["regions"][0]["box"])  # the fog sheet is the largest
    np.testing.assert_allclose([low, high], [[-0.6, -0.6, 0.36], [0.6, 0.6, 0.44]], atol=2 * PITCH)
    assert summary["regions"][0]["confidence"] > 0.9
    edges = {round(float(fraction), 6) for call in denoiser.calls for fraction in np.atleast_1d(call[2])}
    assert edges == {0.5, 1.0}  # 32 cells of 2 / 64, then twice that, of an extent of 2


def test_torch_callables_and_modules_give_the_same_mask(kit):
    denoiser = kit.numpy_denoiser(keep_what_reaches_the_border)
    reference = clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH)

    def torch_fn(p):
        return torch.as_tensor(room_density(p.cpu().numpy()))[:, None].to(p.dtype)

    for backend in (None, "torch"):
        mask = clean(torch_fn, BOX, denoiser=denoiser, field_pitch=PITCH, backend=backend)
        assert (mask.cells == reference.cells).all()


def test_the_same_mask_with_skipping_off_and_in_other_chunks(kit):
    def hollow(p):
        return room_density(p) * (p[:, 2] > -0.35) * (p[:, 0] > -0.85)

    denoiser = kit.numpy_denoiser(keep_what_reaches_the_border)
    box = BOX * 2
    reference = clean(hollow, box, denoiser=denoiser, field_pitch=PITCH)
    assert 0 < reference.summary()["removed"] < reference.summary()["occupied"]
    for options in ({"skip_empty": False}, {"chunk": 1000}):
        mask = clean(hollow, box, denoiser=denoiser, field_pitch=PITCH, **options)
        assert (mask.cells == reference.cells).all()
        assert (mask.summary()["windows"] > reference.summary()["windows"]) == ("skip_empty" in options)


def test_empty_space_costs_no_windows(kit):
    def lonely(p):
        return 50.0 * (np.linalg.norm(p, axis=-1) < 0.3)

    small = np.array([[-0.5] * 3, [0.5] * 3])
    sent = []
    for box in (small, small * 2):
        mask = clean(lonely, box, denoiser=kit.numpy_denoiser(kit.identity), field_pitch=1 / 32, level_weights=(1.0,))
        sent.append(mask.summary()["windows"])
    assert sent[1] <= 1.2 * sent[0]


def test_strength_runs_from_nothing_to_everything(kit):
    def unsure(channels):
        return np.clip(channels * 0.5, -0.6, 0.6)

    denoiser = kit.numpy_denoiser(unsure)
    masks = [clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH, strength=s) for s in (0, 0.25, 0.5, 1)]
    removed = [mask.summary()["removed"] for mask in masks]
    assert removed[0] == 0
    assert masks[0].cells.all()
    assert removed == sorted(removed)
    assert removed[3] == masks[3].summary()["occupied"]
    assert all((weak.cells | ~strong.cells).all() for weak, strong in itertools.pairwise(masks))


def test_a_budget_limits_what_goes(kit):
    denoiser = kit.numpy_denoiser(lambda channels: np.clip(channels - 0.2, -1, 1))
    whole = clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH, smallest=0, speck=0, strength=0.6)
    share = whole.summary()["depth_removed_share"]
    assert 0.02 < share < 0.5
    limited = clean(
        room_density, BOX, denoiser=denoiser, field_pitch=PITCH, smallest=0, speck=0, strength=0.6, budget=share / 3
    )
    assert 0.8 * share / 3 < limited.summary()["depth_removed_share"] <= share / 3 * (1 + 1e-9)
    assert limited.cells[whole.cells].all()
    ample = clean(
        room_density, BOX, denoiser=denoiser, field_pitch=PITCH, smallest=0, speck=0, strength=0.6, budget=0.99
    )
    np.testing.assert_array_equal(ample.cells, whole.cells)


def test_a_large_removal_is_a_warning(kit):
    denoiser = kit.numpy_denoiser(lambda channels: np.full_like(channels, -0.5))
    with pytest.warns(UserWarning, match="clean: 100% of the field's optical depth is removed; .* set budget"):
        clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH, fringe=0)


@pytest.mark.parametrize("budget", [0.0, -0.1, 1.1, float("nan")])
def test_impossible_budgets_are_refused(budget):
    with pytest.raises(ValueError, match=r"clean: budget must be in \(0, 1\]"):
        CleanSettings(budget=budget)


def test_threshold_of_strength():
    for advised in (-0.7, 0.0, 0.4):
        assert threshold_of(0.0, advised) == -1.0
        assert threshold_of(0.5, advised) == pytest.approx(advised)
        assert threshold_of(1.0, advised) > 1.0


def test_nothing_at_all_and_everything_full(kit):
    for level in (0.0, 1e30):
        for predict in (kit.all_empty, kit.all_full):
            mask = clean(
                lambda p, v=level: np.full(len(p), v), BOX, denoiser=kit.numpy_denoiser(predict), resolution=20
            )
            gone = level > 0 and predict is kit.all_empty
            assert mask.cells.any() != gone
            assert mask.summary()["occupied"] == (mask.cells.size if level else 0)
            json.dumps(mask.summary())


def test_a_callable_that_does_not_look_at_its_positions_is_pointed_out(kit):
    with pytest.warns(UserWarning, match="clean: density_fn returned 4 at each of 4500 places"):
        clean(lambda p: np.full(len(p), 4.0), BOX, denoiser=kit.numpy_denoiser(kit.identity), resolution=20)


def test_keep_boxes_are_left_alone(kit):
    box = [[-1.0, -1.0, 0.3], [1.0, 1.0, 0.5]]
    mask = clean(room_density, BOX, denoiser=kit.numpy_denoiser(kit.all_empty), field_pitch=PITCH, keep_boxes=(box,))
    positions = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.45]])
    assert mask.keep(positions).tolist() == [True, False]


def test_a_box_that_the_pitch_does_not_divide(kit):
    box = np.array([[0.0, 0.0, 0.0], [1.0, 0.55, 0.01]])

    def inside_only(p):
        assert ((p >= box[0] - 1e-6) & (p <= box[1] + 1e-6)).all()
        return np.full(len(p), 100.0)

    mask = clean(inside_only, box, denoiser=kit.numpy_denoiser(kit.all_empty), field_pitch=0.1)
    assert mask.cells.shape == (10, 6, 1)
    assert not mask.keep(np.array([[0.5, 0.27, 0.005]])).any()
    assert mask.keep(np.array([[0.5, 0.27, 0.02]])).all()  # outside


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_mask_does_not_depend_on_the_scenes_unit(kit, unit):
    denoiser = kit.numpy_denoiser(keep_what_reaches_the_border)
    reference = clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH)
    scaled = clean(lambda p: room_density(p / unit) / unit, BOX * unit, denoiser=denoiser, field_pitch=PITCH * unit)
    assert (scaled.cells != reference.cells).mean() < 0.002  # float32 positions on the edge of a solid


def test_the_papers_rule(kit):
    denoiser = kit.numpy_denoiser(keep_what_reaches_the_border)
    clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH, rule=OccupancyRule.paper())
    assert set(np.unique(np.concatenate([call[0].ravel() for call in denoiser.calls]))) == {-1.0, 1.0}


@pytest.mark.parametrize(("bad", "word"), [(np.nan, "NaN"), (np.inf, "infinite"), (-1.0, "negative")])
def test_invalid_densities_raise_or_are_dropped(kit, bad, word):
    def fn(p):
        return np.where(p[:, 0] > 0.5, bad, room_density(p))

    denoiser = kit.numpy_denoiser(kit.identity)
    with pytest.raises(ValueError, match=rf"clean: densities must be finite .* {word} of .*; first .* at \["):
        clean(fn, BOX, denoiser=denoiser, field_pitch=PITCH)
    mask = clean(fn, BOX, denoiser=denoiser, field_pitch=PITCH, drop_invalid=True)
    assert mask.summary()["dropped"] == 16 * 64 * 32
    assert mask.cells[48:].all()


def test_bad_input(kit):
    denoiser = kit.numpy_denoiser(kit.identity)
    with pytest.raises(ValueError, match="clean: aabb must have min < max on every axis, z fails"):
        clean(room_density, [[0, 0, 1], [1, 1, 0]], denoiser=denoiser)
    with pytest.raises(ValueError, match="clean: density_fn must return shape"):
        clean(lambda p: p, BOX, denoiser=denoiser)
    with pytest.raises(ValueError, match="more than 134217728"):
        clean(room_density, BOX, denoiser=denoiser, field_pitch=1e-4)
    with pytest.raises(TypeError, match=r"unknown settings \['edges'\]"):
        clean(room_density, BOX, denoiser=denoiser, edges=3)
    with pytest.raises(ValueError, match="strength must be in"):
        CleanSettings(strength=1.5)
    with pytest.raises(ValueError, match=r"keep_boxes: aabb must have shape \(2, 3\)"):
        CleanSettings(keep_boxes=([0, 0, 0],))
    with pytest.raises(ValueError, match="must return shape"):
        clean(room_density, BOX, denoiser=kit.numpy_denoiser(lambda c: c[:, :, 1:]), field_pitch=PITCH)
    with pytest.raises(ValueError, match="not finite"):
        clean(room_density, BOX, denoiser=kit.numpy_denoiser(lambda c: c * np.nan), field_pitch=PITCH)


def test_the_grid():
    assert grid_of(BOX, CleanSettings()) == (2 / 128, (128, 128, 64))
    assert grid_of(BOX, CleanSettings(field_pitch=0.1)) == (0.1, (20, 20, 10))
    assert grid_of(BOX, CleanSettings(field_pitch=0.1, resolution=10)) == (0.2, (10, 10, 5))


def test_a_cleaned_field_saved_and_applied(kit, tmp_path):
    denoiser = kit.numpy_denoiser(keep_what_reaches_the_border)
    mask = clean(room_density, BOX, denoiser=denoiser, field_pitch=PITCH)
    mask.save(tmp_path / "keep.npz")
    again = KeepMask.load(tmp_path / "keep.npz")
    ghosts = np.array([[-0.3, 0.5, 0.1], [0.0, 0.0, 0.4]])
    assert (room_density(ghosts) > 0).all()
    assert (again.apply(room_density)(ghosts) == 0).all()
    assert json.dumps(again.summary()) == json.dumps(mask.summary())
    twice = clean(again.apply(room_density), BOX, denoiser=denoiser, field_pitch=PITCH)
    assert twice.summary()["removed"] == 0


def test_it_is_quick(kit):
    start = time.perf_counter()
    clean(room_density, BOX, denoiser=kit.numpy_denoiser(kit.identity), resolution=128)
    assert time.perf_counter() - start < 20


GUARD = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"torch", "scipy", "onnx", "onnxruntime", "trimesh", "open3d"}:
            raise ImportError("blocked " + name)
sys.meta_path.insert(0, Block())
import numpy as np
from unghost.core.manifest import Manifest
from unghost.cleaning.pipeline import clean
class Empty:
    kind, manifest = "numpy", Manifest("empty")
    def __call__(self, channels, timestep, edge_fraction):
        return channels * 0 - 1
mask = clean(lambda p: (p[:, 0] > 0) * 90.0, [[-1, -1, -1], [1, 1, 1]], denoiser=Empty(), resolution=16)
assert mask.cells.sum() == 16**3 // 2
TWIN
"""


def test_clean_needs_neither_torch_nor_scipy():
    subprocess.run([sys.executable, "-c", GUARD.replace("TWIN", "")], check=True, timeout=60)


def test_the_guard_can_fail_and_the_regularizer_names_the_extra():
    twin = GUARD.replace("TWIN", "import unghost.regularizer.density_regularizer")
    failed = subprocess.run([sys.executable, "-c", twin], capture_output=True, text=True, timeout=60, check=False)
    assert failed.returncode != 0
    assert "pip install unghost[torch]" in failed.stderr
