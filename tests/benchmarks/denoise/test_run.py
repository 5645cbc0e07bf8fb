"""The reference measurement's parts: classical rivals, scores, the figure's front, the capture's labels."""

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("torch")
pytest.importorskip("tyro")

from unghost_tests.benches import check_short, refusal

from benchmarks.denoise import capture_cubes, channels_study, figure, run, scores, sets, speed
from unghost.baselines import filters
from unghost.core.cameras import Cameras
from unghost.core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL


@pytest.fixture(scope="module")
def parts():
    """The modules of the reference measurement."""
    return {
        "classical": filters,
        "scores": scores,
        "sets": sets,
        "figure": figure,
        "capture": capture_cubes,
        "denoise": run,
        "speed": speed,
        "study": channels_study,
    }


def plate(thick=3):
    cube = np.zeros((32, 32, 32), dtype=bool)
    cube[4:28, 4:28, 14 : 14 + thick] = True
    return cube


def signed(bits):
    return np.where(bits, 1.0, -1.0).astype(np.float32)


def test_filters_on_a_plate_with_a_speck_and_a_hole(parts):
    truth = plate()
    seen = truth.copy()
    seen[2:4, 2:4, 2:4] = True  # 8 voxels of dust
    seen[15, 15, 15] = False
    found = {
        name: parts["classical"].Classical(name)(signed(seen)[None, None], 900, 0.1)[0, 0] > 0
        for name in parts["classical"].Classical.names()
    }
    np.testing.assert_array_equal(found["input"], seen)
    for name in ("largest component", "components", "components+closing"):
        assert not found[name][2:4, 2:4, 2:4].any(), name
    for name in ("closing", "components+closing"):
        assert found[name][15, 15, 15], name
    np.testing.assert_array_equal(found["components+closing"], truth)
    assert found["opening"].sum() < seen.sum()
    for name in ("gaussian", "median", "tv"):
        assert 0.5 < (found[name] & truth).sum() / truth.sum() <= 1.0, name


@pytest.mark.parametrize("name", ["largest component", "components", "opening"])
def test_of_soft_cubes_what_stays_ranks_above_what_goes(parts, name):
    opacity = np.where(plate(), 0.6, 0.02)
    opacity[2:4, 2:4, 2:4] = 0.95
    x0_pred = parts["classical"].Classical(name)((2 * opacity - 1)[None, None].astype(np.float32), 900, 0.1)[0, 0]
    assert x0_pred[10, 10, 15] > 0 > x0_pred[2, 2, 2]
    assert x0_pred.min() >= -1
    assert x0_pred.max() <= 1


def test_decided_puts_the_threshold_at_zero_and_keeps_the_order(parts):
    values = np.linspace(-1, 1, 101, dtype=np.float32)
    bent = parts["classical"].decided(values)
    assert bent[0] == -1
    assert bent[-1] == 1
    assert parts["classical"].decided(np.float32([-0.8]))[0] == pytest.approx(0, abs=1e-6)
    assert (np.diff(bent) > 0).all()
    with pytest.raises(ValueError, match="Classical: name"):
        parts["classical"].Classical("magic")


def test_scores_by_hand(parts):
    """Two cubes of two groups; ten true voxels, six ghosts, four holes."""
    labels = np.full((2, 32, 32, 32), FREE_LABEL, dtype=np.uint8)
    seen = np.full((2, 32, 32, 32), -1.0, dtype=np.float32)
    x0_pred = np.full((2, 32, 32, 32), -1.0, dtype=np.float32)
    labels[0, 0, 0, :14] = SURFACE_LABEL
    seen[0, 0, 0, :10] = 1.0  # ten true, four holes
    seen[0, 5, 5, :6] = 1.0  # six ghosts
    labels[1, 3, 3, 3], seen[1, 3, 3, 3] = IGNORE_LABEL, 1.0
    x0_pred[0, 0, 0, :9] = np.linspace(0.1, 0.9, 9)  # one true voxel lost
    x0_pred[0, 0, 0, 9] = -0.5
    x0_pred[0, 0, 0, 10] = 0.5  # one hole filled
    x0_pred[0, 5, 5, :6] = [-0.9, -0.8, -0.7, -0.6, 0.05, 0.95]
    row = parts["scores"].score(lambda rows: x0_pred[rows], seen, labels, np.array([0, 1], np.int32), batch=1)
    assert (row["cubes"], row["groups"], row["true_voxels"], row["ghost_voxels"]) == (2, 2, 10, 6)
    assert row["floater_recall"] == pytest.approx(4 / 6)
    assert row["surface_kept"] == pytest.approx(0.9)
    assert row["holes_filled"] == pytest.approx(0.25)
    assert row["iou"] == pytest.approx((10 / 16 + 1) / 2)
    assert row["iou_before"] == pytest.approx((10 / 20 + 1) / 2)
    assert row["ghosts_removed_98"] == row["ghosts_removed_95"] == pytest.approx(4 / 6)  # all below -0.5
    assert row["ghosts_removed_90"] == pytest.approx(5 / 6)  # one true voxel may go: those below .1
    assert row["ghosts_removed_98_per_group"] == row["ghosts_removed_98"]


