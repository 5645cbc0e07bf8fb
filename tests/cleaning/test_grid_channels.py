"""What a denoiser of more channels is told, by the cleaner and by the regularizer."""

import numpy as np
import pytest
import torch

from unghost.cleaning.grid_channels import GridContext, evidence_lines, light_maps, viewing_cameras
from unghost.cleaning.pipeline import clean
from unghost.core.cameras import Cameras
from unghost.core.channels import (
    CHANNEL_NAMES,
    UNKNOWN,
    coarse_channel,
    encode_share,
    encode_surroundings,
    encode_view_count,
    evidence_share,
)
from unghost.core.frames import cube_lattices, random_rotations, unit_lattice
from unghost.core.sparse_points import SparsePoints
from unghost.core.visibility.transmittance import FAN, STEPS
from unghost.core.visibility.view_counts import count_views
from unghost.data_recipes.harvest.context import surroundings
from unghost.regularizer.cubes import draw_cubes
from unghost.regularizer.density_regularizer import DensityRegularizer

PITCH = 0.05
NO_LINE_LOSS = {"sight_line_weight": 0.0, "end_point_weight": 0.0}
SWAPPED = ("signed_opacity", "view_count", "surroundings", "transmittance")


def keep_first(channels):
    return channels[:, :1]


def waves(positions):
    """Fog of gentle waves, optical depths of about half a cell, for arrays; per scene unit."""
    x, y, z = np.moveaxis(np.asarray(positions, dtype=np.float64), -1, 0)
    return ((1.2 + np.sin(4 * x + y) + 0.2 * np.cos(7 * z - x)) / (2 * PITCH)).astype(np.float32)


def waves_of_tensors(positions):
    return torch.from_numpy(waves(positions.detach().cpu().numpy()))


@pytest.fixture
def crowd():
    rng = np.random.default_rng(4)
    poses = np.concatenate([random_rotations(rng, 9), rng.uniform(-1, 1, size=(9, 3, 1))], axis=2)
    return Cameras.create(poses, np.array([30.0, 30.0, 20.0, 15.0]), 40, 30)


def windows(corners, origin, pitch):
    """Centres and edges of windows of 32 cells."""
    return origin + (np.array(corners) + 16) * pitch, np.full(len(corners), 32 * pitch)


CORNERS = [(0, 0, 0), (5, -20, 31), (8, 8, 8), (-16, 24, 1)]


def test_a_grid_holds_the_surroundings_of_its_windows(aabb):
    """Exactly what asking the field again would give, outside the box too."""
    cells = 40
    origin, pitch = aabb[0], 2.0 / cells
    places = origin + (np.indices((cells,) * 3).transpose(1, 2, 3, 0) + 0.5) * pitch
    signed = 1 - 2 * np.exp(-waves(places) * PITCH)
    context = GridContext(CHANNEL_NAMES, signed.astype(np.float32), origin=origin, pitch=pitch)
    found = context.known(CORNERS)
    assert set(found) == {"surroundings"}
    centers, edges = windows(CORNERS, origin, pitch)
    upright, assumed = np.broadcast_to(np.eye(3), (4, 3, 3)), np.full(4, PITCH)
    expected = surroundings(lambda p: waves(p), centers, edges, upright, assumed, aabb)
    assert expected.std() > 0.1
    assert (expected == -1).any()
    np.testing.assert_allclose(found["surroundings"], encode_surroundings(expected), atol=1e-5)


def test_views_of_windows_are_those_of_cubes(crowd):
    signed, origin, pitch = np.full((40, 40, 40), -1, np.float32), np.array([-1.0, -0.9, -1.1]), 0.05
    context = GridContext(("signed_opacity", "view_count"), signed, origin=origin, pitch=pitch, cameras=crowd)
    found = context.known(CORNERS)["view_count"]
    centers, edges = windows(CORNERS, origin, pitch)
    expected = encode_view_count(count_views(crowd, centers, edges, np.broadcast_to(np.eye(3), (4, 3, 3))))
    assert len(np.unique(expected)) > 3
    assert (found != expected).mean() < 1e-4  # within rounding of a side
    assert len(context._tiles) < 8 * len(CORNERS)


