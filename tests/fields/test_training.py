import numpy as np
import pytest
import torch

from unghost.core.cameras import Cameras
from unghost.fields.radiance import RadianceConfig, RadianceField
from unghost.fields.rendering import Rendering, Sampling
from unghost.fields.training import TrainingConfig, distortion_loss, gather_rays, train_field

QUICK = TrainingConfig(rays=384, sampling=Sampling(near=0.1, middle=2.6, near_samples=48, far_samples=0))


def small_field():
    return RadianceField(RadianceConfig(24, 16, contract=False))


def test_distortion_loss_equals_its_double_sum():
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(5, 12, generator=generator, dtype=torch.float64).requires_grad_()
    edges = torch.rand(5, 13, generator=generator, dtype=torch.float64).cumsum(1)
    unused = torch.zeros(5, 3)
    squashed = edges / (1 + edges)
    middle, width = (squashed[:, 1:] + squashed[:, :-1]) / 2, squashed.diff()
    pairs = weights[:, :, None] * weights[:, None, :] * (middle[:, :, None] - middle[:, None, :]).abs()
    expected = pairs.sum((1, 2)) + (weights**2 * width).sum(1) / 3
    loss = distortion_loss(Rendering(unused, weights, edges, unused, unused))
    torch.testing.assert_close(loss, expected)
    for mine, theirs in zip(
        torch.autograd.grad(loss.sum(), weights, retain_graph=True), torch.autograd.grad(expected.sum(), weights)
    ):
        torch.testing.assert_close(mine, theirs)


def test_distortion_loss_by_hand():
    # edges 0, 1, 3 squash to 0, 1/2, 3/4: middles 1/4 and 5/8, widths 1/2 and 1/4
    # 2 * 0.5 * 0.5 * 3/8 + (0.25 * 1/2 + 0.25 * 1/4) / 3
    rendering = Rendering(
        torch.zeros(1, 3), torch.tensor([[0.5, 0.5]]), torch.tensor([[0.0, 1.0, 3.0]]), torch.zeros(0), torch.zeros(0)
    )
    np.testing.assert_allclose(distortion_loss(rendering).item(), 0.1875 + 0.0625, rtol=1e-6)


def test_gather_rays_lines_up_pixels_and_colours(photos):
    cameras, images = photos
    origins, directions, colors = gather_rays(cameras, images.astype(np.float64))
    assert {origins.dtype, directions.dtype, colors.dtype} == {torch.float32}
    row = (3 * 18 + 5) * 24 + 7  # photo 3, row 5, column 7
    start, toward = cameras.rays(3, np.array([7.5, 5.5]))
    np.testing.assert_allclose(origins[row], start, atol=1e-6)
    np.testing.assert_allclose(directions[row], toward, atol=1e-6)
    np.testing.assert_allclose(colors[row], images[3, 5, 7])


def test_gather_rays_of_photos_that_differ_in_size():
    """Portrait and landscape: what stands beside a photo gives no ray."""
    pose = np.repeat(np.eye(4)[None], 2, axis=0)
    cameras = Cameras.create(pose, np.array([4.0, 4.0, 2.0, 2.0]), [6, 4], [4, 6], fisheye=[False, True])
    images = np.full((2, 6, 6, 3), np.nan)
    for index in range(2):
        images[index][cameras.window(index)] = index
    origins, directions, colors = gather_rays(cameras, images)
    assert len(origins) == len(directions) == len(colors) == 48
    assert colors[:24].eq(0).all()
    assert colors[24:].eq(1).all()
    np.testing.assert_allclose(directions[24:].reshape(6, 4, 3), cameras.rays(1)[1], atol=1e-6)


def test_wrong_images_are_refused(photos):
    cameras, images = photos
    with pytest.raises(ValueError, match=r"images must have shape \(10, 18, 24, 3\), got \(7, 18, 24, 3\)"):
        train_field(small_field(), cameras, images[:7], steps=1)
    with pytest.raises(ValueError, match=r"images must be floating point .* got dtype uint8"):
        train_field(small_field(), cameras, (images * 255).astype(np.uint8), steps=1)


