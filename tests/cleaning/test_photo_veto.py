import dataclasses

import numpy as np
import pytest

from unghost.cleaning.keep_mask import KeepMask
from unghost.cleaning.photo_veto import PhotoVeto, apply_veto
from unghost.cleaning.pipeline import clean
from unghost.core.cameras import Cameras, look_at
from unghost.core.occupancy import opacity_from_density, signed_from_opacity

BOX, CELLS = np.array([[-1.0] * 3, [1.0] * 3]), 32
PITCH = 2.0 / CELLS


def scene(positions):
    """A wall at x > .5, a haze in front of it that the photos show, and a blob behind it that none shows."""
    x, y, z = np.moveaxis(np.asarray(positions), -1, 0)
    wall, blob = np.abs(x - 0.55) < 0.1, (x > 0.75) & (np.abs(y) < 0.2) & (np.abs(z) < 0.2)
    haze = (np.abs(x) < 0.2) & (np.abs(y) < 0.5) & (np.abs(z) < 0.5)
    return np.where(wall | blob, 200.0, np.where(haze, 1.5, 0.0))


def colors(positions):
    """Red haze, blue wall."""
    red = np.abs(positions[..., :1]) < 0.2
    return np.where(red, [1.0, 0.1, 0.1], [0.1, 0.2, 0.9])


@pytest.fixture(scope="module")
def cameras():
    eyes = np.array([[-2.4, 0.0, 0.3], [-2.2, 0.6, -0.2]])
    return Cameras.create(look_at(eyes, np.array([[0.5, 0, 0], [0.5, 0, 0]])), np.array([30.0, 30, 12, 12]), 24, 24)


@pytest.fixture(scope="module")
def render(cameras):
    def render(density_fn, index):
        origins, directions = (ray.reshape(-1, 3) for ray in cameras.rays(index))
        step = 0.03
        places = origins[:, None] + (np.arange(140) + 0.5)[:, None] * step * directions[:, None]
        density = np.where(
            (np.abs(places) <= 1).all(-1), np.asarray(density_fn(places.reshape(-1, 3))).reshape(places.shape[:2]), 0
        )
        alpha = 1 - np.exp(-density * step)
        through = np.cumprod(np.concatenate([np.ones((len(alpha), 1)), 1 - alpha[:, :-1]], 1), 1)
        return ((through * alpha)[..., None] * colors(places)).sum(1).reshape(24, 24, 3)

    return render


@pytest.fixture(scope="module")
def parts():
    axis = -1 + (np.arange(CELLS) + 0.5) * PITCH
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    density = scene(places)
    signed = signed_from_opacity(opacity_from_density(density, PITCH)).astype(np.float32)
    haze, blob = (density > 0) & (np.abs(places[..., 0]) < 0.2), (density > 0) & (places[..., 0] > 0.75)
    wall = (density > 0) & ~haze & ~blob
    return signed, haze, blob, wall


def veto_of(cameras, render, **changes):
    photos = np.stack([render(scene, index) for index in range(len(cameras))])
    return PhotoVeto(photos, render, **changes)


def test_what_photos_show_comes_back_and_what_they_do_not_stays_away(cameras, render, parts):
    signed, haze, blob, _ = parts
    mask = KeepMask(BOX, PITCH, ~(haze | blob), {"removed": 3})
    vetoed = apply_veto(mask, veto_of(cameras, render), scene, signed, cameras)
    report = vetoed.summary()["veto"]
    assert report["psnr_cleaned"] < 25
    assert report["psnr_after"] >= 39.5 - 1e-9  # photos that are rendered exactly count as 40 dB
    assert not vetoed.cells[blob].any()  # behind the wall: no photo objects
    assert vetoed.cells[haze].mean() > 0.5
    assert report["given_back"] == int((vetoed.cells & ~mask.cells).sum()) > 0
    assert vetoed.cells[mask.cells].all()  # a veto never removes
    assert vetoed.summary()["removed"] == 3


def test_only_the_cells_to_blame_come_back(cameras, render, parts):
    """Beside the photographed haze, cells without density were removed: they are to blame for nothing."""
    signed, haze, _, wall = parts
    innocent = np.zeros_like(haze)
    innocent[:8] = True
    mask = KeepMask(BOX, PITCH, ~(wall | innocent))
    vetoed = apply_veto(mask, veto_of(cameras, render), scene, signed, cameras)
    assert not vetoed.cells[innocent].any()
    assert vetoed.summary()["veto"]["psnr_after"] > 39


def test_without_a_loss_nothing_comes_back(cameras, render, parts):
    signed, _, blob, _ = parts
    vetoed = apply_veto(KeepMask(BOX, PITCH, ~blob), veto_of(cameras, render), scene, signed, cameras)
    assert vetoed.summary()["veto"]["rounds"] == 0
    np.testing.assert_array_equal(vetoed.cells, ~blob)


def test_with_no_rounds_all_that_is_seen_comes_back(cameras, render, parts):
    signed, haze, blob, wall = parts
    mask = KeepMask(BOX, PITCH, ~(haze | blob | wall))
    vetoed = apply_veto(mask, veto_of(cameras, render, rounds=0, max_psnr_drop=0.1), scene, signed, cameras)
    assert vetoed.summary()["veto"]["rounds"] == 1
    assert not vetoed.cells[blob].any()
    assert vetoed.summary()["veto"]["psnr_after"] > 40


def test_photos_that_do_not_fit_are_refused(cameras, render, parts):
    signed, haze, *_ = parts
    mask = KeepMask(BOX, PITCH, ~haze)
    veto = veto_of(cameras, render)
    with pytest.raises(ValueError, match="clean: photos must be one for each of the 2 cameras, got 1"):
        apply_veto(mask, dataclasses.replace(veto, photos=veto.photos[:1]), scene, signed, cameras)
    small = dataclasses.replace(veto, render=lambda density_fn, index: np.zeros((3, 3, 3)))
    with pytest.raises(ValueError, match=r"clean: render must return \(24, 24, 3\) as the photos are, got \(3, 3, 3\)"):
        apply_veto(mask, small, scene, signed, cameras)
    for changes, message in (
        ({"photos": veto.photos[0]}, r"photos must have shape \(N, H, W, 3\), got \(24, 24, 3\)"),
        ({"max_psnr_drop": -1.0}, "max_psnr_drop must be finite and >= 0, got -1.0"),
        ({"rounds": -1}, "rounds must be >= 0, got -1"),
        ({"rays": 0}, "rays must be >= 1, got 0"),
    ):
        with pytest.raises(ValueError, match=f"PhotoVeto: {message}"):
            dataclasses.replace(veto, **changes)
    with pytest.raises(ValueError, match="clean: photos must come with cameras"):
        clean(scene, BOX, denoiser=None, veto=veto)


def test_clean_asks_the_photos(cameras, render, kit):
    """A denoiser that calls everything empty: with the photos, what they show stays."""
    denoiser = kit.numpy_denoiser(lambda channels: np.full_like(channels[:, :1], -0.9))
    with pytest.warns(UserWarning, match="of the field's optical depth is removed"):
        bare = clean(scene, BOX, denoiser=denoiser, field_pitch=PITCH, fringe=0)
    with pytest.warns(UserWarning, match="cameras are not used|optical depth"):
        vetoed = clean(
            scene, BOX, denoiser=denoiser, field_pitch=PITCH, cameras=cameras, fringe=0, veto=veto_of(cameras, render)
        )
    assert bare.cells.mean() < vetoed.cells.mean() < 1
    assert "veto" not in bare.details
    assert vetoed.summary()["veto"]["psnr_after"] > 39