def test_light_of_windows_is_that_of_cubes(crowd, aabb):
    """From tiles where blocks line up, and where they do not."""
    names, signed, origin = CHANNEL_NAMES, np.full((40, 40, 40), -1, np.float32), np.array([-1.0, -0.9, -1.1])
    maps = light_maps(names, crowd, waves, aabb=aabb, pitch=PITCH)
    context = GridContext(names, signed, origin=origin, pitch=0.05, maps=maps)
    found = context.known(CORNERS)["transmittance"]
    centers, edges = windows(CORNERS, origin, 0.05)
    lattice = cube_lattices(centers, edges, None, resolution=16)
    np.testing.assert_allclose(found, encode_share(maps.best_view(lattice)), atol=1e-6)
    assert found.std() > 0.05
    assert len(context._light_tiles) <= 3 * 8


def test_light_is_followed_inside_the_box_and_bad_values_let_it_by(crowd, aabb):
    asked = []

    def broken(positions):
        asked.append(positions)
        return np.where(positions[:, 0] > 0, np.nan, -1.0)

    maps = light_maps(CHANNEL_NAMES, crowd, broken, aabb=aabb, pitch=PITCH)
    assert (maps.through == 1).all()
    assert all(((a >= aabb[0]) & (a <= aabb[1])).all() for a in asked)
    assert light_maps(CHANNEL_NAMES[:3], crowd, broken, aabb=aabb, pitch=PITCH) is None
    assert light_maps(CHANNEL_NAMES, None, broken, aabb=aabb, pitch=PITCH) is None


def test_rays_are_followed_anew_after_some_steps(kit, aabb, crowd):
    regularizer, denoiser = build(kit, aabb, CHANNEL_NAMES, crowd, light_steps=3)
    thinnest = []
    for step in range(5):
        regularizer(lambda positions, step=step: torch.full((len(positions),), 3.0 + 2.0 * step))
        ((followed, maps),) = regularizer._rays._maps.values()
        thinnest.append((followed, float(-np.log(maps.through.astype(float).min()))))
    assert len(denoiser.calls) == 5
    assert [followed for followed, _ in thinnest] == [0, 0, 0, 3, 3]
    assert thinnest[3][1] == pytest.approx(3.0 * thinnest[0][1], rel=1e-3)  # of step 3: three times as dense


def test_nobody_counts_for_a_denoiser_that_does_not_ask(crowd):
    assert viewing_cameras(crowd, ("signed_opacity", "surroundings")) is None
    assert viewing_cameras(None, CHANNEL_NAMES) is None
    assert viewing_cameras(crowd.select([]), CHANNEL_NAMES) is None
    assert viewing_cameras(crowd, CHANNEL_NAMES) is crowd
    bent = Cameras(crowd.camera_to_world, crowd.intrinsics, 40, 30, np.full((9, 6), 1e-3))
    assert not viewing_cameras(bent, CHANNEL_NAMES).distortion.any()


def observed(cameras, tracks=True):
    """Points in front of the cameras, each seen by those that have it in their frustum."""
    places = np.random.default_rng(8).uniform(-1, 1, size=(300, 3))
    seen = np.stack([cameras.sees(np.full(len(places), index), places) for index in range(len(cameras))])
    camera, point = np.nonzero(seen) if tracks else ((), ())
    return SparsePoints.create(places, point=point, camera=camera, cameras=cameras)


def seen_without_points(kit, kind):
    return getattr(kit, kind)(keep_first, channels=("signed_opacity", "view_count"))


def test_evidence_of_windows_is_that_of_cubes(crowd, aabb):
    names, signed, origin = CHANNEL_NAMES, np.full((40, 40, 40), -1, np.float32), np.array([-1.0, -0.9, -1.1])
    lines = evidence_lines(names, observed(crowd), crowd, aabb=aabb, pitch=PITCH)
    context = GridContext(names, signed, origin=origin, pitch=0.05, lines=lines)
    channels = context.known(CORNERS)
    lattice = cube_lattices(*windows(CORNERS, origin, 0.05), None)
    for name in ("support", "crossings"):
        expected = encode_share(evidence_share(getattr(lines, name)(lattice)))
        np.testing.assert_allclose(channels[name], expected, atol=1e-5)
        assert expected.std() > 0.05
    assert len(context._evidence_tiles) <= 3 * 8


