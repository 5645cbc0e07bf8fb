import math
import warnings

import numpy as np
import pytest
import torch

from unghost.cleaning.pipeline import clean
from unghost.core.cameras import Cameras
from unghost.core.occupancy import OccupancyRule
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.settings import RegularizerSettings


def build(kit, aabb, predict, *, kind="numpy", **settings):
    maker = kit.numpy_denoiser if kind == "numpy" else kit.torch_denoiser
    options = {"cubes": 3, "field_pitch": 0.125, "dsds_weight": 1.0, "visibility_weight": 1.0} | settings
    denoiser = maker(predict, removal_threshold=options.pop("removal_threshold", 0.0))
    return DensityRegularizer(denoiser, aabb=aabb, **options), denoiser


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_a_constant_field_by_hand(kit, aabb, kind):
    def density_fn(p):
        return 0 * p[:, :1] + level

    level = torch.tensor(2.0, requires_grad=True)  # optical depth 0.25: opacity .22
    regularizer, denoiser = build(kit, aabb, kit.all_empty, kind=kind)
    losses = regularizer(density_fn)
    assert set(losses) == {"dsds", "visibility", "sight_lines"}
    assert losses["dsds"].item() == pytest.approx(0.25, rel=1e-6)  # m * density * pitch
    assert losses["visibility"].item() == 0.0
    losses["dsds"].backward()
    assert level.grad.item() == pytest.approx(0.125, rel=1e-6)
    channels, timestep, fraction = denoiser.calls[0]
    np.testing.assert_allclose(channels.max(), 2 * -math.expm1(-0.25) - 1, rtol=1e-5)
    assert (timestep == denoiser.manifest.default_timestep).all()
    assert fraction.dtype == np.float32
    assert ((fraction >= 32 * 0.125 * 0.5 / 2 - 1e-6) & (fraction <= 32 * 0.125 * 1.25 / 2 + 1e-6)).all()


def test_calls_between_cost_nothing(kit, aabb):
    asked = []

    def density_fn(p):
        asked.append(len(p))
        return torch.full((len(p),), 2.0)

    regularizer, denoiser = build(kit, aabb, kit.all_empty, every=3)
    worth = [regularizer(density_fn)["dsds"].item() for _ in range(7)]
    assert [value > 0 for value in worth] == [True, False, False, True, False, False, True]
    assert len(denoiser.calls) == 3
    before = len(asked)
    regularizer(density_fn)
    assert len(asked) == before
    assert regularizer.step == 8


def test_filling_by_hand(kit, aabb):
    level = torch.tensor(1.0, requires_grad=True)
    regularizer, _ = build(kit, aabb, kit.all_full, target=0.2, skip_empty=False)
    loss = regularizer(lambda p: level.expand(len(p)))["dsds"]
    assert loss.item() == pytest.approx(-math.log(0.8) - 0.125, rel=1e-6)  # w - density * pitch
    loss.backward()
    assert level.grad.item() == pytest.approx(-0.125, rel=1e-6)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, -math.log(0.9)),
        ({"rule": OccupancyRule("opacity", 0.95)}, -math.log(0.05)),
        ({"target": 0.5}, math.log(2)),
        ({"rule": OccupancyRule.paper()}, 0.01),
        ({"rule": OccupancyRule.paper(), "target": 20.0}, 20.0),
    ],
)
def test_how_far_is_filled(settings, expected):
    found = RegularizerSettings(**settings)
    assert found.target_density() == pytest.approx(expected)
    assert found.target_density() >= found.rule.density_threshold(1.0)


@pytest.mark.parametrize(
    "settings", [{"target": 0.05}, {"target": 1.0}, {"rule": OccupancyRule.paper(), "target": 0.001}]
)
def test_a_target_below_what_is_occupied_is_refused(settings):
    with pytest.raises(ValueError, match=r"target must be in .*the rule's threshold"):
        RegularizerSettings(**settings)


