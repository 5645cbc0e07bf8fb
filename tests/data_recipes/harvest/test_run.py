import json
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from unghost.core.aabb import contains
from unghost.core.frames import cube_lattices
from unghost.core.occupancy import FREE_LABEL, IGNORE_LABEL, opacity_from_density
from unghost.core.shards.packing import dequantize_signed, unpack_frame, unpack_labels
from unghost.core.shards.storage import read_shard
from unghost.core.visibility.view_counts import count_views
from unghost.data_recipes.harvest import config as harvest_config
from unghost.data_recipes.harvest import run as module
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.harvest.labels import Truth, severity_of
from unghost.data_recipes.harvest.run import harvest, harvest_scene, room_scene

torch = pytest.importorskip("torch")
scenes = pytest.importorskip("unghost.scenes.generator")
solids = pytest.importorskip("unghost.scenes.solids")

AABB = np.array([[-1.0] * 3, [1.0] * 3])
TINY = HarvestConfig(
    resolutions=(24, 32),
    photos=(2, 3),
    photo_width=(16, 20),
    observer_photos=4,
    observer_width=32,
    steps=(10, 14),
    rays=48,
    cubes=3,
    room_pitch=(0.01, 0.05),
    fewest_opaque=0.0,
    most_ghosts=1.0,
)


@pytest.mark.slow
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
    assert shard.kind == "harvest"
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


@pytest.mark.slow
def test_a_scene_depends_on_seed_and_index_alone():
    index, arrays, provenance = first_free(7)
    state = torch.random.get_rng_state()
    torch.manual_seed(99)
    outside = torch.random.get_rng_state()
    threads = torch.get_num_threads()
    torch.set_num_threads(4)  # sums in several threads would differ in their last bits
    try:
        again, _ = harvest_scene(7, index, TINY)
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(threads)
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


@pytest.mark.slow
def test_a_cube_is_stored_with_what_is_about_it(photographed):
    from unghost.fields.kinds import make_field

    field = make_field("hash", 24, initial_opacity=0.2, seed=1)
    with torch.no_grad():
        field.table.normal_(0, 1, generator=torch.Generator().manual_seed(2))
    config = replace(TINY, cubes=module.TOGETHER + 3)
    arrays = module.harvest_cubes(np.random.default_rng(4), field, Truth(photographed, AABB), config)
    assert {name: len(array) for name, array in arrays.items()} == dict.fromkeys(arrays, config.cubes)
    frames = arrays["frames"]
    views = count_views(photographed.cameras, frames[:, :3], frames[:, 3], frames[:, 4:].reshape(-1, 3, 3))
    np.testing.assert_array_equal(arrays["view_count"], views)
    np.testing.assert_allclose(arrays["edge_fraction"], frames[:, 3] / 2.0, rtol=1e-6)
    for row in (0, module.TOGETHER, config.cubes - 1):
        frame = unpack_frame(frames[row])
        wider = replace(frame, edge_length=3 * frame.edge_length)
        for lattice, stored, pool in (
            (frame.lattice(), arrays["inputs"][row], 1),
            (wider.lattice(), arrays["surroundings"][row], 2),
        ):
            check_opacity(field, lattice, stored / 255, pool)


def check_opacity(field, lattice, opacity, pool):
    """``opacity`` is the field's at ``lattice``, averaged, with a pitch within exp(-.3) to exp(.3) of the field's."""
    density = field.density_fn(torch.from_numpy(lattice).float())[..., 0].detach().numpy()
    density[~contains(AABB, lattice)] = 0.0
    side = 32 // pool
    bounds = []
    for factor in np.exp([-0.3, 0.3]):
        blocks = opacity_from_density(density, field.field_pitch * factor).reshape(side, pool, side, pool, side, pool)
        bounds.append(blocks.mean(axis=(1, 3, 5)))
    assert (opacity >= bounds[0] - 0.003).all()
    assert (opacity <= bounds[1] + 0.003).all()
    assert opacity.max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("kind", harvest_config.KINDS)
def test_any_kind_of_field_is_harvested(kind, tmp_path):
    config = replace(TINY, kinds=(kind,), shares=(1.0,), steps=(5, 6), cubes=1)
    assert harvest(tmp_path, scenes=1, seed=3, first=5, config=config) == 2 * config.cubes
    shard = read_shard(tmp_path / "scene-00005", verify=True)
    assert shard.provenance["field"] == kind
    assert shard.provenance["field_pitch"] == pytest.approx(4 / shard.provenance["resolution"], rel=0.1)
    assert shard.surroundings is not None
    assert shard.frames is not None
    assert shard.view_count.max() <= shard.provenance["photos"]
    again = harvest_scene(3, 5, config)[0]  # in this process, which may have more threads than a worker
    for name, array in again.items():
        np.testing.assert_array_equal(getattr(shard, name), array, err_msg=name)


