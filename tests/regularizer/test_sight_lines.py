import functools

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from unghost import load_denoiser
from unghost.core.cameras import Cameras, look_at
from unghost.core.sparse_points import SparsePoints
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.losses import end_point_loss, sight_line_loss
from unghost.regularizer.settings import RegularizerSettings

AABB = [[-1.0] * 3, [1.0] * 3]
PITCH = 2 / 64


@pytest.fixture(scope="module")
def denoiser():
    return load_denoiser()


def watched_plane(count=400, photos=8, seed=0):
    """Cameras above the plane z = -.5, whose points they all observe."""
    rng = np.random.default_rng(seed)
    origins = np.stack([*rng.uniform(-0.7, 0.7, (2, photos)), np.full(photos, 0.95)], axis=1)
    targets = np.tile([0.0, 0.0, -0.5], (photos, 1))
    cameras = Cameras.create(look_at(origins, targets), np.array([300.0, 300.0, 400.0, 400.0]), 800, 800)
    xyz = np.stack([*rng.uniform(-0.9, 0.9, (2, count)), np.full(count, -0.5)], axis=1)
    point, camera = (each.ravel() for each in np.meshgrid(np.arange(count), np.arange(photos), indexing="ij"))
    seen = cameras.sees(camera, xyz[point])
    return cameras, SparsePoints.create(xyz, point=point[seen], camera=camera[seen], cameras=cameras)


def plane_and_ghost(levels):
    """A floor three cells thick and a ball above it."""

    def density_fn(positions):
        floor = (positions[:, 2] + 0.5).abs() < 1.5 * PITCH
        ghost = (positions - torch.tensor([0.1, 0.0, 0.2])).norm(dim=-1) < 0.2
        return levels[0] * floor + levels[1] * ghost

    return density_fn


def test_losses_by_hand():
    density, length = torch.tensor([[1.0, 3.0], [0.0, 0.0]]), torch.tensor([0.5, 2.0])
    assert sight_line_loss(density, length).tolist() == pytest.approx([1 - np.exp(-1.0), 0.0])
    assert end_point_loss(density, 0.5).tolist() == pytest.approx([np.exp(-1.0), 1.0])
    thin = sight_line_loss(torch.tensor([[1e-12]]), 1.0)
    assert thin.item() == pytest.approx(1e-12, rel=1e-6)  # no cancellation
    for loss in (sight_line_loss, end_point_loss):
        values = torch.rand(4, 5, dtype=torch.float64, requires_grad=True)
        assert gradcheck(lambda d, loss=loss: loss(d, torch.rand(4, dtype=torch.float64) * 0 + 0.7), values)
        assert torch.isfinite(loss(torch.full((1, 2), 3e38), 1.0)).all()
        with pytest.raises(ValueError, match=r"density must be \(L, S\)"):
            loss(torch.zeros(4), 1.0)
        with pytest.raises(ValueError, match=r"length \(L,\)"):
            loss(torch.zeros(4, 2), torch.zeros(3))


def test_ghosts_on_sight_lines_go_and_surfaces_stay(denoiser):
    cameras, points = watched_plane()
    levels = torch.tensor([30.0, 0.3], requires_grad=True)
    regularizer = DensityRegularizer(
        denoiser,
        aabb=AABB,
        cameras=cameras,
        points=points,
        field_pitch=PITCH,
        settings=RegularizerSettings(dsds_weight=0.0, visibility_weight=0.0),
    )
    losses = regularizer(plane_and_ghost(levels))
    assert losses["dsds"] == losses["visibility"] == 0.0
    assert regularizer.report["lines"] == 4096
    losses["sight_lines"].backward()
    floor, ghost = levels.grad.tolist()
    assert ghost > 1e-4
    assert floor <= 0.0  # the lines end before the floor, and its points hold it up


def test_both_terms_have_their_weight(denoiser):
    cameras, points = watched_plane()
    found = {}
    for name, weights in {"both": (0.5, 0.25), "lines": (0.5, 0.0), "ends": (0.0, 0.25), "none": (0.0, 0.0)}.items():
        settings = RegularizerSettings(
            dsds_weight=0.0, visibility_weight=0.0, sight_line_weight=weights[0], end_point_weight=weights[1]
        )
        regularizer = DensityRegularizer(
            denoiser, aabb=AABB, cameras=cameras, points=points, field_pitch=PITCH, settings=settings
        )
        found[name] = regularizer(plane_and_ghost(torch.tensor([30.0, 5.0])))["sight_lines"].item()
    assert found["none"] == 0.0
    assert 0 < found["lines"] < 0.5
    assert 0 < found["ends"] < 0.25
    assert found["both"] == pytest.approx(found["lines"] + found["ends"])