def test_a_set_without_ghosts_has_no_share_of_them(parts):
    labels = np.full((1, 32, 32, 32), SURFACE_LABEL, dtype=np.uint8)
    row = parts["scores"].score(
        lambda rows: np.ones((1, 32, 32, 32)), signed(labels > 0), labels, np.zeros(1, np.int32)
    )
    assert row["floater_recall"] is row["ghosts_removed_98"] is row["holes_filled"] is None
    assert row["surface_kept"] == row["iou"] == 1.0


def test_the_front_is_what_nothing_beats_in_both(parts):
    points = [(100.0, 0.9), (400.0, 0.92), (200.0, 0.95), (800.0, 0.8), (50.0, 0.95)]
    assert parts["figure"].pareto(points) == [2, 1, 3]
    assert parts["figure"].pareto([]) == []


def test_blind_is_the_same_cubes_and_nothing_about_them(parts):
    cubes = parts["sets"].CubeSet(
        "harvest",
        {},
        signed(plate())[None],
        np.zeros((1, 32, 32, 32), np.uint8),
        np.full(1, 0.1, np.float32),
        np.zeros(1, np.int32),
        view_count=np.ones((1, 32, 32, 32), np.uint8),
    )
    blind = parts["sets"].blind(cubes)
    assert parts["sets"].tells_more(cubes)
    assert not parts["sets"].tells_more(blind)
    assert blind.signed is cubes.signed


def test_the_figure_times_a_way_to_use_a_model_by_its_model(parts, tmp_path):
    """Every way to use a model is drawn at the model's speed, the best one named; what has no model is a line."""
    from matplotlib.figure import Figure

    rows = [{"method": "m", "set": "speed", "cubes_per_second": 100.0, "trained": True}]
    rows += [
        {"method": method, "set": "harvest", "ghosts_removed_98": value, **about}
        for method, value, about in (
            ("input", 0.0, {}),
            ("median", 0.1, {}),
            ("m", 0.3, {"model": "m"}),
            ("m, blind", 0.2, {"model": "m"}),
            ("m+noise@50", 0.1, {"model": "m"}),
        )
    ]
    drawn = {}

    class Spy(Figure):
        def savefig(self, *args, **kwargs):
            for axis in self.axes:
                drawn.setdefault("points", []).extend(
                    [tuple(line.get_xydata()[0]) for line in axis.lines if line.get_marker() == "o"]
                )
                drawn.setdefault("texts", []).extend(text.get_text() for text in axis.texts)
            super().savefig(*args, **kwargs)

    from matplotlib import pyplot as plt

    original = plt.figure
    plt.figure = lambda *args, **kwargs: original(*args, FigureClass=Spy, **kwargs)
    try:
        parts["figure"].draw(tmp_path / "figure.png", rows)
    finally:
        plt.figure = original
    assert sorted(drawn["points"]) == [(100.0, 0.1), (100.0, 0.2), (100.0, 0.3)]
    assert set(drawn["texts"]) == {"m", "median (no training)", "input (no training)"}


