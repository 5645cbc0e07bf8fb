import json
from dataclasses import replace

import numpy as np
import pytest

from unghost.core.aabb import contains
from unghost.core.cameras import Cameras
from unghost.core.frames import cube_lattices
from unghost.core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL
from unghost.core.shards import dequantize_signed, read_shard, unpack_labels
from unghost.data_recipes import harvest as module
from unghost.data_recipes.harvest import HarvestConfig, Truth, harvest, harvest_scene, room_scene, severity_of

torch = pytest.importorskip("torch")
scenes = pytest.importorskip("unghost.fields.scenes")
solids = pytest.importorskip("unghost.fields.solids")

AABB = np.array([[-1.0] * 3, [1.0] * 3])
TINY = HarvestConfig(
    resolutions=(24, 32),
    photos=(2, 3),
    photo_width=(16, 20),
    steps=(10, 14),
    rays=48,
    cubes=3,
    room_pitch=(0.01, 0.05),
    fewest_opaque=0.0,
    most_ghosts=1.0,
)


@pytest.fixture(scope="module")
def photographed():
    """A ball and a box on a floor, photographed from +x: their -x sides are seen by nobody."""
    rng = np.random.default_rng(0)
    texture = scenes.random_texture(rng)
    scene = solids.SolidScene(
        [
            solids.Solid("sphere", (0.3,), np.array([0.2, 0.3, -0.1]), texture, 0.3),
            solids.Solid("box", (np.array([0.2, 0.2, 0.3]),), np.array([-0.2, -0.4, -0.1]), texture, 0.42),
            solids.Solid("box", (np.array([2.0, 2.0, 0.1]),), np.array([0.0, 0.0, -0.55]), texture, 2.84),
        ],
        [],
    )
    origins = np.array([[0.95, 0.0, 0.2], [0.9, 0.3, 0.4]])
    poses = scenes.look_at(origins, np.array([[0.0, 0.0, -0.2]] * 2))
    cameras = Cameras.create(poses, np.array([24.0, 24.0, 20.0, 15.0]), 40, 30)
    rays = [[ray.reshape(-1, 3) for ray in cameras.rays(index)] for index in range(2)]
    depth = [scene.trace(*ray) * -(ray[1] @ poses[index, :, 2]) for index, ray in enumerate(rays)]
    images = np.zeros((2, 30, 40, 3), dtype=np.float32)
    return scenes.PhotographedScene(scene, cameras, cameras, images, np.stack(depth).reshape(2, 30, 40))


def labels_one_by_one(photographed, positions, pitch, opaque):
    """The definition in the module's text, a point at a time, with the plain minimum over all solids."""
    labels = []
    for position, filled in zip(positions, opaque):
        distance = min(float(solid.distance(position[None])[0]) for solid in photographed.scene.solids)
        seen, shallow = False, False
        for index in range(len(photographed.true_cameras)):
            pixel, depth, visible = photographed.true_cameras.project(index, position)
            if visible:
                row, column = min(int(pixel[1]), 29), min(int(pixel[0]), 39)
                front = photographed.depth_maps[index, row, column]
                seen |= bool(depth <= 1.02 * (front + 2 * pitch))
                shallow |= bool(depth <= 1.02 * (front + 6 * pitch))
        if not ((position >= -1) & (position <= 1)).all():
            labels.append(IGNORE_LABEL)
        elif distance > 1.5 * pitch:
            labels.append(FREE_LABEL)
        elif seen if abs(distance) <= 0.75 * pitch else filled and shallow and -4 * pitch <= distance < 0:
            labels.append(SURFACE_LABEL)
        else:
            labels.append(IGNORE_LABEL)
    return np.array(labels)