def test_the_papers_rule_is_raw_density_and_bits(kit, aabb):
    level = torch.tensor(0.004, requires_grad=True)
    regularizer, denoiser = build(kit, aabb, kit.all_full, rule=OccupancyRule.paper(), skip_empty=False)
    assert regularizer(lambda p: level.expand(len(p)))["dsds"].item() == pytest.approx(0.006, rel=1e-5)
    assert set(np.unique(denoiser.calls[0][0])) == {-1.0}
    regularizer, denoiser = build(kit, aabb, kit.all_empty, rule=OccupancyRule.paper())
    level = torch.tensor(3.0, requires_grad=True)
    assert regularizer(lambda p: level.expand(len(p)))["dsds"].item() == pytest.approx(3.0, rel=1e-6)
    assert 1.0 in denoiser.calls[0][0]


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_loss_does_not_depend_on_the_scenes_unit(kit, aabb, lone_camera, unit):
    from unghost.core.cameras import Cameras

    poses = lone_camera.camera_to_world.copy()
    poses[:, :, 3] *= unit
    cameras = Cameras.create(poses, lone_camera.intrinsics, 100, 100)
    regularizer, _ = build(kit, aabb * unit, kit.identity, field_pitch=0.125 * unit, cameras=cameras)
    reference, _ = build(kit, aabb, kit.identity, cameras=lone_camera)

    def ball(p):
        return torch.sigmoid(20 * (0.5 - p.norm(dim=-1, keepdim=True))) * 10

    ours = regularizer(lambda p: ball(p / unit) / unit)
    theirs = reference(ball)
    for name in theirs:
        assert ours[name].item() == pytest.approx(theirs[name].item(), rel=1e-3)


def test_enabled_losses_have_gradients_and_disabled_ones_are_exactly_zero(kit, aabb, lone_camera):
    values = torch.full((8, 8, 8), 3.0)
    for weights, alive in (((1.0, 0.0), {"dsds"}), ((0.0, 1.0), {"visibility"}), ((0.0, 0.0), set())):
        field = kit.field(values)
        regularizer, denoiser = build(
            kit, aabb, kit.all_empty, cameras=lone_camera, dsds_weight=weights[0], visibility_weight=weights[1]
        )
        losses = regularizer(field)
        for name, loss in losses.items():
            field.values.grad = None
            if name in alive:
                loss.backward()
                assert field.values.grad.abs().sum() > 0
            else:
                assert loss.item() == 0.0
                assert not loss.requires_grad
        assert bool(denoiser.calls) == ("dsds" in alive)
        assert (field.asked > 0) == bool(alive)


def test_only_what_no_camera_sees_is_penalised(kit, aabb, lone_camera):
    seen_density = torch.tensor(5.0, requires_grad=True)
    unseen_density = torch.tensor(5.0, requires_grad=True)

    def density_fn(p):  # the camera sees z < -max(|x|, |y|)
        seen = -p[:, 2] >= p[:, :2].abs().amax(dim=1)
        return torch.where(seen, seen_density, unseen_density)

    regularizer, _ = build(kit, aabb, kit.identity, cameras=lone_camera, dsds_weight=0.0, visibility_kind="uniform")
    loss = regularizer(density_fn)["visibility"]
    loss.backward()
    assert seen_density.grad.item() == 0.0
    share = regularizer.report["unseen"] / regularizer.report["points"]
    assert share == pytest.approx(5 / 6, abs=0.02)  # one of the cube's six pyramids is seen
    assert loss.item() == pytest.approx(5.0 * 0.125 * share, rel=1e-5)


def test_empty_cubes_are_not_sent_but_still_thinned(kit, aabb):
    level = torch.tensor(0.4, requires_grad=True)  # optical depth .05, opacity .049 < .1
    regularizer, denoiser = build(kit, aabb, kit.all_full)
    loss = regularizer(lambda p: level.expand(len(p)))["dsds"]
    assert denoiser.calls == []
    assert regularizer.report["skipped_empty"] == 3
    assert loss.item() == pytest.approx(0.05, rel=1e-6)
    loss.backward()
    assert level.grad.item() > 0
    asking, denoiser = build(kit, aabb, kit.all_full, skip_empty=False)
    asking(lambda p: level.expand(len(p)))
    assert len(denoiser.calls) == 1


def test_skipping_changes_nothing_for_a_denoiser_that_keeps_empty_empty(kit, aabb):
    values = torch.zeros(16, 16, 16)
    values[:4, :4, :4] = 20.0
    results = []
    for skip in (True, False):
        regularizer, _ = build(kit, aabb, kit.identity, skip_empty=skip, cubes=12, edge_range=(0.1, 0.3))
        results.append(regularizer(kit.field(values))["dsds"].item())
        if skip:
            assert 0 < regularizer.report["skipped_empty"] < 12
    assert results[0] == pytest.approx(results[1], rel=1e-9)


