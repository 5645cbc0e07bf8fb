import numpy as np
import pytest
import torch

from unghost.baselines.bayes_rays import color_slopes, deformation_uncertainty
from unghost.fields.filtered import FilteredField
from unghost.fields.kinds import make_field
from unghost.fields.rendering import Sampling, render_rays, render_view
from unghost.fields.training import TrainingConfig, train_field

SAMPLING = Sampling(near=0.05, middle=2.4, near_samples=48, far_samples=0)


@pytest.mark.slow
def test_color_slopes_are_autograds():
    generator = torch.Generator().manual_seed(0)
    density = torch.rand(5, 7, generator=generator, dtype=torch.float64) * 4
    lengths = torch.rand(5, 7, generator=generator, dtype=torch.float64) * 0.3
    colors = torch.rand(5, 7, 3, generator=generator, dtype=torch.float64)

    def render(values):
        depth = values * lengths
        weights = torch.exp(-torch.cumsum(depth, 1) + depth) * -torch.expm1(-depth)
        return (weights[..., None] * colors).sum(1) + torch.exp(-depth.sum(1))[:, None] * 0.5, weights

    wanted = torch.autograd.functional.jacobian(lambda values: render(values)[0].sum(0), density)
    found = color_slopes(render(density)[1], density * lengths, lengths, colors, 0.5)
    torch.testing.assert_close(found, wanted.permute(1, 2, 0))


@pytest.fixture(scope="module")
def trained(photos):
    cameras, images = photos
    field = make_field("dense", 32, contract=False)
    train_field(field, cameras, images, steps=120, config=TrainingConfig(rays=1024, sampling=SAMPLING))
    return field, cameras, images


@pytest.mark.slow
def test_what_photos_look_at_is_surer_than_what_none_sees(trained):
    field, cameras, images = trained
    found = deformation_uncertainty(field, cameras, images, level=4, rays=4096, sampling=SAMPLING)
    ball = torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [-0.3, 0.0, 0.0]])  # its rim, seen by all ten
    nowhere = torch.tensor([[1.9, 1.9, 1.9], [-1.9, 0.0, 1.9]])
    assert found.log_deviation(ball).max() < found.log_deviation(nowhere).min() - 1
    np.testing.assert_allclose(found.log_deviation(nowhere).numpy(), found.highest, atol=1e-5)
    assert found.keep(1.0)(torch.cat([ball, nowhere])).all()
    assert found.keep(0.95)(torch.cat([ball, nowhere])).tolist() == [True] * 3 + [False] * 2


@pytest.mark.slow
def test_the_hessian_is_the_change_of_colour_when_a_node_is_moved(trained):
    """Oracle: move one node of the grid, render again, and square the change."""
    field, cameras, _ = trained
    level, ray = 3, slice(200, 201)
    starts, towards = (torch.from_numpy(part.reshape(-1, 3)[ray]).float() for part in cameras.rays(0))

    class Bent:
        def __init__(self, node, axis, amount):
            self.node, self.axis, self.amount = node, axis, amount

        def __getattr__(self, name):
            return getattr(field, name)

        def _bend(self, positions):
            place = (positions + 2) / 4 * 2**level  # nothing here lies outside the box
            weight = (1 - (place - self.node).abs()).clamp_min(0).prod(1)
            moved = positions.clone()
            moved[:, self.axis] += weight * self.amount
            return moved

        def query(self, positions):
            return field.query(self._bend(positions))

    from unghost.baselines.bayes_rays import _add, _sensitivity

    sampling = Sampling(near=0.05, middle=1.0, near_samples=60, far_samples=0, minimal_weight=0.0)
    with torch.no_grad():
        rendering = render_rays(field, starts, towards, sampling)
        hessian = torch.zeros((2**level + 1) ** 3, dtype=torch.float64)
        _add(hessian, *_sensitivity(field, rendering, towards, 0.5), level)
        node = int(hessian.argmax())
        place = torch.tensor(np.unravel_index(node, (2**level + 1,) * 3))
        total = 0.0
        for axis in range(3):
            ends = []
            for amount in (1.0, -1.0):
                seen = render_rays(Bent(place, axis, amount * 0.25 * field.field_pitch), starts, towards, sampling)
                ends.append(seen.rgb + (1 - seen.accumulation[:, None]) * 0.5)
            total += float((((ends[0] - ends[1]) / (0.5 * field.field_pitch)) ** 2).sum())
    assert total > 0
    np.testing.assert_allclose(float(hessian[node]), total, rtol=0.15)  # differences over corners of the grid


def test_a_filtered_field_renders_without_what_is_left_out(trained):
    field, cameras, _ = trained
    nothing = FilteredField(field, lambda positions: torch.zeros(positions.shape[:-1], dtype=torch.bool))
    assert render_view(nothing, cameras, 0, sampling=SAMPLING)["accumulation"].max() == 0
    everything = FilteredField(field, lambda positions: torch.ones(positions.shape[:-1], dtype=torch.bool))
    for name, values in render_view(everything, cameras, 0, sampling=SAMPLING).items():
        np.testing.assert_array_equal(values, render_view(field, cameras, 0, sampling=SAMPLING)[name])
    assert nothing.density_fn(torch.zeros(2, 5, 3)).shape == (2, 5, 1)


def test_thresholds_and_sizes_are_checked(trained):
    field, cameras, images = trained
    with pytest.raises(ValueError, match="threshold must lie in"):
        deformation_uncertainty(field, cameras, images, level=2, rays=64, sampling=SAMPLING).keep(0.0)
    with pytest.raises(ValueError, match="level, rays and batch"):
        deformation_uncertainty(field, cameras, images, rays=0)