@pytest.mark.parametrize("pitch", [0.02, 0.06])
@pytest.mark.parametrize("nodes", [8, 64])
def test_labels_follow_their_definition(photographed, pitch, nodes):
    rng = np.random.default_rng(1)
    positions = rng.uniform(-1.1, 1.1, size=(2500, 3))
    opaque = rng.random(2500) < 0.5
    labels = Truth(photographed, AABB, nodes=nodes).labels(positions, pitch, opaque)
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, labels_one_by_one(photographed, positions, pitch, opaque))
    assert set(np.unique(labels)) == {FREE_LABEL, SURFACE_LABEL, IGNORE_LABEL}


def test_labels_by_hand(photographed):
    truth = Truth(photographed, AABB)
    ball = np.array([0.2, 0.3, -0.1])
    toward = np.array([0.7, 0.0, 0.5]) / np.linalg.norm([0.7, 0.0, 0.5])
    positions = np.stack([
        ball + 0.3 * toward,  # the skin that the cameras see
        ball + np.array([-0.3, 0.0, 0.0]),  # the skin that they do not
        ball,  # deep inside
        ball + 0.24 * toward,  # three cells behind the skin that they see
        ball + np.array([-0.24, 0.0, 0.0]),  # three cells behind the skin that they do not
        ball + 0.32 * toward,  # one cell out: the band between
        np.array([0.0, 0.0, 0.9]),  # air
        np.array([0.0, 0.0, 1.1]),  # air outside the box
    ]).reshape(2, 4, 3)  # fmt: skip
    opaque = np.ones((2, 4), dtype=bool)
    seen, ignored, free = SURFACE_LABEL, IGNORE_LABEL, FREE_LABEL
    expected = np.array([[seen, ignored, ignored, seen], [ignored, ignored, free, ignored]])
    np.testing.assert_array_equal(truth.labels(positions, 0.02, opaque), expected)
    expected[0, 3] = ignored  # what the field left empty behind the skin is no fault
    np.testing.assert_array_equal(truth.labels(positions, 0.02, ~opaque), expected)


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
    module.check_fit(inputs, labels, HarvestConfig())
    inputs[0, 9, :2] = 0.0  # a hundred ghosts: 10 to 1
    with pytest.raises(RuntimeError, match="91% of what is opaque are ghosts"):
        module.check_fit(inputs, labels, HarvestConfig())
    inputs[0, 0, 0, 0] = -1.0
    with pytest.raises(RuntimeError, match="9% of the surface is opaque"):
        module.check_fit(inputs, labels, HarvestConfig())
    module.check_fit(inputs[:0], labels[:0], HarvestConfig())


def test_one_scene_end_to_end_and_again(tmp_path):
    heard = []
    count = harvest(tmp_path, scenes=1, seed=3, first=5, config=TINY, log=heard.append)
    assert count == 2 * TINY.cubes, heard
    shard = read_shard(tmp_path / "scene-00005", verify=True)
    assert set(shard.group.tolist()) == {5}
    labels = unpack_labels(shard.labels)
    assert {FREE_LABEL, IGNORE_LABEL} <= set(np.unique(labels))
    np.testing.assert_allclose(
        shard.severity, severity_of(dequantize_signed(shard.inputs), labels), atol=0.02
    )  # stored inputs are rounded to 8 bits
    assert ((shard.severity >= 0) & (shard.severity <= 1)).all()
    assert (shard.edge_fraction > 0).all()
    told = shard.provenance
    assert (told["seed"], told["scene"], told["recipe"]) == (3, 5, "harvest")
    assert told["config"] == json.loads(json.dumps(TINY.__dict__))
    # a second call finds its work done, and an unfinished folder of a killed run is not counted
    (tmp_path / "scene-00006.partial").mkdir()
    stamp = (tmp_path / "scene-00005" / "manifest.json").stat().st_mtime_ns
    assert harvest(tmp_path, scenes=1, seed=3, first=5, config=TINY, log=heard.append) == count
    assert (tmp_path / "scene-00005" / "manifest.json").stat().st_mtime_ns == stamp
    assert heard[-1].startswith("0 scenes")


def first_free(seed):
    for index in range(20):
        try:
            return index, *harvest_scene(seed, index, TINY)
        except RuntimeError:
            continue
    raise AssertionError("twenty scenes without a free path")