def test_outside_the_box_is_shown_empty_never_asked_and_not_in_the_mean(kit, aabb):
    def density_fn(p):
        assert (p.abs() <= 1).all()
        return 0 * p[:, 0] + level

    level = torch.tensor(2.0, requires_grad=True)
    regularizer, denoiser = build(kit, aabb, kit.all_empty, edge_range=(2.0, 2.0), cubes=2)
    loss = regularizer(density_fn)["dsds"]
    shown = denoiser.calls[0][0]
    assert (shown == -1).mean() == pytest.approx(7 / 8, abs=1e-6)
    assert regularizer.report["outside"] == 2 * 32**3 * 7 // 8
    assert loss.item() == pytest.approx(0.25, rel=1e-6)


def test_every_cube_that_fits_lies_in_the_box(kit, aabb):
    regularizer, _ = build(kit, aabb, kit.identity, cubes=30, edge_range=(0.3, 0.9))
    regularizer(kit.field(torch.ones(4, 4, 4)))
    assert regularizer.report["outside"] == 0


@pytest.mark.parametrize("value", [1e-45, 1e-30, 1e30, 3e38])
@pytest.mark.parametrize("name", ["empty", "full", "identity"])
def test_any_finite_density_gives_a_finite_loss_and_gradient(kit, aabb, lone_camera, value, name):
    field = kit.field(torch.full((4, 4, 4), value))

    def safe(p):  # interpolation weights sum to a little more than 1
        return field(p).clamp(max=3.4e38)

    regularizer, _ = build(kit, aabb, kit.functions[name], cameras=lone_camera, skip_empty=False, chunk=10_000)
    total = sum(regularizer(safe).values())
    assert torch.isfinite(total)
    total.backward()
    assert torch.isfinite(field.values.grad).all()
    assert field.largest <= 10_000


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_precisions(kit, aabb, dtype):
    level = torch.tensor(2.0, requires_grad=True)
    regularizer, _ = build(kit, aabb, kit.all_empty)
    loss = regularizer(lambda p: (0 * p[:, :1] + level).to(dtype))["dsds"]
    assert loss.item() == pytest.approx(0.25, rel=1e-6)
    loss.backward()
    assert level.grad.item() > 0


@pytest.mark.parametrize(("bad", "word"), [(math.nan, "NaN"), (math.inf, "infinite"), (-1.0, "negative")])
def test_invalid_densities_raise_or_are_dropped_and_counted(kit, aabb, lone_camera, bad, word):
    level = torch.tensor(2.0, requires_grad=True)

    def density_fn(p):
        return torch.where(p[:, 0] > 0.5, torch.full_like(p[:, 0], bad), level)

    regularizer, _ = build(kit, aabb, kit.all_empty)
    with pytest.raises(ValueError, match=rf"DensityRegularizer: densities must be finite .* {word} of .*; first"):
        regularizer(density_fn)
    dropping, denoiser = build(kit, aabb, kit.all_empty, drop_invalid=True, cameras=lone_camera)
    losses = dropping(density_fn)
    assert losses["dsds"].item() == pytest.approx(0.25, rel=1e-6)
    assert dropping.report["dropped"] > 0
    assert np.isfinite(denoiser.calls[0][0]).all()
    sum(losses.values()).backward()
    assert math.isfinite(level.grad)


def test_what_a_callable_may_not_return(kit, aabb):
    regularizer, _ = build(kit, aabb, kit.identity)
    with pytest.raises(ValueError, match=r"density_fn must return shape \(\d+, 1\) or"):
        regularizer(lambda p: p)
    with pytest.raises(ValueError, match="density_fn must return shape"):
        regularizer(lambda p: p.sum())
    with pytest.raises(TypeError, match="must return a torch tensor, got ndarray"):
        regularizer(lambda p: np.zeros(len(p)))
    with pytest.raises(ValueError, match=r"DensityRegularizer: .* on the device of its positions, cpu, got meta"):
        regularizer(lambda p: torch.empty(len(p), device="meta"))
    for dtype in (torch.int64, torch.bool, torch.complex64):
        with pytest.raises(TypeError, match=rf"DensityRegularizer: .* floating-point densities, got {dtype}$"):
            regularizer(lambda p, dtype=dtype: torch.ones(len(p), dtype=dtype))
    with pytest.raises(TypeError, match="must be callable, got float"):
        regularizer(3.0)
    with pytest.raises(ValueError, match="non-empty list"):
        regularizer([])