@pytest.mark.parametrize(
    ("budget", "message"),
    [
        ({}, "give steps or seconds"),
        ({"steps": 0}, "steps must be >= 1, got 0"),
        ({"steps": -3}, "steps must be >= 1, got -3"),
        ({"seconds": 0.0}, "seconds must be > 0, got 0.0"),
    ],
)
def test_a_budget_that_never_ends_is_refused(photos, budget, message):
    with pytest.raises(ValueError, match=message):
        train_field(small_field(), *photos, config=QUICK, **budget)


@pytest.mark.slow
def test_a_small_field_learns_a_ball(photos):
    cameras, images = photos
    kept, field = images.copy(), small_field()
    report = train_field(field, cameras, images, steps=200, config=QUICK)
    assert report["steps"] == 200
    assert report["psnr"] > 22.5  # it reaches 24.2; the best constant colour 14.9
    assert (field.resolution, field.color_resolution) == (24, 16)
    np.testing.assert_array_equal(images, kept)
    with torch.no_grad():
        direction = torch.tensor([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0.26, 6.0, 12)]).float()
        skin = torch.stack([field.density_fn(direction * r)[:, 0] for r in (0.2, 0.25, 0.3)]).amax(0)
        air = field.density_fn(direction * 0.6)[:, 0]
    assert skin.median() > 5 * air.median()


def test_the_seed_decides(photos):
    tables = []
    for seed in (0, 0, 1):
        field = small_field()
        train_field(field, *photos, steps=8, seed=seed, config=QUICK)
        tables.append(field.density_table.detach())
    torch.testing.assert_close(tables[0], tables[1], atol=0, rtol=0)
    assert not torch.allclose(tables[0], tables[2])


def test_training_leaves_the_global_generator_alone(photos):
    state = torch.random.get_rng_state()
    train_field(small_field(), *photos, steps=2, config=QUICK)
    assert torch.equal(torch.random.get_rng_state(), state)


def test_regularizer_and_observer_are_called_each_step(photos):
    steps, seen = [], []

    def regularizer(field, step):
        steps.append(step)
        return None if step % 2 else 1e-3 * field.density_fn(torch.zeros(4, 3)).mean()

    def observer(positions, density):
        assert positions.shape == (384 * 48, 3)
        assert density.shape == (384 * 48,)
        assert not density.requires_grad
        seen.append(float(density.min()))

    train_field(small_field(), *photos, steps=5, config=QUICK, regularizer=regularizer, observer=observer)
    assert steps == [0, 1, 2, 3, 4]
    assert len(seen) == 5
    assert min(seen) >= 0.0


def test_what_the_regularizer_returns_is_minimised(photos):
    probe = torch.tensor([[0.0, 0.0, 0.0]])
    densities = []
    for weight in (0.0, 10.0):
        field = small_field()
        train_field(
            field,
            *photos,
            steps=30,
            config=QUICK,
            regularizer=lambda field, _, weight=weight: weight * field.density_fn(probe).mean(),
        )
        densities.append(field.density_fn(probe).item())
    assert densities[1] < 0.2 * densities[0]


def test_a_loss_that_is_not_finite_stops_the_run(photos):
    cameras, images = photos
    with pytest.raises(FloatingPointError, match="not finite at step 0"):
        train_field(small_field(), cameras, np.full_like(images, np.nan), steps=3, config=QUICK)


def test_stages_go_from_coarse_to_fine_and_fine_tuning_stays_fine(photos):
    for fine_tune, expected in ((False, [10, 10, 16, 24, 24]), (True, [24] * 5)):  # 24 * .4, .65, 1 at 0, .12, .3
        sides = []
        config = TrainingConfig(rays=32, sampling=QUICK.sampling, stages=((0.0, 0.4), (0.3, 0.65), (0.5, 1.0)))
        train_field(
            small_field(),
            *photos,
            steps=5,
            config=config,
            fine_tune=fine_tune,
            regularizer=lambda field, _: sides.append(field.resolution),  # noqa: B023
        )
        assert sides == expected


def test_a_tiny_field_is_not_grown_beyond_its_config(photos):
    field = RadianceField(RadianceConfig(5, 6))
    train_field(field, *photos, steps=4, config=TrainingConfig(rays=16, sampling=QUICK.sampling))
    assert (field.resolution, field.color_resolution) == (5, 6)


def test_stops_after_the_seconds_given(photos):
    report = train_field(small_field(), *photos, seconds=0.2, config=TrainingConfig(rays=16, sampling=QUICK.sampling))
    assert report["steps"] >= 1
    assert 0.2 <= report["seconds"] < 5.0
