import subprocess
import sys

import numpy as np
import pytest
import torch

from unghost.core.frames import random_rotations
from unghost.core.occupancy import opacity_from_density
from unghost.fields.adapters.callables import (
    numpy_density_fn,
    occupancy_density_fn,
    transformed_density_fn,
)

BOX = [[-1, -1, -1], [1, 1, 1]]


def test_numpy_field_takes_any_shape_and_kind():
    field = numpy_density_fn(lambda p: p[:, 0] ** 2)
    points = np.arange(24.0).reshape(2, 4, 3)
    assert field(points).dtype == np.float32
    np.testing.assert_array_equal(field(points)[..., 0], points[..., 0] ** 2)
    tensor = field(torch.from_numpy(points).float())
    assert isinstance(tensor, torch.Tensor)
    np.testing.assert_array_equal(tensor.numpy(), field(points))
    assert field(np.zeros((0, 3))).shape == (0, 1)


def test_numpy_field_is_asked_in_chunks_and_inside_its_box_only():
    asked = []

    def function(points):
        asked.append(points.copy())
        return [[7]] * len(points)  # a list, of integers, (M, 1)

    points = np.array([[0, 0, 0], [2, 0, 0], [1, 1, 1], [0, np.nan, 0], [0.5, 0, 0]])
    found = numpy_density_fn(function, aabb=BOX, chunk=2)(points)
    assert found[:, 0].tolist() == [7, 0, 7, 0, 7]
    assert [len(part) for part in asked] == [2, 1]


def test_numpy_field_leaves_its_input_alone():
    points = torch.zeros(5, 3, requires_grad=True)
    assert not numpy_density_fn(lambda p: p.sum(1))(points).requires_grad
    assert points.grad is None


@pytest.mark.parametrize("wrong", [lambda p: p, lambda p: 1.0, lambda p: p[:-1, 0]])
def test_numpy_field_of_a_wrong_shape(wrong):
    with pytest.raises(ValueError, match="density_fn must return shape"):
        numpy_density_fn(wrong)(np.zeros((4, 3)))


def test_numpy_field_refuses():
    with pytest.raises(TypeError, match="function must be callable, got int"):
        numpy_density_fn(3)
    with pytest.raises(ValueError, match="chunk must be >= 1"):
        numpy_density_fn(lambda p: p, chunk=0)
    with pytest.raises(ValueError, match=r"positions must have shape \(\.\.\., 3\), got \(4, 2\)"):
        numpy_density_fn(lambda p: p)(np.zeros((4, 2)))


@pytest.mark.parametrize("kind", [np.asarray, torch.tensor])
def test_occupancy_is_the_opacity_of_a_cell(kind):
    share = kind([0.0, 0.25, 0.9])
    density = occupancy_density_fn(lambda p: share, pitch=0.05)(None)
    np.testing.assert_allclose(opacity_from_density(density, 0.05), [0.0, 0.25, 0.9], atol=1e-6)


@pytest.mark.parametrize("kind", [np.asarray, torch.tensor])
def test_bits_and_certainty_are_finite(kind):
    bits = kind([True, False])
    density = occupancy_density_fn(lambda p: bits, pitch=0.5, most=0.99)(None)
    np.testing.assert_allclose(np.asarray(density), [-np.log(0.01) / 0.5, 0.0], rtol=1e-5)


@pytest.mark.parametrize("wrong", [[-0.1], [1.5], [np.nan]])
def test_no_probability(wrong):
    with pytest.raises(ValueError, match=r"probabilities in \[0, 1\]"):
        occupancy_density_fn(lambda p: np.array(wrong), pitch=1.0)(None)


def test_occupancy_refuses():
    with pytest.raises(ValueError, match="pitch must be finite"):
        occupancy_density_fn(abs, pitch=0.0)
    with pytest.raises(ValueError, match="most must lie"):
        occupancy_density_fn(abs, pitch=1.0, most=1.0)


def test_what_a_ray_loses_does_not_depend_on_the_coordinates():
    """Optical depth through a soft ball, in its own coordinates and through ones moved, turned and resized."""
    ball = lambda p: 5.0 * np.exp(-(p**2).sum(-1) * 8)  # noqa: E731
    turn = random_rotations(np.random.default_rng(3), 1)[0]
    there = np.eye(4)  # from the new coordinates to the ball's
    there[:3, :3], there[:3, 3] = 0.2 * turn, [0.3, -1.0, 2.0]
    back = np.linalg.inv(there)
    t = np.linspace(-3, 3, 5001)
    line = np.array([0.05, 0.1, 0.0]) + np.outer(t, [0.6, 0.0, 0.8])
    seen = transformed_density_fn(ball, there)(line @ back[:3, :3].T + back[:3, 3])
    step = 6 / 5000
    assert (seen * step / 0.2).sum() == pytest.approx((ball(line) * step).sum(), rel=1e-9)


def test_transformed_tensors():
    moved = transformed_density_fn(lambda p: p[..., :1], np.diag([2.0, 2.0, 2.0, 1.0])[:3])
    assert moved(torch.tensor([[1.0, 0, 0]])).tolist() == [[4.0]]


@pytest.mark.parametrize("wrong", [np.eye(3), np.zeros((3, 4)), np.diag([1.0, 1, 2, 1]), np.full((4, 4), np.nan)])
def test_no_similarity(wrong):
    with pytest.raises(ValueError, match="transformed_density_fn: transform must be a"):
        transformed_density_fn(abs, wrong)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["callables", "sdf_density", "instant_ngp", "msgpack_stream", "splat_ply", "splats", "nerf_pytorch"]
)
def test_torch_is_needed_by_the_checkpoints_only(name):
    code = f"import sys; sys.modules['torch'] = None; import unghost.fields.{name}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode == 0) == (name != "nerf_pytorch"), done.stderr