def test_construction_errors(kit, aabb):
    with pytest.raises(ValueError, match="min < max on every axis, x fails"):
        build(kit, aabb[::-1], kit.identity)
    with pytest.raises(TypeError, match="unknown settings"):
        build(kit, aabb, kit.identity, cubez=3)
    with pytest.raises(ValueError, match="cubes must be >= 0, got -1"):
        build(kit, aabb, kit.identity, cubes=-1)
    with pytest.raises(ValueError, match="field_pitch must be finite and > 0"):
        build(kit, aabb, kit.identity, field_pitch=0.0)
    with pytest.raises(ValueError, match=r"timestep must lie in \[0, 1000\)"):
        build(kit, aabb, kit.identity, timestep=1000)
    with pytest.raises(ValueError, match="fill_threshold must be >= threshold"):
        build(kit, aabb, kit.identity, threshold=0.5, fill_threshold=0.0)
    with pytest.raises(TypeError, match="must be callable and have a manifest"):
        DensityRegularizer(lambda c, t, e: c, aabb=aabb)


@pytest.mark.parametrize(
    ("predict", "message"),
    [(lambda c: c[:, :, :-1], "must return shape"), (lambda c: c * np.nan, "values that are not finite")],
)
def test_a_broken_denoiser_is_named(kit, aabb, predict, message):
    regularizer, _ = build(kit, aabb, predict)
    with pytest.raises(ValueError, match=f"denoiser 'analytic' .*{message}"):
        regularizer(kit.field(torch.ones(4, 4, 4) * 5))


def test_thresholds_come_from_the_manifest_and_can_be_set(kit, aabb):
    level = torch.tensor(2.0, requires_grad=True)

    def run(**settings):
        regularizer, _ = build(kit, aabb, lambda c: np.full_like(c, -0.2), **settings)
        return regularizer(lambda p: level.expand(len(p)))["dsds"].item()

    assert run() == 0.0  # between removal and filling
    assert run(threshold=0.0) == pytest.approx(0.25)  # -0.2 < 0: empty
    assert run(removal_threshold=0.0) == 0.0  # whatever clean() is advised
    assert run(removal_threshold=0.0, threshold=None) == pytest.approx(0.25)
    assert run(removal_threshold=-0.5, threshold=None) == 0.0


@pytest.mark.parametrize(
    ("score", "expected"),
    [(-0.91, 0.1), (-0.89, 0.0), (0.89, 0.0), (0.91, -math.log(0.9) - 0.1)],
)
def test_only_what_is_sure_moves(kit, aabb, score, expected):
    regularizer, _ = build(kit, aabb, lambda c: np.full_like(c, score), skip_empty=False)
    assert regularizer(lambda p: torch.full((len(p),), 0.8))["dsds"].item() == pytest.approx(expected, rel=1e-6)


def test_the_papers_settings(kit, aabb):
    settings = RegularizerSettings.paper(cubes=3)
    assert (settings.threshold, settings.fill_threshold, settings.cubes, settings.soft) == (0.0, 0.0, 3, False)
    for score, expected in ((-0.01, 0.004), (0.01, 0.006)):  # eq. 2 of raw densities, w = tau = .01
        regularizer, _ = build(kit, aabb, lambda c, s=score: np.full_like(c, s), settings=settings, skip_empty=False)
        assert regularizer(lambda p: torch.full((len(p),), 0.004))["dsds"].item() == pytest.approx(expected, rel=1e-5)


def test_timestep_schedule(kit, aabb):
    regularizer, denoiser = build(kit, aabb, kit.identity, timestep=lambda step: 900 - 100 * step)
    field = kit.field(torch.full((4, 4, 4), 9.0))
    for _ in range(2):
        regularizer(field)
    assert [int(call[1][0]) for call in denoiser.calls] == [900, 800]


@pytest.mark.parametrize("timestep", [0, 999])
def test_extreme_timesteps(kit, aabb, timestep):
    regularizer, denoiser = build(kit, aabb, kit.identity, timestep=timestep)
    assert torch.isfinite(regularizer(kit.field(torch.full((4, 4, 4), 9.0)))["dsds"])
    assert (denoiser.calls[0][1] == timestep).all()


