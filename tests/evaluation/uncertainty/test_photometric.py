"""Doubt by photos: a wall that is where it seems to be is believed, anything else is not."""

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.uncertainty.photometric import photo_doubt, sample_bilinear

SIDE = 24


def looking_down(places):
    """Cameras at (x, y, 2) that look at the plane z = 0."""
    poses = np.zeros((len(places), 3, 4))
    poses[:, :, :3], poses[:, :2, 3], poses[:, 2, 3] = np.eye(3), places, 2.0
    return Cameras.create(poses, np.array([SIDE, SIDE, SIDE / 2, SIDE / 2]), SIDE, SIDE)


def wall(cameras, height=0.0):
    """Photos of a smooth painting on z = 0, and the depth of the plane z = height along the rays."""
    photos, depths = [], []
    for index in range(len(cameras)):
        origins, directions = cameras.rays(index)
        ground = origins - directions * (origins[..., 2:] / directions[..., 2:])
        painting = 0.5 + 0.4 * np.stack(
            [np.sin(4 * ground[..., 0]), np.cos(3 * ground[..., 1]), np.sin(2 * ground[..., 0] + ground[..., 1])],
            axis=-1,
        )
        photos.append(painting)
        depths.append((height - origins[..., 2]) / directions[..., 2])
    return np.stack(photos), np.stack(depths)


def doubt(eval_height, train_height=0.0, **over):
    seen, taught = looking_down([(0.1, 0.05)]), looking_down([(-0.3, 0.0), (0.3, 0.2), (0.0, -0.3)])
    colors, _ = wall(seen)
    _, depth = wall(seen, eval_height)
    photos, photo_depth = wall(taught, train_height)
    return photo_doubt(colors, depth, seen, photos=photos, photo_depth=photo_depth, photo_cameras=taught, **over)[0]


def test_a_true_wall_is_believed_and_a_ghost_before_it_is_not():
    true, ghost = doubt(0.0), doubt(0.8)
    assert np.median(true) < 0.01  # what bilinear sampling leaves
    assert np.median(ghost[8:-8, 8:-8]) > 10 * np.median(true)


def test_what_the_field_hides_from_a_photo_is_not_held_against_it():
    assert (doubt(0.0, train_height=1.0) == 1.0).all()  # everything lies far behind what the photos' cameras see
    assert (doubt(0.0, train_height=1.0, slack=3.0) < 1.0).any()
    assert (doubt(0.0, train_height=0.05) == 1.0).sum() == (doubt(0.0) == 1.0).sum()  # within 5 %
    assert (doubt(0.0, train_height=0.05, tolerance=0.0) == 1.0).all()


def test_by_hand_for_one_pixel_and_one_that_nobody_sees():
    camera = looking_down([(0.0, 0.0)])
    grey = np.full((1, SIDE, SIDE, 3), 0.25)
    depth = np.full((1, SIDE, SIDE), 2.0)
    depth[0, 0, 0] = np.inf
    photos = np.full((1, SIDE, SIDE, 3), (0.25, 0.5, 1.0))
    found = photo_doubt(grey, depth, camera, photos=photos, photo_depth=depth, photo_cameras=camera)
    assert found.dtype == np.float32
    assert found[0, 0, 0] == 1.0
    np.testing.assert_allclose(found[0, 5:-5, 5:-5], (0.0 + 0.25 + 0.75) / 3 / 2**0.5, rtol=1e-6)


@pytest.mark.parametrize("nearer", [1.0, 0.97, 0.9])
def test_photos_in_which_the_point_is_on_the_surface_make_it_surer(nearer):
    camera, many = looking_down([(0.0, 0.0)]), looking_down([(0.0, 0.0)] * 8)
    grey, photos = np.full((1, SIDE, SIDE, 3), 0.5), np.full((8, SIDE, SIDE, 3), 0.25)
    depth = np.full((1, SIDE, SIDE), 2.0)
    found = photo_doubt(
        grey, depth * nearer, camera, photos=photos, photo_depth=np.repeat(depth, 8, axis=0), photo_cameras=many
    )
    np.testing.assert_allclose(found[0, 5:-5, 5:-5], 0.25 / (3.0 if nearer > 0.95 else 1.0), rtol=1e-6)


@pytest.mark.parametrize("tolerance", [0.05, 1.0, 3.0])
def test_a_photo_that_looks_into_nothing_sees_but_has_no_surface(tolerance):
    camera = looking_down([(0.0, 0.0)])
    grey, photos = np.full((1, SIDE, SIDE, 3), 0.5), np.full((1, SIDE, SIDE, 3), 0.25)
    depth = np.full((1, SIDE, SIDE), 2.0)
    found = photo_doubt(
        grey, depth, camera, photos=photos, photo_depth=depth * np.inf, photo_cameras=camera, tolerance=tolerance
    )
    np.testing.assert_allclose(found[0, 5:-5, 5:-5], 0.25, rtol=1e-6)


def test_the_mean_over_photos_that_have_no_surface_there_does_not_depend_on_their_order():
    seen, taught = looking_down([(0.0, 0.0)]), looking_down([(-0.4, 0.0), (0.5, 0.2), (0.0, -0.3)])
    colors, depth = wall(seen, 0.3)
    photos, photo_depth = wall(taught)

    def found(order):
        return photo_doubt(
            colors,
            depth,
            seen,
            photos=photos[order],
            photo_depth=photo_depth[order],
            photo_cameras=taught.select(order),
        )

    np.testing.assert_allclose(found([0, 1, 2]), found([2, 0, 1]), rtol=1e-5)
    singles = np.stack([found([index]) for index in range(3)])
    together, everywhere = found([0, 1, 2]), (singles < 1).all(axis=0)
    assert everywhere.any()
    np.testing.assert_allclose(together[everywhere], singles.mean(axis=0)[everywhere], rtol=1e-5)


def test_bilinear_samples_agree_with_scipy():
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(0)
    image, pixels = rng.uniform(size=(7, 9, 3)), rng.uniform(-1, 11, size=(200, 2))
    wanted = np.stack(
        [
            map_coordinates(image[..., channel], [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5], order=1, mode="nearest")
            for channel in range(3)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(sample_bilinear(image, pixels), wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colors": np.zeros((1, SIDE, SIDE))}, r"colors must have shape \(1, 24, 24, 3\) for cameras"),
        ({"photos": np.full((1, SIDE, SIDE, 3), 255.0)}, r"photos must lie in \[0, 1\], 1728 values do not"),
        ({"depth": np.zeros((1, SIDE, SIDE))}, "depth must be > 0"),
        ({"photo_depth": np.full((1, SIDE, SIDE), np.nan)}, "photo_depth must be > 0 .*, 576 values do not"),
        ({"tolerance": -1.0}, "tolerance must be finite and >= 0, got -1.0"),
        ({"slack": np.inf}, "slack must be finite"),
    ],
)
def test_errors_name_argument_and_rule(change, message):
    camera = looking_down([(0.0, 0.0)])
    grey, depth = np.full((1, SIDE, SIDE, 3), 0.5), np.full((1, SIDE, SIDE), 2.0)
    given = {
        "colors": grey,
        "depth": depth,
        "cameras": camera,
        "photos": grey,
        "photo_depth": depth,
        "photo_cameras": camera,
        **change,
    }
    with pytest.raises(ValueError, match=f"photo_doubt: {message}"):
        photo_doubt(**given)
