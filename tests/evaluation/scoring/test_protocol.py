import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.scoring import protocol

WIDTH, HEIGHT, WALL = 20, 16, 4.0


def _cameras(offsets, *, focal=20.0, distortion=None):
    """Cameras at ``offsets (n, 3)``, all looking along -z."""
    poses = np.tile(np.eye(4), (len(offsets), 1, 1))
    poses[:, :3, 3] = offsets
    return Cameras.create(poses, np.array([focal, focal, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT, distortion)


def _wall_depth(cameras, z=-WALL):
    """Distance along unit rays to the plane z."""
    depths = []
    for index in range(len(cameras)):
        origins, directions = cameras.rays(index)
        depths.append((z - origins[..., 2]) / directions[..., 2])
    return np.stack(depths)


TRAIN = _cameras([[0.0, 0, 0], [1.0, 0, 0]])
EVAL = _cameras([[0.5, 0, 0], [3.0, 0, 0]])
LIMIT = 6.0  # origins reach from x = 0 to x = 3


def test_depth_limit_is_twice_the_widest_baseline_over_both_sweeps():
    assert protocol.depth_limit(TRAIN, EVAL) == pytest.approx(LIMIT)
    assert protocol.depth_limit(TRAIN, TRAIN) == pytest.approx(2.0)
    with pytest.raises(ValueError, match="two distinct camera origins"):
        protocol.depth_limit(_cameras([[0.0, 0, 0]]), _cameras([[0.0, 0, 0]]))


def test_visibility_of_a_wall_by_hand():
    # half the image is 10 pixels of 1 / 20, so a frustum is z / 2 = 2 to either side at the wall
    visible = protocol.visibility_masks(EVAL, _wall_depth(EVAL), TRAIN)
    for index, eye in enumerate((0.5, 3.0)):
        points = eye + (np.arange(WIDTH) + 0.5 - WIDTH / 2) / 20 * WALL
        seen = (np.abs(points) <= 2) | (np.abs(points - 1) <= 2)
        np.testing.assert_array_equal(visible[index], np.broadcast_to(seen, (HEIGHT, WIDTH)))
    assert visible[0].all()
    assert 0 < visible[1].mean() < 1


def test_visibility_can_ask_for_more_views():
    pseudo = _wall_depth(EVAL)
    twice = protocol.visibility_masks(EVAL, pseudo, TRAIN, minimum_views=2)
    once = protocol.visibility_masks(EVAL, pseudo, TRAIN)
    assert twice.sum() < once.sum()
    assert not (twice & ~once).any()
    with pytest.raises(ValueError, match="minimum_views must be >= 1, got 0"):
        protocol.visibility_masks(EVAL, pseudo, TRAIN, minimum_views=0)


def test_a_pixel_without_surface_is_taken_to_be_far_away():
    away = np.diag([-1.0, 1.0, -1.0, 1.0])[None]  # turned about y: looks along +z
    lens = np.array([20.0, 20.0, WIDTH / 2, HEIGHT / 2])
    nothing = np.full((1, HEIGHT, WIDTH), np.inf)
    behind = Cameras.create(away, lens, WIDTH, HEIGHT)
    eye = _cameras([[1.0, 0.0, 0.0]])
    # a camera with a wider view, one unit aside, sees every far point; one looking away sees none
    assert protocol.visibility_masks(eye, nothing, _cameras([[0.0, 0, 0]], focal=15.0)).all()
    assert not protocol.visibility_masks(eye, nothing, behind).any()


def test_a_lens_that_bends_changes_what_is_visible():
    bent = _cameras([[3.0, 0, 0]], distortion=np.array([-0.2, 0, 0, 0, 0, 0]))
    straight = _cameras([[3.0, 0, 0]])
    masks = [protocol.visibility_masks(each, _wall_depth(each), TRAIN) for each in (straight, bent)]
    assert (masks[0] != masks[1]).any()


def test_occlusion_aware_visibility_hides_what_stands_behind_something():
    pseudo = _wall_depth(EVAL)
    open_view = protocol.visibility_masks(EVAL, pseudo, TRAIN, train_depth=_wall_depth(TRAIN))
    np.testing.assert_array_equal(open_view, protocol.visibility_masks(EVAL, pseudo, TRAIN))
    blocked = protocol.visibility_masks(EVAL, pseudo, TRAIN, train_depth=_wall_depth(TRAIN, z=-1.0))
    assert not blocked.any()


def test_masks_of_depth_and_of_several_methods():
    pseudo = _wall_depth(EVAL)
    visible = protocol.visibility_masks(EVAL, pseudo, TRAIN)
    holed = pseudo.copy()
    holed[:, :, :10] = np.inf
    masks = [visible & protocol.depth_masks(each, LIMIT) for each in (pseudo, holed)]
    np.testing.assert_array_equal(protocol.common_mask(masks), masks[1])
    assert masks[1].sum() < masks[0].sum()


def test_errors_name_what_is_wrong():
    pseudo = _wall_depth(EVAL)
    visible = np.ones(pseudo.shape, dtype=bool)
    with pytest.raises(ValueError, match="view_counts: pseudo_depth must have shape"):
        protocol.view_counts(EVAL, pseudo[:1], TRAIN)
    spoilt = pseudo.copy()
    spoilt[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"pseudo_depth must be > 0 .* 1 values are not"):
        protocol.view_counts(EVAL, spoilt, TRAIN)
    with pytest.raises(ValueError, match="limit must be > 0, got 0"):
        protocol.depth_masks(pseudo, 0)
    with pytest.raises(ValueError, match="at least one mask"):
        protocol.common_mask([])
    with pytest.raises(ValueError, match="must have one shape"):
        protocol.common_mask([visible, visible[:1]])
