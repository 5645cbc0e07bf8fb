"""All of benchmarks/two_trajectory/real_capture.py on a capture of a few pixels, with the real field."""

import json

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("torch")

from unghost_tests.benches import refusal

from benchmarks.two_trajectory import real_capture
from unghost.core.manifest import Manifest


class Hollow:
    """A denoiser that calls everything empty."""

    manifest = Manifest(name="hollow", body_sha256="0" * 64)
    kind = "numpy"

    def __call__(self, channels, timestep, edge_fraction):
        return np.full_like(channels[:, :1], -1.0)


@pytest.fixture
def bench(monkeypatch):
    module = real_capture
    monkeypatch.setattr(module, "load_denoiser", lambda name: Hollow())
    monkeypatch.setattr(module, "code_hash", lambda *packages: "this code")
    return module


@pytest.fixture
def capture(tmp_path):
    """Two sweeps of three and two views of a gradient wall."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    frames = []
    for index in range(5):
        pose = np.eye(4)
        pose[:3, 3] = [0.5 * index - 1, 0.2 * (index % 2), 1.5]
        ramp = np.linspace(40, 200, 24)[None] + 10 * index
        photo = np.stack(
            [np.broadcast_to(ramp, (18, 24)), np.full((18, 24), 90), 255 - np.broadcast_to(ramp, (18, 24))]
        )
        Image.fromarray(np.moveaxis(photo, 0, -1).astype(np.uint8)).save(folder / f"{index}.png")
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 20.0, "w": 24, "h": 18, "frames": frames}))
    sweeps = {"one": ["0.png", "2.png", "4.png"], "two": ["1.png", "3.png"], "mixed": ["0.png", "1.png"]}
    (folder / "splits.json").write_text(json.dumps(sweeps))
    return folder


def _options(bench, capture, tmp_path, **changes):
    given = {
        "train": "one",
        "eval": "two",
        "seeds": (0, 1),
        "downscale": 2,
        "steps": 3,
        "finetune_steps": 2,
        "resolution": 16,
        "settings": ("cubes=1", "visibility_samples=64"),
        "out": tmp_path / "out",
        "cache": tmp_path / "cache",
    }
    return bench.Options(capture=capture, **{**given, **changes})


@pytest.mark.slow
def test_a_run_writes_results_and_a_figure_and_is_resumed_from_its_cache(bench, capture, tmp_path, monkeypatch):
    options = _options(bench, capture, tmp_path)
    bench.run(options)
    text = (tmp_path / "out" / "capture.json").read_text()
    results = json.loads(text)
    assert str(tmp_path) not in text  # nobody's paths
    assert [row["method"] for row in results["rows"]] == ["field", "visibility", "dsds"]
    assert results["seeds"] == [0, 1]
    assert results["priors"] == {"dsds": {"name": "hollow", "sha256": "0" * 64}}
    assert results["regularizer"]["cubes"] == 1
    for row in results["rows"]:
        assert {scores["seed"] for scores in row["per_seed"]} == {0, 1}
        assert 3 < row["psnr_visible"] < 60
        assert row["convention"] == "proper"
        assert {"psnr", "psnr_common", "ssim", "disparity_mae", "normal_mean_deg", "coverage"} <= set(row)  # README
        assert "lpips" not in row  # there is no network
        assert 0 <= row["coverage"] <= 1
    with Image.open(tmp_path / "out" / "capture.png") as figure:
        assert figure.width > 600

    trained = []
    original = bench.train_field

    def counted(*args, **kwargs):
        trained.append(kwargs["steps"])
        return original(*args, **kwargs)

    monkeypatch.setattr(bench, "train_field", counted)
    bench.run(options)
    assert trained == []
    assert json.loads((tmp_path / "out" / "capture.json").read_text())["rows"] == results["rows"]
    # other settings: the bases stay, and so does fine-tuning without a regularizer
    changed = ("cubes=2", "visibility_samples=64")
    bench.run(_options(bench, capture, tmp_path, seeds=(0,), settings=changed))
    assert trained == [2] * 2
    # a nearer limit is a matter of scoring alone
    near = bench.run(_options(bench, capture, tmp_path, seeds=(0,), settings=changed, depth_limit=0.1))
    assert [row["coverage"] for row in near["rows"]] == [0.0] * 3
    assert [row["psnr"] for row in near["rows"]] == [None] * 3
    assert trained == [2] * 2


def test_the_cache_knows_what_depends_on_whose_code(bench, capture, tmp_path, monkeypatch):
    options = _options(bench, capture, tmp_path)
    weights, others = ({"dsds": {"name": "hollow", "sha256": sha256}} for sha256 in "01")
    before = {method: bench.tuning_key(options, method, weights) for method in options.methods()}
    same = {method: bench.tuning_key(options, method, others) for method in options.methods()}
    assert [method for method in before if before[method] == same[method]] == ["field", "visibility"]
    monkeypatch.setattr(bench, "code_hash", lambda package: package.__name__.replace("unghost.fields", "this code"))
    after = {method: bench.tuning_key(options, method, weights) for method in options.methods()}
    assert [method for method in before if before[method] == after[method]] == ["field"]


@pytest.mark.slow
def test_methods_start_from_the_same_field_and_differ(bench, capture, tmp_path):
    strong = ("cubes=2", "visibility_samples=64", "dsds_weight=100.0", "visibility_weight=100.0")
    options = _options(bench, capture, tmp_path, seeds=(0,), finetune_steps=4, settings=strong)
    rows = {row["method"]: row for row in bench.run(options)["rows"]}
    assert rows["field"]["psnr_visible"] != rows["visibility"]["psnr_visible"]
    assert rows["dsds"]["psnr_visible"] != rows["visibility"]["psnr_visible"]


@pytest.mark.slow
def test_a_row_for_each_prior(bench, capture, tmp_path):
    options = _options(bench, capture, tmp_path, seeds=(0,), denoisers=("default", "some/views.onnx"))
    assert "--denoisers default views.onnx" in options.command()
    results = bench.run(options)
    assert [row["method"] for row in results["rows"]] == ["field", "visibility", "dsds", "dsds, views"]
    assert set(results["priors"]) == {"dsds", "dsds, views"}


def test_bad_options_are_named_before_anything_is_fitted(bench, capture, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "train_field", lambda *args, **kwargs: pytest.fail("fitted"))
    with pytest.raises(ValueError, match="share photos"):
        bench.run(_options(bench, capture, tmp_path, eval="mixed"))
    with pytest.raises(ValueError, match="no split 'three'; choose from one, two, mixed"):
        bench.run(_options(bench, capture, tmp_path, eval="three"))
    with pytest.raises(ValueError, match=r"--settings: unknown names \['colour'\]; known: chunk, "):
        bench.run(_options(bench, capture, tmp_path, settings=("colour=3",)))
    (capture / "2.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"2\.png"):
        bench.run(_options(bench, capture, tmp_path))
    assert not (tmp_path / "out").exists()


def test_the_command_names_no_folder(bench, capture, tmp_path):
    options = _options(bench, capture, tmp_path)
    assert options.command() == (
        "python -m benchmarks.two_trajectory.real_capture tiny --train one --eval two --seeds 0 1 --downscale 2 "
        "--finetune-steps 2 "
        "--steps 3 --resolution 16 --settings cubes=1 visibility_samples=64"
    )


def test_short_and_what_is_missing(monkeypatch, capsys, capture, tmp_path):
    short = real_capture.Options(capture, short=True).shortened()
    assert {name: getattr(short, name) for name in short.SHORT} == short.SHORT
    assert " --short" in short.command()
    assert "needs CAPTURE" in refusal(real_capture, monkeypatch, capsys)
    assert "no nowhere" in refusal(real_capture, monkeypatch, capsys, "nowhere", "--short")