def test_a_scene_depends_on_seed_and_index_alone():
    index, arrays, provenance = first_free(7)
    state = torch.random.get_rng_state()
    torch.manual_seed(99)
    outside = torch.random.get_rng_state()
    again, _ = harvest_scene(7, index, TINY)
    assert torch.equal(torch.random.get_rng_state(), outside)  # and it leaves the global generator alone
    torch.random.set_rng_state(state)
    for name in arrays:
        np.testing.assert_array_equal(arrays[name], again[name])
    assert provenance["photos"] in (2, 3)
    assert 10 <= provenance["steps"] <= 14
    other = first_free(8)[1]
    assert not np.array_equal(other["inputs"], arrays["inputs"])


def test_cubes_outside_the_box_are_empty_and_ignored(photographed, monkeypatch):
    from unghost.fields.radiance import RadianceConfig, RadianceField

    field = RadianceField(RadianceConfig(16, 8, initial_opacity=0.5))
    monkeypatch.setattr(module, "_propose", lambda rng, field, count: np.full((count, 3), 0.95))
    config = replace(TINY, cubes=2, rotated_share=0.0, voxel_pitch=(0.02, 0.02))
    arrays = module.harvest_cubes(np.random.default_rng(0), field, Truth(photographed, AABB), config)
    # the cube's edge is 32 * 0.02 * 4 / 15 = 0.17: its far corner sticks out of the box by 0.035
    edges = arrays["edge_fraction"] * 2.0
    np.testing.assert_allclose(edges, 32 * 0.02 * 4 / 15, rtol=1e-6)
    outside = ~contains(AABB, cube_lattices(np.full((2, 3), 0.95), edges))
    assert 0.2 < outside.mean() < 0.9
    assert not arrays["inputs"][outside].any()
    assert (arrays["inputs"][~outside] > 60).all()
    assert (unpack_labels(arrays["labels"])[outside] == IGNORE_LABEL).all()


def test_proposals_prefer_what_is_opaque():
    from unghost.fields.radiance import RadianceConfig, RadianceField

    field = RadianceField(RadianceConfig(17, 8, initial_opacity=1e-4))
    with torch.no_grad():
        field.density_table.view(17, 17, 17)[:9] = 3.0  # opaque where x < 0
    centers = module._propose(np.random.default_rng(0), field, 400)
    assert contains(field.aabb, centers).all()
    # nine in ten are opaque, and half of the rest
    assert 0.9 < (centers[:, 0] < 0.25).mean() < 0.99


def test_room_scenes_repeat_and_fit_a_shard(tmp_path):
    arrays, _ = room_scene(1, 2, TINY)
    again, _ = room_scene(1, 2, TINY)
    for name in arrays:
        np.testing.assert_array_equal(arrays[name], again[name])
    assert not np.array_equal(room_scene(1, 3, TINY)[0]["inputs"], arrays["inputs"])
    assert harvest(tmp_path, scenes=1, config=TINY, fit=False) == TINY.cubes
    assert read_shard(tmp_path / "scene-00000", verify=True).provenance["recipe"] == "rooms"


@pytest.mark.parametrize("arguments", [{"scenes": 0}, {"scenes": 1, "workers": 0}])
def test_bad_counts_are_refused_before_anything_is_written(tmp_path, arguments):
    with pytest.raises(ValueError, match="harvest: scenes and workers must be >= 1"):
        harvest(tmp_path / "out", **arguments)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"photos": (5, 2)}, r"photos must be \(low, high\) with 0 < low <= high, got \(5, 2\)"),
        ({"steps": (0, 10)}, r"steps must be .* got \(0, 10\)"),
        ({"voxel_pitch": (-1.0, 1.0)}, r"voxel_pitch must be"),
        ({"cubes": 0}, "rays and cubes must be >= 1, got 1152 and 0"),
    ],
)
def test_bad_configs_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        HarvestConfig(**arguments)