def test_points_without_tracks_support_but_cross_nothing(crowd, aabb):
    names, signed = CHANNEL_NAMES, np.full((40, 40, 40), -1, np.float32)
    lines = evidence_lines(names, observed(crowd, tracks=False), crowd, aabb=aabb, pitch=PITCH)
    context = GridContext(names, signed, origin=aabb[0], pitch=0.05, lines=lines)
    assert set(context.known(CORNERS)) == {"surroundings", "support"}
    assert evidence_lines(names[:4], observed(crowd), crowd, aabb=aabb, pitch=PITCH) is None
    assert evidence_lines(names, None, crowd, aabb=aabb, pitch=PITCH) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [({"cameras": None}, "points must come with cameras"), ({"cameras": 2}, "points must refer to the 2 cameras")],
)
def test_points_that_do_not_fit_are_refused(kit, aabb, crowd, change, message):
    denoiser = kit.numpy_denoiser(keep_first, channels=("signed_opacity", "support"))
    cameras = None if change["cameras"] is None else crowd.select(range(change["cameras"]))
    with pytest.raises(ValueError, match=f"clean: {message}"):
        clean(waves, aabb, denoiser=denoiser, cameras=cameras, points=observed(crowd), resolution=16)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["numpy_denoiser", "torch_denoiser"])
def test_cleaning_tells_all_it_knows(kit, aabb, crowd, kind):
    seen, told, alone = (
        getattr(kit, kind)(keep_first, channels=names)
        for names in (
            CHANNEL_NAMES,
            ("signed_opacity", "view_count", "surroundings", "transmittance", "crossings", "support"),
            CHANNEL_NAMES[:1],
        )
    )
    options = {"field_pitch": PITCH, "level_weights": (1.0,)}
    clean(waves, aabb, denoiser=seen, **options)
    clean(waves, aabb, denoiser=told, cameras=crowd, points=observed(crowd), **options)
    with pytest.warns(UserWarning, match="points are not used by the denoiser .*--denoiser evidence"):
        clean(waves, aabb, denoiser=seen_without_points(kit, kind), cameras=crowd, points=observed(crowd), **options)
    with pytest.warns(UserWarning, match="cameras are not used by the denoiser .*--denoiser views"):
        clean(waves, aabb, denoiser=alone, cameras=crowd, **options)
    blind, all_, one = (np.concatenate([call[0] for call in d.calls]) for d in (seen, told, alone))
    assert blind.shape == all_.shape == (len(one), len(CHANNEL_NAMES), 32, 32, 32)
    np.testing.assert_array_equal(blind[:, :1], one)
    np.testing.assert_array_equal(all_[:, :1], one)
    assert (blind[:, 2:] == UNKNOWN).all()
    np.testing.assert_array_equal(blind[:, 1], all_[:, 2])
    assert (all_[:, 1:] > UNKNOWN).all()
    # the middle of the surroundings is the window itself, coarser: where it is empty, so is the middle
    middle = coarse_channel(all_[:, 2])[:, 6:10, 6:10, 6:10]
    blocks = one[:, 0, 4:28, 4:28, 4:28].reshape(-1, 4, 6, 4, 6, 4, 6).mean(axis=(2, 4, 6))
    assert np.corrcoef(middle.ravel(), blocks.ravel())[0, 1] > 0.95


def build(kit, aabb, names, cameras=None, **options):
    denoiser = kit.torch_denoiser(keep_first, channels=names)
    settings = {"cubes": 5, "field_pitch": PITCH, "visibility_weight": 0.0, "seed": 3, **NO_LINE_LOSS} | options
    return DensityRegularizer(denoiser, aabb=aabb, cameras=cameras, **settings), denoiser


