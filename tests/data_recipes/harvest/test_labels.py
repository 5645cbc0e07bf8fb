import numpy as np
import pytest

from unghost.core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL
from unghost.data_recipes.harvest.labels import Truth, check_fit, severity_of

pytest.importorskip("torch")
from unghost.scenes.generator import observers

AABB = np.array([[-1.0] * 3, [1.0] * 3])


def labels_one_by_one(photographed, positions, pitch, opaque, hidden, observers):
    """The definition in the module's text, a point at a time, with the plain minimum over all solids."""
    labels = []
    for position, filled, dark in zip(positions, opaque, hidden):
        distance = min(float(solid.distance(position[None])[0]) for solid in photographed.scene.solids)
        seen, shallow = False, False
        for index in range(len(photographed.true_cameras)):
            pixel, depth, visible = photographed.true_cameras.project(index, position)
            if visible:
                row, column = min(int(pixel[1]), 29), min(int(pixel[0]), 39)
                front = photographed.depth_maps[index, row, column]
                seen |= bool(depth <= 1.02 * (front + 2 * pitch))
                shallow |= bool(depth <= 1.02 * (front + 6 * pitch))
        watched = False
        for cameras, depth_maps in observers:
            for index in range(len(cameras)):
                pixel, depth, visible = cameras.project(index, position)
                row = min(int(max(pixel[1], 0)), cameras.height - 1)
                column = min(int(max(pixel[0], 0)), cameras.width - 1)
                watched |= bool(visible and depth <= depth_maps[index, row, column])
        behind = filled and not dark and shallow and -4 * pitch <= distance < 0
        if not ((position >= -1) & (position <= 1)).all():
            labels.append(IGNORE_LABEL)
        elif distance > 1.5 * pitch:
            labels.append(IGNORE_LABEL if filled and not watched else FREE_LABEL)
        elif seen if abs(distance) <= 0.75 * pitch else behind:
            labels.append(SURFACE_LABEL)
        else:
            labels.append(IGNORE_LABEL)
    return np.array(labels)


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [0.02, 0.06])
@pytest.mark.parametrize("nodes", [8, 64])
def test_labels_follow_their_definition(photographed, pitch, nodes):
    rng = np.random.default_rng(1)
    positions = rng.uniform(-1.1, 1.1, size=(2500, 3))
    opaque, hidden = rng.random(2500) < 0.5, rng.random(2500) < 0.3
    others = observers(np.random.default_rng(5), photographed.scene, count=2, width=20, height=16)
    assert len(others[0]) == 2
    truth = Truth(photographed, AABB, nodes=nodes, observers=others)
    labels = truth.labels(positions, pitch, opaque, hidden)
    assert labels.dtype == np.uint8
    watching = [(photographed.true_cameras, photographed.depth_maps), others]
    expected = labels_one_by_one(photographed, positions, pitch, opaque, hidden, watching)
    np.testing.assert_array_equal(labels, expected)
    alone = Truth(photographed, AABB, nodes=nodes).labels(positions, pitch, opaque, hidden)
    assert ((alone == FREE_LABEL) <= (labels == FREE_LABEL)).all()
    assert (alone != labels).any()
    assert set(np.unique(labels)) == {FREE_LABEL, SURFACE_LABEL, IGNORE_LABEL}


def test_labels_by_hand(photographed):
    truth = Truth(photographed, AABB)
    ball = np.array([0.2, 0.3, -0.1])
    toward = np.array([0.7, 0.0, 0.5]) / np.linalg.norm([0.7, 0.0, 0.5])
    positions = np.stack(
        [
            ball + 0.3 * toward,  # the skin that the cameras see
            ball + np.array([-0.3, 0.0, 0.0]),  # the skin that they do not
            ball,  # deep inside
            ball + 0.24 * toward,  # three cells behind the skin that they see
            ball + np.array([-0.24, 0.0, 0.0]),  # three cells behind the skin that they do not
            ball + 0.32 * toward,  # one cell out: the band between
            ball + 0.5 * toward,  # air before the cameras
            np.array([0.0, 0.0, 0.9]),  # air that nobody looks at
            np.array([-0.5, 0.75, -0.2]),  # air behind the ball, hidden by it
            np.array([0.0, 0.0, 1.1]),  # air outside the box
        ]
    ).reshape(2, 5, 3)
    opaque, light = np.ones((2, 5), dtype=bool), np.zeros((2, 5), dtype=bool)
    seen, ignored, free = SURFACE_LABEL, IGNORE_LABEL, FREE_LABEL
    expected = np.array([[seen, ignored, ignored, seen, ignored], [ignored, free, ignored, ignored, ignored]])
    np.testing.assert_array_equal(truth.labels(positions, 0.02, opaque, light), expected)
    expected[0, 3] = ignored  # what the field left empty behind the skin is no fault, nor what nobody sees there
    np.testing.assert_array_equal(truth.labels(positions, 0.02, opaque, ~light), expected)
    expected[1, 2:4] = free  # air that is empty in the field too is nobody's ghost
    np.testing.assert_array_equal(truth.labels(positions, 0.02, ~opaque, light), expected)


def test_coarse_distances_are_exact_where_it_matters(photographed):
    points = np.random.default_rng(2).uniform(-1, 1, size=(5000, 3))
    exact = photographed.scene.signed_distance(points)
    for margin in (0.0, 0.05, 0.3):
        found = Truth(photographed, AABB, nodes=12).distances(points, margin)
        close = np.abs(exact) <= margin
        np.testing.assert_allclose(found[close], exact[close], atol=1e-12)
        assert (np.abs(found[~close]) > margin).all()
        np.testing.assert_array_equal(found > margin, exact > margin)


def test_severity_by_hand():
    inputs = np.full((4, 32, 32, 32), -1.0, dtype=np.float32)
    labels = np.full((4, 32, 32, 32), FREE_LABEL, dtype=np.uint8)
    inputs[0, 0, 0, :6] = 0.0  # opacity 0.5: six opaque voxels
    labels[0, 0, 0, 4:8] = SURFACE_LABEL  # four of the surface, two of them opaque: 2 / 8
    inputs[1, 0, 0, :6] = 1.0
    labels[1, 0, 0, :6] = IGNORE_LABEL  # nothing that counts: as good as can be
    labels[2, 0] = SURFACE_LABEL  # a surface that the field misses
    inputs[3, 0] = -0.85  # opacity 0.075: not opaque
    np.testing.assert_allclose(severity_of(inputs, labels), [0.75, 0.0, 1.0, 0.0])
    assert severity_of(inputs[:0], labels[:0]).shape == (0,)


def test_failed_fits_are_refused():
    inputs = np.full((1, 10, 10, 10), -1.0, dtype=np.float32)
    labels = np.full((1, 10, 10, 10), FREE_LABEL, dtype=np.uint8)
    labels[0, 0] = SURFACE_LABEL  # a hundred voxels
    inputs[0, 0, 0] = 0.0  # ten of them opaque
    inputs[0, 1:9, 0] = 0.0  # and eighty ghosts: 8 to 1
    limits = {"fewest_opaque": 0.1, "most_ghosts": 0.9}
    check_fit(inputs, labels, **limits)
    inputs[0, 9, :2] = 0.0  # a hundred ghosts: 10 to 1
    with pytest.raises(RuntimeError, match="91% of what is opaque are ghosts"):
        check_fit(inputs, labels, **limits)
    inputs[0, 0, 0, 0] = -1.0
    with pytest.raises(RuntimeError, match="9% of the surface is opaque"):
        check_fit(inputs, labels, **limits)
    check_fit(inputs[:0], labels[:0], **limits)
