import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.scoring.views import Renders, Truth, check_match, view_normals

COLOURS = np.full((2, 4, 5, 3), 0.5)


def _cameras():
    return Cameras.create(np.tile(np.eye(4), (2, 1, 1)), np.array([5.0, 5, 2.5, 2]), 5, 4)


def test_shapes_are_checked_once_and_named():
    with pytest.raises(
        ValueError, match=r"Renders: colours must have shape \(n, H, W, 3\) with pixels, got \(4, 5, 3\)"
    ):
        Renders(COLOURS[0])
    with pytest.raises(ValueError, match=r"with pixels, got \(0, 4, 5, 3\)"):
        Truth(COLOURS[:0])
    with pytest.raises(ValueError, match=r"Renders: depth must have shape \(2, 4, 5\), got \(2, 4, 5, 1\)"):
        Renders(COLOURS, np.ones((2, 4, 5, 1)))
    with pytest.raises(ValueError, match=r"accumulation must have shape \(2, 4, 5\)"):
        Renders(COLOURS, accumulation=np.ones((1, 4, 5)))
    with pytest.raises(ValueError, match=r"normals must have shape \(2, 4, 5, 3\)"):
        Truth(COLOURS, normals=np.ones((2, 4, 5)))
    with pytest.raises(ValueError, match=r"Truth: depth must be > 0 .* 40 values are not \(0 NaN\)"):
        Truth(COLOURS, depth=np.zeros((2, 4, 5)))


def test_colours_may_overshoot_by_rounding_only():
    assert len(Renders(COLOURS + 0.50005)) == 2
    with pytest.raises(ValueError, match=r"colours must lie in \[0, 1\], 120 values do not"):
        Renders(COLOURS + 0.51)
    spoilt = COLOURS.copy()
    spoilt[0, 0, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"photos must lie in \[0, 1\], 1 values do not \(NaN counts\)"):
        Truth(spoilt)


def test_names_default_to_numbers():
    assert Truth(COLOURS).names == ("0", "1")
    assert Truth(COLOURS, names=("a", "b")).names == ("a", "b")
    assert len(Truth(COLOURS)) == 2


def test_renders_of_another_size_say_what_to_do():
    with pytest.raises(ValueError, match="render at the photos' size, or resize the photos, before scoring"):
        check_match("t", Renders(COLOURS[:, :3]), Truth(COLOURS))


def test_normals_are_the_given_ones_else_of_the_depth_else_none():
    given, depth = np.ones((4, 5, 3)), np.full((4, 5), 2.0)
    assert view_normals(given, depth, _cameras(), 0) is given
    of_depth = view_normals(None, depth, _cameras(), 0)
    assert of_depth is not None
    assert np.linalg.norm(of_depth, axis=-1) == pytest.approx(np.ones((4, 5)))
    assert view_normals(None, None, _cameras(), 0) is None
    assert view_normals(None, depth, None, 0) is None