@pytest.mark.parametrize("rotate", [False, True])
def test_the_regularizer_tells_all_it_knows(kit, aabb, crowd, rotate):
    points = observed(crowd)
    regularizer, denoiser = build(kit, aabb, CHANNEL_NAMES, crowd, rotate=rotate, points=points)
    regularizer.observe(unit_lattice(8) * 1.9, np.ones((8, 8, 8)))
    cubes = draw_cubes(
        regularizer.grid,
        regularizer._rng(0),
        regularizer.settings,
        field_pitch=PITCH,
        resolution=32,
        device=torch.device("cpu"),
    )
    regularizer(waves_of_tensors)
    given = denoiser.calls[0][0]
    assert given.shape == (5, len(CHANNEL_NAMES), 32, 32, 32)
    turns = cubes.rotations if rotate else np.broadcast_to(np.eye(3), (5, 3, 3))
    np.testing.assert_array_equal(given[:, 2], encode_view_count(count_views(crowd, cubes.centers, cubes.edges, turns)))
    lines = evidence_lines(CHANNEL_NAMES, points, crowd, aabb=aabb, pitch=PITCH)
    lattice = cube_lattices(cubes.centers, cubes.edges, turns)
    for place, name in ((4, "support"), (5, "crossings")):
        share = encode_share(evidence_share(getattr(lines, name)(lattice)))
        np.testing.assert_allclose(given[:, place], share, atol=1e-5)
        assert share.std() > 0.02
    shown = torch.from_numpy(waves(cubes.positions.numpy()) * PITCH)
    told = torch.where(cubes.inside, 1 - 2 * torch.exp(-shown), -1.0)
    np.testing.assert_allclose(given[:, 0], told, atol=1e-5)
    expected = surroundings(lambda p: waves(p), cubes.centers, cubes.edges, turns, np.full(5, PITCH), aabb)
    np.testing.assert_allclose(coarse_channel(given[:, 1]), encode_surroundings(expected), atol=1e-5)
    assert expected.std() > 0.1


def test_without_cameras_views_are_unknown_and_surroundings_follow_the_rule(kit, aabb):
    regularizer, denoiser = build(kit, aabb, CHANNEL_NAMES, soft=False)
    regularizer(waves_of_tensors)
    given = denoiser.calls[0][0]
    assert (given[:, 2:] == UNKNOWN).all()
    eighths = (given[:, 1] + 0.5) / 1.5 * 8  # means of eight bits
    np.testing.assert_allclose(eighths, np.round(eighths), atol=1e-4)


def test_no_gradient_flows_through_what_is_told(kit, aabb, crowd):
    class Watched(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.level = torch.nn.Parameter(torch.tensor(1.0))
            self.asked = {True: 0, False: 0}

        def forward(self, positions):
            self.asked[torch.is_grad_enabled()] += len(positions)
            return waves_of_tensors(positions) * self.level

    gradients, asked = [], []
    for names in (CHANNEL_NAMES[:1], CHANNEL_NAMES):
        field = Watched()
        regularizer, _ = build(kit, aabb, names, crowd)
        regularizer.observe(unit_lattice(8) * 1.9, np.ones((8, 8, 8)))
        regularizer(field)["dsds"].backward()
        gradients.append(field.level.grad.item())
        asked.append(field.asked)
    assert gradients[0] == gradients[1] != 0
    assert asked[0][True] == asked[1][True]
    assert asked[0][False] == 0 < asked[1][False] <= 5 * 32**3 + len(crowd) * FAN[0] * FAN[1] * STEPS


def test_distorted_cameras_do_for_both(kit, aabb, crowd):
    bend = np.broadcast_to(np.array([0.05, -0.05, 0, 0, 0, 0]), (9, 6))
    bent = Cameras(crowd.camera_to_world, crowd.intrinsics, 40, 30, bend)
    regularizer, denoiser = build(kit, aabb, CHANNEL_NAMES, bent)
    regularizer(waves_of_tensors)
    assert len(np.unique(denoiser.calls[0][0][:, 2])) > 2


def test_fisheyes_and_cameras_that_differ_in_size_do_for_both(kit, aabb, crowd):
    """Every other one a fisheye in portrait; what a denoiser is told is the sum over rigs of one size."""
    round_ = np.arange(9) % 2 == 1
    bend = np.where(round_[:, None], [0.05, -0.01, 0, 0, 0, 0], 0.0)
    mixed = Cameras.create(
        crowd.camera_to_world, crowd.intrinsics, np.where(round_, 30, 40), np.where(round_, 40, 30), bend, round_
    )
    regularizer, denoiser = build(kit, aabb, CHANNEL_NAMES, mixed)
    regularizer(waves_of_tensors)
    assert len(np.unique(denoiser.calls[0][0][:, 2])) > 2
    centers, edges = np.array([[0.1, 0.2, 0.0], [0.5, -0.3, 0.2]]), np.array([0.8, 0.4])
    turned = np.broadcast_to(np.eye(3), (2, 3, 3))
    parts = [count_views(mixed.select(group), centers, edges, turned).astype(int) for group in mixed.by_size()]
    np.testing.assert_array_equal(count_views(mixed, centers, edges, turned), sum(parts))
    assert all(part.any() for part in parts)
