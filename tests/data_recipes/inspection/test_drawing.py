import io

import numpy as np
import pytest
from matplotlib.image import imread

from unghost.data_recipes.inspection.drawing import GHOST, SURFACE, best_turn, png_bytes, render_cube

GREY, ORANGE = np.full((32, 32, 32, 3), SURFACE), np.full((32, 32, 32, 3), GHOST)


def picture(opacity, colors=ORANGE, width=64):
    return render_cube(np.asarray(opacity, dtype=float), colors, width=width)


def orange(image):
    """Pixels that are far redder than blue: the room behind a cube is nearly grey."""
    return image[..., 0].astype(int) - image[..., 2] > 90


def test_an_empty_cube_shows_its_room_alone():
    image = picture(np.zeros((32, 32, 32)))
    assert image.shape == (64, 64, 3)
    assert image.dtype == np.uint8
    assert image.min() > 180
    assert (image.max(axis=-1).astype(int) - image.min(axis=-1)).max() < 12
    assert (image[0, 0] == 255).all()  # paper beyond the box


def test_a_full_cube_hides_its_room_and_shows_three_faces():
    image = picture(np.ones((32, 32, 32)))
    room = picture(np.zeros((32, 32, 32)))
    inside = (room != 255).any(axis=-1)
    assert orange(image)[inside].mean() > 0.93  # the rim is half paper
    # top, left and right face: three tones, the top the brightest
    tops, left, right = image[16, 32].sum(), image[44, 16].sum(), image[44, 48].sum()
    assert tops > max(left, right)
    assert abs(int(left) - int(right)) > 10


@pytest.mark.slow
def test_a_voxel_lies_where_the_axes_say():
    """x points to the right and towards the eye, y to the right and away, z up."""
    places = {}
    for name, place in {"x": (31, 16, 16), "y": (16, 31, 16), "z": (16, 16, 31), "middle": (16, 16, 16)}.items():
        opacity = np.zeros((32, 32, 32))
        opacity[place] = 1
        places[name] = np.argwhere(orange(picture(opacity, width=128))).mean(axis=0)  # row, column
    row, column = places["middle"]
    assert places["z"][0] < row - 20
    assert abs(places["z"][1] - column) < 3
    assert places["x"][0] > row + 5
    assert places["x"][1] > column + 10
    assert places["y"][0] < row - 5
    assert places["y"][1] > column + 10


def test_what_is_nearer_hides_what_is_behind():
    opacity, colors = np.zeros((32, 32, 32)), ORANGE.copy()
    opacity[20, 16:, :16] = 1  # a wall across x, further from the eye than x = 28
    assert orange(picture(opacity)).sum() > 100
    opacity[28] = 1
    colors[28] = SURFACE
    seen = orange(picture(opacity, colors)).sum()
    opacity[28] = 0
    assert seen < 0.05 * orange(picture(opacity, colors)).sum()


def test_fog_is_see_through_and_thickens():
    depths = [picture(np.full((32, 32, 32), opacity))[32, 32].astype(int) for opacity in (0.0, 0.02, 0.1, 1.0)]
    reds_over_blues = [depth[0] - depth[2] for depth in depths]
    assert reds_over_blues == sorted(reds_over_blues)
    assert reds_over_blues[0] + 20 < reds_over_blues[1] < reds_over_blues[-1] - 20


def test_a_floating_block_casts_a_shadow():
    opacity = np.zeros((32, 32, 32))
    opacity[10:22, 10:22, 20:24] = 1
    lit, shaded = picture(np.zeros((32, 32, 32)), GREY), picture(opacity, GREY)
    lower = slice(44, 60)  # the floor
    assert (lit[lower].astype(int) - shaded[lower]).max() > 25


def test_the_turn_shows_what_is_of_interest():
    opacity = np.zeros((32, 32, 32))
    opacity[8:24, 8:24, :] = 1
    for axis_end, place in {"+x": np.s_[24:26, 8:24], "-x": np.s_[6:8, 8:24], "+y": np.s_[8:24, 24:26]}.items():
        interest = np.zeros_like(opacity)
        interest[place] = 1
        solid = np.maximum(opacity, interest)
        colors = np.where(interest[..., None] > 0, GHOST, SURFACE)
        shown = [orange(picture(np.rot90(solid, turn), np.rot90(colors, turn))).sum() for turn in range(4)]
        assert shown[best_turn(solid, interest)] > 0.9 * max(shown), axis_end


def test_pictures_repeat_and_leave_their_arguments():
    rng = np.random.default_rng(0)
    opacity, colors = rng.random((32, 32, 32)) < 0.1, rng.random((32, 32, 32, 3))
    kept = opacity.copy(), colors.copy()
    np.testing.assert_array_equal(picture(opacity, colors), picture(opacity, colors))
    np.testing.assert_array_equal(opacity, kept[0])
    np.testing.assert_array_equal(colors, kept[1])


def test_png_files_read_back():
    image = np.random.default_rng(1).integers(0, 256, size=(5, 7, 3), dtype=np.uint8)
    read = np.rint(imread(io.BytesIO(png_bytes(image)), format="png")[..., :3] * 255)
    np.testing.assert_array_equal(read, image)


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"opacity must be \(R, R, R\) and colors \(R, R, R, 3\), got"):
        render_cube(np.zeros((4, 4, 4)), np.zeros((4, 4, 4)))
