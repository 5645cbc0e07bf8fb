"""Parts of benchmarks/two_trajectory.py: what its tables say, and each method on a scene of a few pixels."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
PARTS = ("fit_cache", "trajectory_scenes", "trajectory_job", "trajectory_rivals", "trajectory_methods",
         "trajectory_ablation", "trajectory_tables", "trajectory_page", "two_trajectory")  # fmt: skip


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return {name: importlib.import_module(name) for name in PARTS}


def cell(method, scene, coverage, curve, **values):
    points = [
        {"coverage": c, "psnr": p, "ssim": None, "disparity_mae": None, "normal_mean_deg": None} for c, p in curve
    ]
    return {"table": "main", "scene": scene, "seed": 0, "method": method, "convention": "proper", "coverage": coverage,
            "curve": points, **values}  # fmt: skip


def test_scores_at_equal_coverage_by_hand(bench):
    cells = [
        cell("field", "c", 0.8, [(0.8, 99.0)], psnr=99.0),  # not finished: bold is missing
        cell("pseudo-gt", "a", 0.1, [(0.1, 40.0)], psnr=40.0),  # the reference does not lower the bar
        cell("field", "a", 0.8, [(0.8, 18.0), (0.6, 20.0), (0.4, 21.0)], psnr=18.0),
        cell("bold", "a", 0.5, [(0.5, 19.0), (0.4, 22.0)], psnr=19.0),
        cell("bold @ 0.9", "a", 0.2, [(0.2, 30.0)], psnr=30.0),  # another setting of a knob does not either
        cell("bold @ 0.9", "b", 0.2, [(0.2, 30.0)], psnr=30.0),
        cell("field", "b", 0.7, [(0.7, 10.0), (0.3, 14.0)], psnr=10.0),
        cell("bold", "b", 0.3, [(0.3, 13.0)], psnr=None),
    ]
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows(cells)}
    # a: at .5, field is half way between 20 and 21; b: at .3, field has 14
    assert rows["field"]["psnr_at_coverage"] == pytest.approx((20.5 + 14.0) / 2)
    assert rows["bold"]["psnr_at_coverage"] == pytest.approx((19.0 + 13.0) / 2)
    assert rows["field"]["at_coverage"] == pytest.approx(0.4)
    assert rows["field"]["psnr"] == pytest.approx(14.0)
    assert rows["bold"]["psnr"] == 19.0  # what is undefined is left out, never a NaN
    assert rows["pseudo-gt"]["psnr_at_coverage"] is None
    assert rows["field"]["psnr_at_0.4"] == pytest.approx((21.0 + 13.0) / 2)
    assert rows["field"]["ssim_at_coverage"] is None
    json.dumps(list(rows.values()), allow_nan=False)
    turned = cell("bold @ 0.5", "a", 0.6, [(0.6, 25.0), (0.4, 27.0)], psnr=25.0)
    other = cell("bold @ 0.5", "b", 0.2, [(0.2, 1.0)], psnr=1.0)
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows([*cells, turned, other])}
    assert rows["bold"]["psnr_at_coverage"] == pytest.approx((26.0 + 13.0) / 2)  # at its best setting
    assert rows["field"]["psnr_at_coverage"] == pytest.approx((20.5 + 14.0) / 2)


@pytest.fixture
def stage(bench, monkeypatch):
    """A tiny room and a barely trained field of it."""
    scenes, main = bench["trajectory_scenes"], bench["two_trajectory"]
    monkeypatch.setattr(scenes, "POINTS", 4000)
    monkeypatch.setattr(scenes, "FEWEST_SEEN", 0.0)
    # a field that has hardly been trained puts everything far away
    monkeypatch.setattr(scenes.TrajectoryScene, "extent", scenes.SceneExtent(limit=60.0, unit=1.0))
    scene = scenes.synthetic_scene(2026, "room-1", photos=4, views=2, width=24, resolution=24)
    pseudo = scene.pseudo(lambda cameras: np.zeros(0))
    return main.Stage(scene, pseudo, scene.truth(pseudo), 20, 2)


@pytest.mark.slow
def test_every_method_runs_and_a_run_goes_on_where_it_was_broken_off(bench, stage, tmp_path, monkeypatch):
    main, methods, rivals = bench["two_trajectory"], bench["trajectory_methods"], bench["trajectory_rivals"]
    monkeypatch.setattr(rivals, "FREE_POINTS", 500)
    monkeypatch.setattr(rivals, "SPARSITY_POINTS", 500)
    monkeypatch.setattr(methods, "UNCERTAINTY_THRESHOLDS", (0.9, 1.0))
    monkeypatch.setattr(methods, "STRENGTHS", (0.5,))
    options = main.Options(seeds=(0,), fit_steps=8, steps=2, out=tmp_path, cache=tmp_path / "cache", threads=1)
    cache, ledger = main.FitCache(options.cache), main.Ledger(options)

    def run(steps_options, table):
        plan = main.Plan([*table], dict.fromkeys(table, 1.0))
        main.run_stage(steps_options, stage, cache, ledger, plan)

    run(options, options.methods)
    done = {row["method"]: row for row in ledger.cells}
    assert set(options.methods) <= set(done)
    assert done["bayes-rays @ 1"]["coverage"] >= done["bayes-rays"]["coverage"]
    assert all(row["convention"] == "proper" for row in done.values())
    assert done["visibility"]["trained_steps"] == 2
    assert done["clean"]["trained_steps"] == 0
    stored = json.loads((tmp_path / "two_trajectory.json").read_text())
    assert {row["method"] for row in stored["rows"]} == set(done)
    assert "NaN" not in (tmp_path / "two_trajectory.json").read_text()
    assert done["field"]["coverage"] > 0.1
    monkeypatch.setattr(bench["trajectory_page"].sys, "argv", ["", str(ledger.path)])
    bench["trajectory_page"].main()
    assert (tmp_path / "two_trajectory.png").stat().st_size > 10_000
    text = (tmp_path / "README.md").read_text()
    assert "we win" in text or "we lose" in text
    assert "| room-1 | 4 | 2 |" in text  # the scene and its photos
    assert all(f"| {method} |" in text for method in options.methods)

    again = main.Ledger(options)
    monkeypatch.setattr(main, "fitted", lambda *ignored: pytest.fail("a finished row was done again"))
    main.run_stage(options, stage, cache, again, main.Plan([*options.methods], dict.fromkeys(options.methods, 1.0)))
    assert len(again.cells) == len(ledger.cells)


@pytest.mark.slow
def test_the_ablation_and_equal_seconds_run(bench, stage, tmp_path, monkeypatch):
    main = bench["two_trajectory"]
    options = main.Options(
        seeds=(0,), fit_steps=8, steps=2, out=tmp_path, cache=tmp_path / "c", threads=1, ablation=True
    )
    cache, ledger = main.FitCache(options.cache), main.Ledger(options)
    table = [*bench["trajectory_ablation"].ABLATION]
    main.run_stage(options, stage, cache, ledger, main.Plan(table, dict.fromkeys(table, 1.0)))
    assert {row["method"] for row in ledger.cells} == set(table)
    assert {row["table"] for row in ledger.cells} == {"ablation"}

    seconds = main.Options(seeds=(0,), methods=("field",), out=tmp_path, cache=tmp_path / "c", equal_seconds=True)
    with pytest.raises(ValueError, match="do the main table of room-1 first"):
        main.run_stage(seconds, stage, cache, main.Ledger(seconds), main.Plan(["field"], {"field": 1.0}))


def test_scenes_are_named_by_what_they_are(bench):
    with pytest.raises(ValueError, match="scene 1 of seed 2026 is room-1, not objects-1"):
        bench["trajectory_scenes"].synthetic_scene(2026, "objects-1", photos=3, views=2, width=12)


def test_unseen_patches_lie_between_the_cameras(bench):
    from unghost.core.cameras import Cameras
    from unghost.fields.scenes import look_at

    origins = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    cameras = Cameras.create(look_at(origins, np.zeros((2, 3))), np.array([16.0, 16.0, 12.0, 9.0]), 24, 18)
    starts, towards = bench["trajectory_rivals"].unseen_patches(cameras, np.random.default_rng(0), 5, 8)
    assert starts.shape == towards.shape == (5, 8, 8, 3)
    np.testing.assert_allclose(towards.norm(dim=-1).numpy(), 1.0, atol=1e-6)
    assert (starts == starts[:, :1, :1]).all()  # one camera a patch
    gap = towards[:, 1:, 1:] - towards[:, :-1, :-1]
    assert 0 < float(gap.norm(dim=-1).max()) < 0.2  # neighbouring rays
