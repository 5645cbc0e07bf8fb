"""A regularizer without a field_pitch: it is estimated, and a field that is not judged at all is a warning."""

import warnings

import numpy as np
import pytest
import torch

from unghost.core.cameras import Cameras, look_at
from unghost.core.sight_lines import MARGIN_CELLS
from unghost.core.sparse_points import SparsePoints
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.pitch import PATIENCE, WINDOW, PitchSource, SkipWatch
from unghost.regularizer.settings import RegularizerSettings

CELLS = 32


def build(kit, aabb, predict=None, **options):
    denoiser = kit.numpy_denoiser(predict or kit.identity)
    return DensityRegularizer(denoiser, aabb=aabb, **{"cubes": 2, "visibility_weight": 0.0, **options})


def voxels(kit, cells=CELLS, seed=0):
    return kit.field(20 * torch.rand(cells, cells, cells, generator=torch.Generator().manual_seed(seed)) ** 4)


def ball(level, radius=0.5):
    return lambda p: level * (p.norm(dim=-1) < radius)


def test_the_first_call_estimates_it_and_it_is_what_a_given_one_would_be(kit, aabb):
    field = voxels(kit)
    regularizer = build(kit, aabb)
    assert regularizer.pitch_estimate is None
    losses = regularizer(field)
    assert regularizer.pitch_estimate.source == "cells"
    assert regularizer.pitch == pytest.approx(2 / CELLS, rel=0.02)
    given = build(kit, aabb, field_pitch=regularizer.pitch)
    assert given.pitch_estimate is None
    assert losses["dsds"].item() == pytest.approx(given(field)["dsds"].item(), rel=1e-6)


def test_of_several_fields_the_first_one_counts(kit, aabb):
    regularizer = build(kit, aabb)
    regularizer([voxels(kit), voxels(kit, cells=10)])
    assert regularizer.pitch == pytest.approx(2 / CELLS, rel=0.02)


@pytest.mark.slow
def test_how_often_and_how_much_is_queried(kit, aabb):
    field = voxels(kit)
    regularizer, given = build(kit, aabb, every=2), build(kit, aabb, every=2, field_pitch=2 / CELLS)
    estimated = []
    for _ in range(24):
        before = field.asked
        given(field)
        plain, before = field.asked - before, field.asked
        regularizer(field)
        estimated.append(field.asked - before - plain)
    steps = [step for step, extra in enumerate(estimated) if extra]
    assert steps == [0, 2, 4, 8, 16]  # acting calls 0, 1, 2, 4, 8
    assert max(estimated) <= 200_000


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.0, 0.01])
def test_a_field_that_is_even_at_first_is_estimated_later(kit, aabb, start):
    field = kit.field(torch.full((CELLS,) * 3, start))
    regularizer = build(kit, aabb)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # one and the same density everywhere
        for _ in range(3):
            regularizer(field)
            assert (regularizer.pitch_estimate.source, regularizer.pitch) == ("extent", 2 / 128)
    with torch.no_grad():
        field.values.copy_(voxels(kit).values)
    regularizer(field)
    regularizer(field)  # acting call 4
    assert regularizer.pitch == pytest.approx(2 / CELLS, rel=0.02)


@pytest.mark.slow
def test_a_field_that_is_refined_is_followed(kit, aabb):
    regularizer = build(kit, aabb)
    regularizer(voxels(kit, cells=CELLS))
    regularizer(voxels(kit, cells=2 * CELLS))
    assert regularizer.pitch == pytest.approx(1 / CELLS, rel=0.02)


@pytest.mark.slow
def test_a_failed_estimate_does_not_replace_a_good_one(kit, aabb):
    regularizer = build(kit, aabb)
    regularizer(voxels(kit))
    regularizer(ball(torch.tensor(80.0)))
    assert regularizer.pitch_estimate.source == "cells"


