import json

import numpy as np
import pytest

from unghost import cli
from unghost.cli import prior as commands
from unghost.core.shards.finding import expand_shards
from unghost.fields.adapters.grids import load_grid, save_grid

VERBS = (
    "demo",
    "clean",
    "masks",
    "capture",
    "convert",
    "evaluate",
    "report",
    "bench",
    "curate",
    "harvest",
    "preview",
    "train",
    "sample",
    "export",
    "verify",
)


@pytest.mark.parametrize("words", [[], *([verb] for verb in VERBS)])
def test_help_reads_well(words, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main([*words, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: unghost {words[0] if words else ''}".rstrip() in text
    if not words:
        assert all(verb in text for verb in VERBS)


@pytest.mark.parametrize("words", [[], ["nope"], ["demo", "--nope"], ["bench", "--batch", "many"]])
def test_wrong_words_exit_with_two(words, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["clean", "absent.npz"], "unghost clean: no file absent.npz"),
        (["clean", "absent.PLY", "--cameras", "absent"], "unghost clean: no file absent.PLY"),
        (["curate", "absent", "--out", "x"], "unghost curate: load_recipe: absent is neither a file"),
        (["curate", "procedural", "--out", "x", "--count", "0"], "unghost curate: --count must be >= 1, got 0"),
        (["train", "absent", "--out", "x"], "unghost train: find_shards: absent is not a shard and holds none"),
        (["train", "absent=much", "--out", "x"], "must be FOLDER or FOLDER=WEIGHT"),
        (["demo", "--seed", "-1"], "unghost demo: "),
        (["bench", "--denoiser", "absent.onnx"], "unghost bench: load_denoiser: no file absent.onnx"),
        (["bench", "--denoiser", "m"], "unghost bench: load_denoiser: no file m.onnx for 'm' (no longer shipped"),
        (["verify", "--onnx", "a.onnx", "--checkpoint", "b.safetensors"], "unghost verify: "),
        (["export", "absent.safetensors"], "unghost export: "),
    ],
)
def test_what_the_user_can_mend_is_one_line(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_our_own_missing_module_is_not_blamed_on_the_user(monkeypatch):
    def broken(out: str = "x") -> None:
        """Break."""
        raise ModuleNotFoundError("No module named 'unghost.gone'", name="unghost.gone")

    monkeypatch.setattr(commands, "demo", broken)
    with pytest.raises(ModuleNotFoundError):
        cli.main(["demo"])


def test_interrupts_are_quiet(monkeypatch, capsys):
    def interrupted() -> None:
        """Stop."""
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "demo", interrupted)
    assert cli.main(["demo"]) == 130
    assert capsys.readouterr().err == "unghost demo: interrupted\n"


def test_curate_writes_shards(tmp_path, capsys):
    assert cli.main(["curate", "procedural", "--out", str(tmp_path / "pairs"), "--count", "3"]) == 0
    assert "3 pairs in 1 shard under" in capsys.readouterr().out
    assert expand_shards(f"{tmp_path / 'pairs'}=2") == [(tmp_path / "pairs" / "shard-00000", 2.0)]


def test_grid_files_round_trip_and_refuse(tmp_path):
    path, box = tmp_path / "g.npz", np.array([[0.0, 0, 0], [1, 2, 3]])
    save_grid(path, np.ones((2, 4, 6)), box)
    density, found = load_grid(path)
    assert density.shape == (2, 4, 6)
    np.testing.assert_array_equal(found, box)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"g\.npz is an \.npz or \.sog archive without its end"):
        load_grid(path)
    np.savez(path, density=np.ones((2, 2, 2)))
    with pytest.raises(ValueError, match="lacks aabb"):
        load_grid(path)
    np.savez(path, density=np.ones(3), aabb=box)
    with pytest.raises(ValueError, match=r"must have shape \(X, Y, Z\), got \(3,\)"):
        load_grid(path)


def test_clean_hands_the_cameras_of_a_transforms_file_on(tmp_path, monkeypatch, capsys):
    from unghost import facade as cleaning
    from unghost.cleaning.keep_mask import KeepMask

    pose = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    frames = [{"file_path": f"{name}.png", "transform_matrix": pose} for name in "ab"]
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 8, "h": 6, "fl_x": 7.0, "frames": frames}))
    aabb = np.array([[0.0, 0, 0], [1, 1, 1]])
    save_grid(tmp_path / "grid.npz", np.ones((4, 4, 4), np.float32), aabb)
    told = []

    def recorder(density_fn, box, *, cameras, **options):
        told.append(cameras)
        details = {"occupied": 64, "removed": 0, "faint_removed": 0, "settings": {}, "regions": [], "region_count": 0}
        return KeepMask(np.asarray(box), 0.25, np.ones((4, 4, 4), bool), details)

    monkeypatch.setattr(cleaning, "clean", recorder)
    assert cli.main(["clean", str(tmp_path / "grid.npz"), "--cameras", str(tmp_path)]) == 0, capsys.readouterr()
    assert cli.main(["clean", str(tmp_path / "grid.npz")]) == 0
    assert len(told[0]) == 2
    assert told[0].origins[0].tolist() == [1, 2, 3]
    assert told[1] is None