def test_damage_repeats_and_grows(parts):
    clean = parts["sets"].CubeSet(
        "clean",
        {},
        signed(plate())[None],
        np.where(plate(), SURFACE_LABEL, FREE_LABEL).astype(np.uint8)[None],
        np.full(1, 0.1, np.float32),
        np.zeros(1, np.int32),
    )
    low, again, high = (parts["sets"].damaged(clean, "salt", severity) for severity in (0.1, 0.1, 1.0))
    np.testing.assert_array_equal(low.signed, again.signed)
    changed = [(cubes.signed != clean.signed).sum() for cubes in (low, high)]
    assert 0 < changed[0] < changed[1]
    assert low.about == {"family": "salt", "severity": 0.1}
    assert len(clean.first(0)) == 0


def test_what_is_timed_of_a_model(parts, tmp_path):
    """A file is timed with what lies beside it, but an int8 file's checkpoint is another model."""
    for name in ("a.onnx", "a.safetensors", "b.safetensors", "a.int8.onnx", "shipped.onnx"):
        (tmp_path / name).touch()
    of = parts["speed"].Model.of
    for file, onnx, checkpoint in (
        ("a.onnx", "a.onnx", "a.safetensors"),
        ("a.safetensors", "a.onnx", "a.safetensors"),
        ("a.int8.onnx", "a.int8.onnx", None),
        ("b.safetensors", None, "b.safetensors"),
    ):
        model = of("x", str(tmp_path / file), tmp_path)
        found = [path and path.name for path in (model.scored, model.onnx, model.checkpoint)]
        assert found == [file, onnx, checkpoint]
    assert of("x", "shipped", tmp_path).onnx == tmp_path / "shipped.onnx"


@pytest.mark.slow
def test_a_network_without_weights_has_a_speed_and_says_so(parts, monkeypatch):
    monkeypatch.setattr(parts["speed"], "SECONDS", 0.01)
    monkeypatch.setattr(parts["speed"], "BATCH", 1)
    (row,) = parts["speed"].untrained_rows(("l",), 1)
    assert (row["method"], row["set"], row["trained"]) == ("l", "speed", False)
    assert row["cubes_per_second"] > 0
    assert row["torch_cubes_per_second"] > 0
    assert row["parameters"] > 1e6
    assert not any(key.startswith(("iou", "ghosts")) for key in row)


def test_a_diffusion_is_asked_in_more_ways_than_a_restoration(parts):
    from unghost.core.manifest import Manifest

    class Model:
        kind = "numpy"

        def __init__(self, family):
            self.manifest = Manifest("m", family=family, default_timestep=50)

    ways = parts["denoise"].variants_of
    assert [way[0] for way in ways("r", Model("restoration"), (10, 200))] == ["r"]
    assert [(way[0], way[2]) for way in ways("d", Model("diffusion"), (10, 200))] == [
        ("d", 50),
        ("d@10", 10),
        ("d@200", 200),
    ]


def test_the_study_shows_bits_where_it_says_so_and_keeps_the_truth(parts, tmp_path):
    from unghost.core.occupancy import opacity_from_signed
    from unghost.core.shards.packing import dequantize_signed, pack_labels
    from unghost.core.shards.storage import read_shard, write_shard

    rng = np.random.default_rng(0)
    arrays = {
        "inputs": rng.integers(0, 256, (3, 32, 32, 32), dtype=np.uint8),
        "labels": pack_labels(rng.integers(0, 3, (3, 32, 32, 32)).astype(np.uint8)),
        "severity": np.float32([0.1, 0.2, 0.3]),
        "edge_fraction": np.full(3, 0.1, np.float32),
        "group": np.arange(3, dtype=np.int32),
        "view_count": rng.integers(0, 9, (3, 32, 32, 32), dtype=np.uint8),
    }
    write_shard(tmp_path / "shard", arrays, {"recipe": "by hand"}, kind="harvest")
    study = parts["study"]
    ((path, weight),) = study.bit_shards([(str(tmp_path / "shard"), 0.5)], tmp_path / "bits")
    bits = read_shard(path, verify=True)
    assert weight == 0.5
    assert bits.kind == "harvest"  # the trainer weighs harvested cubes by that
    assert bits.provenance == {"recipe": "by hand"}
    assert set(np.unique(bits.inputs)) == {0, 255}
    opaque = opacity_from_signed(dequantize_signed(arrays["inputs"])) > 0.1
    np.testing.assert_array_equal(np.array(bits.inputs) == 255, opaque)
    np.testing.assert_array_equal(bits.labels, arrays["labels"])
    assert bits.view_count is None
    cubes = parts["sets"].from_shards("harvest", [read_shard(tmp_path / "shard")], 3)
    assert cubes.view_count is not None
    np.testing.assert_array_equal(study.seen(cubes, study.BIT).signed > 0, opaque)
    assert study.seen(cubes, "opacity") is cubes
    assert study.blind(cubes).view_count is None


