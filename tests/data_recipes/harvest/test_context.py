import numpy as np

from unghost.core.frames import cube_lattices, random_rotations
from unghost.core.occupancy import opacity_from_signed
from unghost.data_recipes.harvest.context import signed_opacity, surroundings

AABB = np.array([[-1.0] * 3, [1.0] * 3])


def smooth(positions):
    """A fog of gentle waves, per scene unit."""
    x, y, z = positions.T
    return (4.0 + 1.5 * np.sin(2 * x + y) + 1.5 * np.cos(3 * z - x)).astype(np.float32)


def test_surroundings_are_aligned_with_their_cube():
    rng = np.random.default_rng(5)
    centers, edges = rng.uniform(-0.2, 0.2, size=(3, 3)), np.array([0.2, 0.3, 0.15])
    rotations = np.concatenate([np.eye(3)[None], random_rotations(rng, 2)])
    pitch = np.array([0.05, 0.04, 0.06])
    coarse = surroundings(smooth, centers, edges, rotations, pitch, AABB)
    assert coarse.shape == (3, 16, 16, 16)
    assert coarse.dtype == np.float32
    fine = signed_opacity(smooth, cube_lattices(centers, edges, rotations), pitch, AABB)
    # a coarse voxel is 3 * 32 / 16 = 6 fine ones wide; the cube begins 16 fine voxels, 2 2/3 coarse ones, behind the
    # middle, so that the coarse voxels 6 to 9 (4 of the 16, about the middle) are the fine ones 4 to 27
    blocks = fine[:, 4:28, 4:28, 4:28].reshape(3, 4, 6, 4, 6, 4, 6).mean(axis=(2, 4, 6))
    assert blocks.std() > 0.03
    np.testing.assert_allclose(coarse[:, 6:10, 6:10, 6:10], blocks, atol=1e-3)
    # and it is not aligned by accident: shifted by one voxel, or with two axes exchanged, it does not fit
    assert np.abs(coarse[:, 5:9, 6:10, 6:10] - blocks).max() > 5e-3
    assert np.abs(coarse[:, 6:10, 6:10, 6:10].swapaxes(1, 2) - blocks).max() > 5e-3


def test_surroundings_see_a_surface_between_their_centres():
    def sheet(positions):
        return np.where(np.abs(positions[:, 0] - 0.024) < 0.004, 1e4, 0.0).astype(np.float32)

    # three edges are 0.32: voxels of 0.02. Their centres (.01, .03, ..) miss the sheet from .02 to .028; of the two
    # layers of points in the voxel from .02 to .04, at .025 and .035, one lies in it.
    coarse = surroundings(sheet, np.zeros((1, 3)), np.array([0.32 / 3]), np.eye(3)[None], np.array([0.02]), AABB)
    opacity = opacity_from_signed(coarse)[0]
    np.testing.assert_allclose(opacity[9], 0.5, atol=1e-6)
    assert not np.delete(opacity, 9, axis=0).any()


def test_outside_the_box_all_is_empty():
    frames = np.array([[0.9, 0.0, 0.0]]), np.array([0.2]), np.eye(3)[None]
    coarse = surroundings(lambda positions: np.full(len(positions), 1e6, np.float32), *frames, np.array([0.1]), AABB)
    # from 0.6 to 1.2 in 16 voxels of 0.0375: 10 lie wholly inside, the eleventh (.975 to 1.0125) has its first half in
    np.testing.assert_allclose(coarse[0, :10], 1.0)
    np.testing.assert_allclose(coarse[0, 10], 0.0, atol=1e-6)
    np.testing.assert_allclose(coarse[0, 11:], -1.0)