def test_lists_of_fields_are_each_regularised_on_the_same_cubes(kit, aabb, lone_camera):
    places = {}

    def make(name, level):
        def density_fn(p):
            places.setdefault(name, []).append(p)
            return level.expand(len(p))

        return density_fn

    levels = [torch.tensor(2.0, requires_grad=True), torch.tensor(4.0, requires_grad=True)]
    regularizer, _ = build(kit, aabb, kit.all_empty, cameras=lone_camera)
    regularizer.observe(np.zeros((1, 3)), np.ones(1))  # so that nothing but the cubes is asked
    losses = regularizer([make(i, level) for i, level in enumerate(levels)])
    assert losses["dsds"].item() == pytest.approx(0.25 + 0.5, rel=1e-6)
    assert torch.equal(torch.cat(places[0]), torch.cat(places[1]))
    sum(losses.values()).backward()
    assert all(level.grad.item() > 0 for level in levels)


def test_steps_are_repeatable_and_differ(kit, aabb, lone_camera):
    def run(seed):
        regularizer, _ = build(kit, aabb, kit.identity, cameras=lone_camera, seed=seed)
        field = kit.field(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(0)) * 9)
        return [tuple(loss.item() for loss in regularizer(field).values()) for _ in range(3)]

    first = run(5)
    assert first == run(5)
    assert first != run(6)
    assert len(set(first)) == 3


def test_resuming_gives_the_same_steps(kit, aabb):
    field = kit.field(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(0)) * 9)
    straight, _ = build(kit, aabb, kit.identity)
    first, _ = build(kit, aabb, kit.identity)
    expected = [straight(field)["dsds"].item() for _ in range(3)]
    first(field)
    second, _ = build(kit, aabb, kit.identity)
    second.load_state_dict(first.state_dict())
    assert [second(field)["dsds"].item() for _ in range(2)] == expected[1:]


def test_the_grid_finds_the_matter_by_itself(kit, aabb):
    values = torch.zeros(20, 20, 20)
    values[2:5, 2:5, 2:5] = 30.0
    regularizer, _ = build(kit, aabb, kit.identity, strategy="importance", cubes=20, edge_range=(0.05, 0.05))
    regularizer(kit.field(values))
    assert regularizer.report["denoised"] >= 15


def test_observe_takes_tensors_densities_and_weights(kit, aabb):
    regularizer, _ = build(kit, aabb, kit.identity)
    positions = torch.zeros(2, 3, dtype=torch.bfloat16)
    regularizer.observe(positions, torch.full((2, 1), 8.0, requires_grad=True))
    assert regularizer.grid.values.max() == pytest.approx(-math.expm1(-8.0 * 0.125))
    regularizer.observe(np.full((1, 3), 5.0), np.ones(1), kind="weight")
    assert regularizer.totals["observations_outside"] == 1
    with pytest.raises(ValueError, match=r"1 of 1 that are not; first -1"):
        regularizer.observe(np.zeros((1, 3)), [-1.0])
    with pytest.raises(ValueError, match="kind must be"):
        regularizer.observe(np.zeros((1, 3)), [1.0], kind="sigma")


def test_a_pitch_that_varies_in_space(kit, aabb):
    def pitch(centers):
        return 0.05 + 0.1 * np.linalg.norm(centers, axis=1)

    level = torch.tensor(2.0, requires_grad=True)
    regularizer, _ = build(kit, aabb, kit.all_empty, field_pitch=pitch)
    loss = regularizer(lambda p: level.expand(len(p)))["dsds"].item()
    assert 2 * 0.05 <= loss <= 2 * (0.05 + 0.1 * math.sqrt(3))
    with pytest.raises(ValueError, match="field_pitch must be finite and > 0 at every cube centre"):
        build(kit, aabb, kit.identity, field_pitch=lambda c: np.zeros(len(c)))[0](lambda p: level.expand(len(p)))


def test_no_cubes_and_no_points_are_no_loss(kit, aabb, lone_camera):
    regularizer, _ = build(kit, aabb, kit.identity, cubes=0, visibility_samples=0, cameras=lone_camera)
    assert [loss.item() for loss in regularizer(lambda p: p[:, 0]).values()] == [0.0, 0.0, 0.0]


def test_a_camera_inside_a_cube_and_all_full_and_all_empty(kit, aabb, lone_camera):
    for level in (0.0, 50.0):
        regularizer, _ = build(kit, aabb, kit.identity, cameras=lone_camera, edge_range=(1.0, 1.0))
        field = kit.field(torch.full((4, 4, 4), level))
        total = sum(regularizer(field).values())
        total.backward()
        assert torch.isfinite(field.values.grad).all()
        assert total.item() >= 0


def test_settings_fit_in_a_run_file():
    import dataclasses

    assert RegularizerSettings() == RegularizerSettings(
        **dataclasses.asdict(RegularizerSettings()) | {"rule": OccupancyRule()}
    )