@pytest.mark.slow
def test_without_cells_the_fallback_is_warned_of_once_and_in_time(kit, aabb):
    regularizer, field = build(kit, aabb), ball(torch.tensor(80.0, requires_grad=True))
    for _ in range(PATIENCE):
        regularizer(field)
    with pytest.warns(
        UserWarning, match=r"field_pitch is not known .* sharp edges; 0.01562 is used, .*: pass field_p"
    ) as caught:
        regularizer(field)
    assert caught[0].filename == __file__
    assert regularizer.pitch == 2 / 128
    for _ in range(5):  # the test run turns warnings into errors
        regularizer(field)


def test_an_empty_field_is_no_reason_to_warn(kit, aabb):
    regularizer, level = build(kit, aabb), torch.tensor(0.0, requires_grad=True)
    for _ in range(PATIENCE + 6):
        regularizer(ball(level))


def test_what_does_not_depend_on_the_pitch_does_not_ask_for_it(kit, aabb):
    level = torch.tensor(1.0, requires_grad=True)
    for options in (
        {"dsds_weight": 0.0},
        {"cubes": 0},
        {"settings": RegularizerSettings.paper()},
    ):
        regularizer = build(kit, aabb, **options)
        regularizer(ball(level))
        assert regularizer.pitch_estimate is None
    density_rule = RegularizerSettings(rule=RegularizerSettings.paper().rule)  # edges in cells
    regularizer = build(kit, aabb, settings=density_rule)
    regularizer(ball(level))
    assert regularizer.pitch_estimate is not None


def test_the_visibility_loss_alone_needs_it(kit, aabb, lone_camera):
    regularizer = build(kit, aabb, cameras=lone_camera, dsds_weight=0.0, visibility_weight=1.0)
    regularizer(voxels(kit))
    assert regularizer.pitch == pytest.approx(2 / CELLS, rel=0.02)


def test_sight_lines_end_that_many_cells_before_their_points(kit, aabb):
    poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
    cameras = Cameras.create(poses, np.array([100.0, 100.0, 50.0, 50.0]), width=100, height=100)
    points = SparsePoints.create(np.zeros((1, 3)), point=[0, 0], camera=[0, 1], cameras=cameras)
    regularizer = build(kit, aabb, cameras=cameras, points=points)
    before = np.linalg.norm(regularizer.lines.ends - regularizer.lines.targets, axis=1)
    regularizer(voxels(kit))
    after = np.linalg.norm(regularizer.lines.ends - regularizer.lines.targets, axis=1)
    np.testing.assert_allclose(after - before, MARGIN_CELLS * (2 / CELLS - 2 / 128), rtol=0.03)


def test_invalid_densities_are_refused_or_dropped_as_everywhere(kit, aabb):
    field = voxels(kit)

    def torn(positions):
        return torch.where(positions[:, :1] > 0.5, torch.nan, field(positions))

    with pytest.raises(ValueError, match="DensityRegularizer: densities must be finite"):
        build(kit, aabb)(torn)
    regularizer = build(kit, aabb, drop_invalid=True)
    losses = regularizer(torn)
    assert regularizer.pitch == pytest.approx(2 / CELLS, rel=0.02)
    assert bool(torch.isfinite(losses["dsds"]))


@pytest.mark.slow
def test_a_resumed_run_goes_on_with_it(kit, aabb):
    field, first = voxels(kit), build(kit, aabb)
    for _ in range(6):
        first(field)
    second = build(kit, aabb)
    second.load_state_dict(first.state_dict())
    assert second.pitch_estimate == first.pitch_estimate
    before = field.asked
    one = first(field)["dsds"].item()
    per_call, before = field.asked - before, field.asked
    assert second(field)["dsds"].item() == one
    assert field.asked - before == per_call
    old = {name: value for name, value in first.state_dict().items() if name != "pitch"}
    third = build(kit, aabb)
    third.load_state_dict(old)  # of a release that estimated nothing
    third(field)
    assert third.pitch == pytest.approx(first.pitch, rel=0.02)


@pytest.mark.parametrize("number", [np.float32(0.125), np.array(0.125), torch.tensor(0.125)])
def test_any_number_is_a_pitch(kit, aabb, number):
    assert build(kit, aabb, field_pitch=number).pitch == 0.125