def test_pseudo_truth_goes_by_the_votes_of_the_photos(parts):
    """Two cameras look along +x at a wall one unit away; a third one looks elsewhere."""
    pose = np.array([[0.0, 0.0, -1.0, -1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    away = pose.copy()
    away[:, :3] = pose[:, :3] @ np.diag([-1.0, 1.0, -1.0])
    cameras = Cameras.create(np.stack([pose, pose, away]), np.array([16.0, 16.0, 16.0, 12.0]), 32, 24)
    depth = np.full((3, 24, 32), 1.0)
    truth = parts["capture"].PseudoTruth(cameras.select([0]), np.array([[-1.0] * 3, [1.0] * 3]), cameras, depth)
    places = np.array([[-0.5, 0, 0], [0.0, 0, 0], [0.05, 0, 0], [0.05, 0, 0], [0.5, 0, 0], [-1.5, 0, 0]])
    opaque = np.array([True, True, True, False, True, True])
    dark = np.zeros(6, dtype=bool)
    labels = truth.labels(places, 0.02, opaque, dark)
    assert truth.labels(places, 0.02, opaque, ~dark)[2] == IGNORE_LABEL
    assert labels.tolist() == [FREE_LABEL, SURFACE_LABEL, SURFACE_LABEL, IGNORE_LABEL, IGNORE_LABEL, IGNORE_LABEL]


def test_bubbles_are_whole_ghosts_clear_of_the_surface(parts):
    from scipy.ndimage import binary_dilation, label

    truth = np.stack([plate(), np.ones((32, 32, 32), bool)])
    clean = parts["sets"].CubeSet(
        "clean",
        {},
        signed(truth),
        np.where(truth, SURFACE_LABEL, FREE_LABEL).astype(np.uint8),
        np.full(2, 0.1, np.float32),
        np.arange(2, dtype=np.int32),
    )
    bits, soft = parts["sets"].bubble_sets(clean)
    bubbles = (bits.signed > 0) & ~truth
    assert 1 <= label(bubbles[0])[1] <= 3
    assert bubbles[0].sum() > 30
    assert not (binary_dilation(truth[0], np.ones((3, 3, 3)), 2) & bubbles[0]).any()
    assert not bubbles[1].any()  # no room
    assert (bits.signed[truth] == 1).all()
    # half way into a body of several voxels, nearly opaque; far from all, nearly clear
    assert soft.signed[0, 10, 10, 15] > 0
    assert soft.signed[0, 0, 0, 0] < -0.9
    assert (soft.labels[0, 10, 10, 12:14] == IGNORE_LABEL).all()  # the plate's skirt
    assert (soft.labels[0][bubbles[0]] == FREE_LABEL).all()
    assert (bits.labels == clean.labels).all()
    again = next(parts["sets"].bubble_sets(clean))
    np.testing.assert_array_equal(bits.signed, again.signed)


def test_short_and_what_is_missing(monkeypatch, capsys, tmp_path):
    check_short(run, cubes=8)
    assert "needs MESHES" in refusal(run, monkeypatch, capsys)
    assert "no nowhere" in refusal(run, monkeypatch, capsys, "--meshes", tmp_path, "--unseen", "nowhere")


def test_without_meshes_the_sets_are_of_procedural_cubes(parts):
    found = list(parts["sets"].mesh_sets(None, 2, 1))
    assert {cubes.name for cubes in found} >= {"clean", "bubbles", "synthetic", "synthetic-soft"}
    assert all(len(cubes) in (1, 2) for cubes in found)
