"""A slab, a ghost above it, and a denoiser that is sure of neither: which strength do held-out views choose?"""

import numpy as np
import pytest
import torch

from unghost.cleaning.pipeline import clean, judge
from unghost.cleaning.strength import choose_strength

BOX = np.array([[-1.0] * 3, [1.0] * 3])


def density_fn(p):
    slab = np.abs(p[..., 2] + 0.5) < 0.2
    ghost = (np.abs(p[..., :2]) < 0.2).all(axis=-1) & (np.abs(p[..., 2] - 0.6) < 0.2)
    return slab * 200.0 + ghost * 11.0  # opacities 1 and .5 over a cell


def unsure(kit):
    """What is half transparent is probably a ghost (-0.6), what is opaque perhaps one (-0.2)."""
    return kit.numpy_denoiser(lambda channels: np.where(channels > 0.5, -0.2, -0.6).astype(np.float32))


@pytest.fixture
def judgement(kit):
    return judge(density_fn, BOX, denoiser=unsure(kit), field_pitch=2 / 32)


def slab_lost(mask):
    """A view of the slab: its error is .01 (noise), and more with every cell of the slab that is gone."""
    places = np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 15)] * 2, [-0.5], indexing="ij"), axis=-1)
    return 0.01 + float((~mask.keep(places)).mean())


def test_masks_of_any_strength_are_those_of_clean(kit, judgement):
    for strength in (0.0, 0.1, 0.3, 0.45, 0.7, 1.0):
        whole = clean(density_fn, BOX, denoiser=unsure(kit), field_pitch=2 / 32, strength=strength)
        found = judgement.mask(strength)
        np.testing.assert_array_equal(found.cells, whole.cells)
        assert found.details == whole.details


def test_the_largest_strength_that_costs_nothing(judgement):
    choice = choose_strength(judgement, slab_lost)
    above, slab = np.array([[0.0, 0.0, 0.6]]), np.array([[0.5, 0.5, -0.5]])
    assert not choice.mask.keep(above)[0]
    assert choice.mask.keep(slab)[0]
    assert choice.errors[choice.strength] == pytest.approx(0.01)
    stronger = [strength for strength in choice.errors if strength > choice.strength]
    assert stronger
    assert all(choice.errors[strength] > 0.5 for strength in stronger)


def test_nothing_to_lose_means_the_strongest(judgement):
    assert choose_strength(judgement, lambda mask: 0.0).strength == 0.8
    assert choose_strength(judgement, lambda mask: 1.0, strengths=[0.3]).strength == 0.3


def test_a_tolerance_trades_error_for_strength(judgement):
    errors = {0.0: 1.0, 0.2: 1.05, 0.4: 1.2}
    seen = []

    def error(mask):
        seen.append(mask.details["settings"]["strength"])
        return errors[seen[-1]]

    assert choose_strength(judgement, error, strengths=errors).strength == 0.0
    assert choose_strength(judgement, error, strengths=errors, tolerance=0.1).strength == 0.2
    assert seen == [0.0, 0.2, 0.4] * 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"strengths": []}, r"one or more numbers in \[0, 1\], got \[\]"),
        ({"strengths": [0.5, 1.5]}, r"got \[0.5, 1.5\]"),
        ({"tolerance": -1.0}, "tolerance must be finite and >= 0, got -1.0"),
        ({"error": lambda mask: float("nan")}, "finite numbers >= 0, got nan at 0"),
        ({"error": lambda mask: -1.0}, "got -1.0"),
    ],
)
def test_what_is_refused(judgement, options, message):
    with pytest.raises(ValueError, match=message):
        choose_strength(judgement, **{"error": lambda mask: 0.0, **options})


def test_doubt_is_what_the_denoiser_thinks_of_a_place(judgement):
    corner, pitch = (BOX[0] + BOX[1]) / 2 - np.array(judgement.score.shape) * judgement.pitch / 2, judgement.pitch
    rng = np.random.default_rng(0)
    cells = rng.integers(0, judgement.score.shape, (500, 3))
    places = corner + (cells + rng.uniform(0.01, 0.99, cells.shape)) * pitch
    inside = ((places >= BOX[0]) & (places <= BOX[1])).all(axis=1)
    expected = np.where(inside, (1 - judgement.score[tuple(cells.T)]) / 2, 0.5)
    found = judgement.doubt(places)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert found.dtype == np.float32
    assert len(np.unique(found)) > 1
    assert judgement.doubt(np.array([[9.0, 0, 0], [np.nan, 0, 0]])).tolist() == [0.5, 0.5]
    assert judgement.doubt(places.reshape(5, 100, 3)).shape == (5, 100)
    tensors = judgement.doubt(torch.from_numpy(places.astype(np.float32)))
    assert isinstance(tensors, torch.Tensor)
    assert float((tensors.numpy() == found).mean()) > 0.99  # float32 may round over a cell's face