@pytest.mark.parametrize("number", [0.0, -1.0, np.nan, np.inf, "wide", np.ones(3)])
def test_what_is_no_pitch_is_refused(kit, aabb, number):
    with pytest.raises(ValueError, match="field_pitch must be finite and > 0, got"):
        build(kit, aabb, field_pitch=number)


def test_a_functions_typical_pitch_is_its_median(aabb):
    assert PitchSource(lambda places: 0.1 + 0 * places[:, 0], aabb).nominal == pytest.approx(0.1)
    source = PitchSource(lambda places: np.where(places[:, 0] < 0.5, 0.1, 7.0), aabb)
    assert source.nominal == pytest.approx(0.1)
    with pytest.raises(ValueError, match="field_pitch must be finite and > 0 at every cube centre, got nan"):
        _ = PitchSource(lambda places: np.full(len(places), np.nan), aabb).nominal


def test_nearly_all_cubes_skipped_is_a_warning_that_names_the_pitch_and_the_rule(kit, aabb):
    level = torch.tensor(20.0, requires_grad=True)
    regularizer = build(kit, aabb, field_pitch=1e-3, edge_range=(0.5, 1.0))  # an opacity of .02 over such a cell
    for _ in range(WINDOW - 1):
        regularizer(ball(level))
    with pytest.warns(
        UserWarning, match=r"100% of the cubes of 25 steps .* holds matter.* 0.001 above 0.1; check field"
    ) as caught:
        regularizer(ball(level))
    assert caught[0].filename == __file__
    for _ in range(WINDOW):
        regularizer(ball(level))


@pytest.mark.parametrize(
    "density_fn",
    [
        lambda level, p: level * (p.norm(dim=-1) < 0.5),  # judged
        lambda level, p: 0.001 * level * (p.norm(dim=-1) < 0.5),  # hardly anything there
        lambda level, p: level * 0.1 * (1 + 1e-3 * p[:, 0]),  # even fog, as a training begins
        lambda level, p: level * 0.0 * p[:, 0],
    ],
    ids=["judged", "faint", "even", "empty"],
)
def test_other_fields_are_no_reason_to_warn(kit, aabb, density_fn):
    level = torch.tensor(20.0, requires_grad=True)
    regularizer = build(kit, aabb, field_pitch=2 / 128, edge_range=(0.5, 1.0))
    for _ in range(2 * WINDOW):
        regularizer(lambda p: density_fn(level, p))


def test_skipped_cubes_are_counted_over_steps_not_over_one(aabb):
    watch = SkipWatch(RegularizerSettings().rule, aabb)
    for step in range(3 * WINDOW):
        watch.note(cubes=10, skipped=10 if step % WINDOW < 20 else 3, lowest=0.0, highest=50.0, pitch=0.1)


@pytest.mark.slow
def test_a_clean_ball_and_floor_stay_without_a_pitch(kit, aabb):
    """The shipped prior alone, without photos: less than .5 % of their cells go."""
    from unghost import DensityRegularizer as Shipped

    cells, density = 40, 20.0
    axis = (np.arange(cells) + 0.5) / cells * 2 - 1
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    solid = (np.linalg.norm(places - [0.1, 0.1, 0.2], axis=-1) < 0.45) | (np.abs(places[..., 2] + 0.7) < 0.12)
    field = kit.field(np.where(solid, density, 0.0))
    optimizer = torch.optim.Adam(field.parameters(), lr=density / 25)
    regularizer = Shipped(aabb=aabb, cubes=3)
    for _ in range(25):
        optimizer.zero_grad()
        sum(regularizer(lambda p: field(p).relu()).values(), torch.zeros(())).backward()
        optimizer.step()
    assert regularizer.pitch == pytest.approx(2 / cells, rel=0.02)
    opacity = 1 - np.exp(-field.values.detach().numpy().clip(0) * 2 / cells)
    assert (opacity[solid] > 0.1).mean() > 0.995