def test_without_points_or_lines_it_is_zero(denoiser):
    cameras, points = watched_plane(count=20)
    field = plane_and_ghost(torch.tensor([30.0, 5.0]))
    trackless = SparsePoints.create(points.xyz)
    build = functools.partial(DensityRegularizer, denoiser, aabb=AABB, cameras=cameras, field_pitch=PITCH, cubes=1)
    assert build()(field)["sight_lines"] == 0.0
    for given in (SparsePoints.create(np.zeros((0, 3))), trackless):
        with pytest.warns(UserWarning, match=r"the sight-line loss is 0, as no line is left of \d+ points with 0 obs"):
            regularizer = build(points=given)
        assert regularizer(field)["sight_lines"] == 0.0


def test_proposal_networks_are_cleaned_too(denoiser):
    cameras, points = watched_plane()
    levels = torch.tensor([[0.0, 0.3], [0.0, 0.3]], requires_grad=True)
    regularizer = DensityRegularizer(denoiser, aabb=AABB, cameras=cameras, points=points, field_pitch=PITCH, cubes=0)
    regularizer([plane_and_ghost(levels[0]), plane_and_ghost(levels[1])])["sight_lines"].backward()
    assert (levels.grad[:, 1] > 0).all()


def test_what_does_not_fit_is_refused(denoiser):
    cameras, points = watched_plane(count=20)
    with pytest.raises(ValueError, match="points must come with cameras"):
        DensityRegularizer(denoiser, aabb=AABB, points=points)
    with pytest.raises(ValueError, match="refer to the 2 cameras, got camera 7"):
        DensityRegularizer(denoiser, aabb=AABB, cameras=cameras.select([0, 1]), points=points)
    moved = SparsePoints.create(points.xyz + 50, point=points.point, camera=points.camera)
    with pytest.warns(UserWarning, match="only 0% of the observations project"):
        DensityRegularizer(denoiser, aabb=AABB, cameras=cameras, points=moved)
    for name, value in (("sight_lines", -1), ("sight_line_samples", 0), ("sight_line_weight", -1.0)):
        with pytest.raises(ValueError, match=f"{name} must be"):
            RegularizerSettings(**{name: value})


def test_ghosts_beyond_the_box_go_if_the_lines_reach_there(denoiser):
    """A ball at z = 3 between cameras at z = -0.9 and a wall at z = 6: outside the box, on the way to the points."""
    rng = np.random.default_rng(0)
    origins = np.stack([*rng.uniform(-0.7, 0.7, (2, 8)), np.full(8, -0.9)], axis=1)
    cameras = Cameras.create(
        look_at(origins, np.tile([0.0, 0.0, 6.0], (8, 1))), np.array([3000.0, 3000.0, 400.0, 400.0]), 800, 800
    )
    xyz = np.stack([*rng.uniform(-0.5, 0.5, (2, 200)), np.full(200, 6.0)], axis=1)
    point, camera = (each.ravel() for each in np.meshgrid(np.arange(200), np.arange(8), indexing="ij"))
    points = SparsePoints.create(xyz, point=point, camera=camera, cameras=cameras)
    asked = []

    def density_fn(positions):
        asked.append(positions.detach())
        return level * ((positions - torch.tensor([0.0, 0.0, 3.0])).norm(dim=-1) < 0.7)

    slopes = {}
    for reach in (1.0, 8.0):
        level = torch.tensor(0.3, requires_grad=True)
        regularizer = DensityRegularizer(
            denoiser,
            aabb=AABB,
            cameras=cameras,
            points=points,
            field_pitch=PITCH,
            cubes=0,
            visibility_weight=0.0,
            sight_line_reach=reach,
        )
        asked.clear()
        regularizer(density_fn)["sight_lines"].backward()
        slopes[reach] = level.grad.item()
        farthest = max(float(each.abs().max()) for each in asked)
        assert farthest <= reach + 1e-5
    assert slopes[1.0] == 0.0
    assert slopes[8.0] > 1e-4
    with pytest.raises(ValueError, match="sight_line_reach must be in"):
        RegularizerSettings(sight_line_reach=0.9)