def test_kinds_come_in_their_shares_in_the_same_rooms():
    from unghost.fields.kinds import KINDS

    assert set(harvest_config.KINDS) == set(KINDS)
    assert set(KINDS) - set(HarvestConfig().kinds) == {"mlp"}  # never in a harvest for training
    assert set(HarvestConfig().kinds) <= set(KINDS)
    assert module.HarvestConfig().shares == (0.6, 0.4)
    config = replace(TINY, kinds=("dense", "hash"), shares=(1.0, 3.0))
    drawn = [module._draw_field(np.random.default_rng([1, index]), config)[0] for index in range(400)]
    assert 0.68 < drawn.count("hash") / 400 < 0.82  # 3 of 4, give or take three standard deviations


def test_a_scene_that_fails_is_told_and_the_run_goes_on(tmp_path, monkeypatch):
    from unghost.fields import training

    def diverge(*args, **kwargs):
        raise FloatingPointError("train_field: the loss is not finite at step 3")

    monkeypatch.setattr(training, "train_field", diverge)
    threads = torch.get_num_threads()
    index, problem = module._work(str(tmp_path), 3, 5, TINY, True, None)
    assert (index, problem) == (5, "train_field: the loss is not finite at step 3")
    assert torch.get_num_threads() == threads
    assert not list(tmp_path.iterdir())


def test_proposals_prefer_what_is_opaque():
    from unghost.fields.radiance import RadianceConfig, RadianceField

    field = RadianceField(RadianceConfig(17, 8, initial_opacity=1e-4))
    with torch.no_grad():
        field.density_table.view(17, 17, 17)[:9] = 3.0  # opaque where x < 0
    centers = module._propose(np.random.default_rng(0), field, 400)
    assert contains(field.aabb, centers).all()
    # nine in ten are opaque, and half of the rest
    assert 0.9 < (centers[:, 0] < 0.25).mean() < 0.99


@pytest.mark.slow
def test_room_scenes_repeat_and_fit_a_shard(tmp_path):
    arrays, _ = room_scene(1, 2, TINY)
    again, _ = room_scene(1, 2, TINY)
    for name in arrays:
        np.testing.assert_array_equal(arrays[name], again[name])
    assert not np.array_equal(room_scene(1, 3, TINY)[0]["inputs"], arrays["inputs"])
    assert harvest(tmp_path, scenes=1, config=TINY, fit=False) == TINY.cubes
    shard = read_shard(tmp_path / "scene-00000", verify=True)
    assert (shard.kind, shard.provenance["recipe"]) == ("pairs", "rooms")


KILLED = """
import sys
from unghost.data_recipes.harvest.run import harvest
from unghost.data_recipes.harvest.config import HarvestConfig

if __name__ == "__main__":
    harvest(sys.argv[1], scenes=8, seed=2, config=HarvestConfig(cubes=12), fit=False)
"""


@pytest.mark.slow
def test_a_killed_harvest_goes_on_to_the_same_bytes(tmp_path, whole_bytes):
    script, out = tmp_path / "killed.py", tmp_path / "out"
    script.write_text(KILLED, encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script), str(out)]) as run:
        deadline = time.monotonic() + 120
        while not (out / "scene-00001").exists() and time.monotonic() < deadline and run.poll() is None:
            time.sleep(0.002)
        run.send_signal(signal.SIGKILL)
    assert run.returncode == -signal.SIGKILL
    config = HarvestConfig(cubes=12)
    time.sleep(1.0)  # its worker ends a moment after it
    survivors = {path.name: path.stat().st_mtime_ns for path in out.glob("scene-?????")}
    assert 2 <= len(survivors) < 8
    assert harvest(out, scenes=8, seed=2, config=config, fit=False) == 8 * config.cubes
    assert {name: (out / name).stat().st_mtime_ns for name in survivors} == survivors
    assert harvest(tmp_path / "whole", scenes=8, seed=2, config=config, fit=False, workers=2) == 8 * config.cubes
    assert whole_bytes(out) == whole_bytes(tmp_path / "whole")


def test_a_scene_that_is_there_is_not_made_again(tmp_path):
    """As after the death of a worker, when the answers of the other ones are lost."""
    stamps = set()
    for _ in range(2):
        assert module._work(str(tmp_path), 3, 5, TINY, False, None) == (5, "")
        stamps.add((tmp_path / "scene-00005" / "manifest.json").stat().st_mtime_ns)
    assert len(stamps) == 1


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
        ({"kinds": ("dense", "splat")}, r"kinds must be different ones of dense, hash, mlp, got .*splat"),
        ({"kinds": ("hash", "hash")}, "kinds must be different ones"),
        ({"kinds": (), "shares": ()}, "kinds must be different ones"),
        ({"kinds": ("mlp",)}, r"shares must be one finite number > 0 for each of \('mlp',\), got \(0.6, 0.4\)"),
        ({"shares": (1.0, 0.0)}, "shares must be one finite number > 0"),
        ({"observer_width": 3}, "observer_photos must be >= 0 and observer_width >= 4, got 16 and 3"),
        ({"cubes": 0}, "rays and cubes must be >= 1, got 1152 and 0"),
    ],
)
def test_bad_configs_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        HarvestConfig(**arguments)