def test_nothing_is_written_to_the_field(kit, aabb, lone_camera):
    field = kit.field(torch.rand(4, 4, 4, generator=torch.Generator().manual_seed(0)))
    before = field.values.detach().clone()
    regularizer, _ = build(kit, aabb, kit.identity, cameras=lone_camera)
    regularizer(field)
    assert torch.equal(before, field.values.detach())
    assert field.values.grad is None


def test_densities_without_a_gradient_are_pointed_out(kit, aabb):
    field = kit.field(torch.rand(4, 4, 4) * 5)
    regularizer, _ = build(kit, aabb, kit.identity)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        regularizer(field)
        with torch.no_grad():  # nobody wants a gradient
            regularizer(field)
    with pytest.warns(UserWarning, match="densities without a gradient.*detached, frozen, or under no_grad"):
        regularizer(lambda positions: field(positions).detach())


def test_a_callable_that_does_not_look_at_its_positions_is_pointed_out(kit, aabb):
    level = torch.tensor(3.0, requires_grad=True)
    regularizer, _ = build(kit, aabb, kit.identity)
    with pytest.warns(UserWarning, match="DensityRegularizer: density_fn returned 3 at each of 32000 places"):
        regularizer(lambda positions: level.expand(len(positions)))
    nothing = torch.tensor(0.0, requires_grad=True)  # an empty field is one
    regularizer, _ = build(kit, aabb, kit.identity)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        regularizer(lambda positions: nothing.expand(len(positions)))


def inside_out():
    """Cameras about the box that look away from it: OpenCV's poses taken for OpenGL's."""
    angle = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    back = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)  # the camera's z, towards the middle
    up = np.tile([0.0, 0.0, 1.0], (6, 1))
    poses = np.stack([np.cross(up, back), up, back, -4.0 * back], axis=-1)
    return Cameras.create(poses, np.array([50.0, 50.0, 32.0, 32.0]), 64, 64)


@pytest.mark.filterwarnings("ignore:clean. cameras are not used")  # by this denoiser
def test_cameras_inside_out_are_pointed_out_by_both(kit, aabb):
    with pytest.warns(UserWarning, match=r"DensityRegularizer: .*OpenCV"):
        build(kit, aabb, kit.identity, cameras=inside_out())
    with pytest.warns(UserWarning, match=r"clean: .*OpenCV"):
        clean(
            lambda p: p[:, 0] ** 2, aabb, denoiser=kit.numpy_denoiser(kit.identity), resolution=8, cameras=inside_out()
        )


def test_what_something_hides_counts_as_unseen(kit, aabb):
    pose = np.eye(4)[None, :3].copy()
    pose[0, 2, 3] = 3.0  # looks down -z onto the box
    camera = Cameras.create(pose, np.array([20.0, 20.0, 32.0, 32.0]), 64, 64)
    wall = np.full((1, 64, 64), 3.0, np.float32)  # the plane z = 0
    shares = []
    for depth_maps in (None, wall):
        regularizer, _ = build(
            kit, aabb, kit.identity, cameras=camera, depth_maps=depth_maps, dsds_weight=0.0, visibility_kind="uniform"
        )
        level = regularizer(lambda p: torch.ones(len(p)))["visibility"].item()
        share = regularizer.report["unseen"] / regularizer.report["points"]
        assert level == pytest.approx(0.125 * share)
        shares.append(share)
    with pytest.raises(ValueError, match="depth_maps must come with cameras"):
        build(kit, aabb, kit.identity, depth_maps=wall)
    assert shares[0] < 0.01
    assert shares[1] == pytest.approx(0.5 - 0.05 * 3 / 2 / (aabb[1][2] - aabb[0][2]) * 2, abs=0.06)


def test_weights_feed_the_grid(kit, aabb):
    regularizer, _ = build(kit, aabb, kit.identity)
    place = np.array([[0.31, -0.2, 0.4]])
    regularizer.observe(place, [[0.75]], kind="weight")
    cell = tuple(np.unravel_index(regularizer.grid.observed.argmax(), regularizer.grid.values.shape))
    assert regularizer.grid.observed.sum() == 1
    assert regularizer.grid.values[cell] == 0.75
    regularizer.observe(torch.tensor([[-1, -1, -1]]), torch.tensor([1]), kind="weight")  # whole numbers are numbers
    assert regularizer.grid.values[0, 0, 0] == 1.0
