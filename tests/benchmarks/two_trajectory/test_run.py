"""Parts of benchmarks/two_trajectory/run.py: what its tables say, and each method on a scene of a few pixels."""

import dataclasses
import functools
import importlib
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short, refusal
from unghost_tests.depth_points import depth_points

from unghost.regularizer.settings import RegularizerSettings

ROOT = Path(__file__).parents[3]
PARTS = {
    "fit_cache": "benchmarks.fit_cache",
    "two_trajectory": "benchmarks.two_trajectory.run",
    **{
        f"trajectory_{name}": f"benchmarks.two_trajectory.{name}"
        for name in ("scenes", "job", "rivals", "methods", "ablation", "scores", "tables", "page")
    },
}


@pytest.fixture
def bench():
    return {name: importlib.import_module(module) for name, module in PARTS.items()}


def cell(method, scene, coverage, own, spread=None, photos=None, **values):
    """A finished row; each curve is [(coverage, PSNR), …]."""
    curves = {"own": own, "spread": spread or own, "photos": photos}
    columns = {
        order: {
            "coverage": [c for c, _ in points],
            "psnr": [p for _, p in points],
            "disparity_mae": [None] * len(points),
        }
        for order, points in curves.items()
        if points
    }
    return {
        "table": "main",
        "scene": scene,
        "seed": 0,
        "method": method,
        "convention": "proper",
        "coverage": coverage,
        "curves": columns,
        **values,
    }


def test_scores_at_equal_coverage_by_hand(bench):
    cells = [
        cell("field", "c", 0.8, [(0.8, 99.0)], psnr=99.0),  # not finished: bold is missing
        cell("pseudo-gt", "a", 0.1, [(0.1, 40.0)], psnr=40.0),  # the reference does not lower the bar
        cell("field", "a", 0.8, [(0.8, 18.0), (0.6, 20.0), (0.4, 21.0)], psnr=18.0),
        cell("bold", "a", 0.5, [(0.5, 19.0), (0.4, 22.0)], photos=[(0.5, 24.0)], psnr=19.0),
        cell("bold @ 0.9", "a", 0.2, [(0.2, 30.0)], psnr=30.0),  # another setting of a knob does not either
        cell("bold @ 0.9", "b", 0.2, [(0.2, 30.0)], psnr=30.0),
        cell("field", "b", 0.7, [(0.7, 10.0), (0.3, 14.0)], psnr=10.0),
        cell("bold", "b", 0.3, [(0.3, 13.0)], [(0.3, 11.0)], psnr=None, ause={"own": 0.5, "spread": 0.25}),
    ]
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows(cells)}
    # a: at .5, field is half way between 20 and 21; b: at .3, field has 14
    assert rows["field"]["psnr_at_coverage"] == pytest.approx((20.5 + 14.0) / 2)
    assert rows["bold"]["psnr_at_coverage"] == pytest.approx((19.0 + 13.0) / 2)
    assert rows["bold"]["psnr_at_coverage_by_spread"] == pytest.approx((19.0 + 11.0) / 2)
    assert rows["bold"]["psnr_at_coverage_at_best"] == pytest.approx((24.0 + 13.0) / 2)
    assert rows["bold"]["psnr_at_coverage_by_photos"] == 24.0
    assert (rows["bold"]["ause"], rows["bold"]["ause_by_spread"], rows["bold"]["ause_by_photos"]) == (0.5, 0.25, None)
    assert rows["field"]["at_coverage"] == pytest.approx(0.4)
    assert rows["field"]["psnr_area"] is None  # no curve goes down to .1
    assert rows["field"]["psnr"] == pytest.approx(14.0)
    assert rows["bold"]["psnr"] == 19.0  # what is undefined is left out, never a NaN
    assert rows["pseudo-gt"]["psnr_at_coverage"] is None
    assert rows["field"]["psnr_at_0.4"] == pytest.approx((21.0 + 13.0) / 2)
    assert rows["field"]["ssim_at_coverage"] is None
    assert rows["field"]["disparity_mae_at_coverage"] is None
    json.dumps(list(rows.values()), allow_nan=False)
    turned = cell("bold @ 0.5", "a", 0.6, [(0.6, 25.0), (0.4, 27.0)], psnr=25.0)
    other = cell("bold @ 0.5", "b", 0.2, [(0.2, 1.0)], psnr=1.0)
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows([*cells, turned, other])}
    assert rows["bold"]["psnr_at_coverage"] == pytest.approx((19.0 + 13.0) / 2)  # its own setting
    assert rows["bold"]["psnr_at_coverage_at_best"] == pytest.approx((26.0 + 13.0) / 2)
    assert rows["field"]["psnr_at_coverage"] == pytest.approx((20.5 + 14.0) / 2)
    apart = bench["trajectory_tables"].per_scene(cells, ("bold", "field"), "psnr_at_coverage")
    assert apart == {"bold": {"a": 19.0, "b": 13.0}, "field": {"a": 20.5, "b": 14.0}}


def test_seeds_on_which_no_knob_was_turned_count(bench):
    knob = cell("bold @ 0.9", "a", 0.2, [(0.2, 30.0)], psnr=30.0)
    both = [cell(method, "a", 0.5, [(0.5, 20.0)], psnr=20.0) for method in ("bold", "field")]
    other = [{**each, "seed": 1, "psnr": 30.0} for each in both]
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows([*both, knob, *other])}
    assert (rows["bold"]["runs"], rows["bold"]["psnr"], rows["bold @ 0.9"]["runs"]) == (2, 25.0, 1)
    assert len(bench["trajectory_tables"].finished([*both, knob, *other[:1]])) == 3  # field is missing on seed 1
    elsewhere = [{**each, "scene_seed": 555, "coverage": 0.1} for each in both]
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows([*both, *elsewhere])}
    assert rows["bold"]["at_coverage"] == pytest.approx(0.5)  # no bar is shared with another scene of that name


def test_tables_have_one_order_whatever_was_run_first(bench):
    tables, methods = bench["trajectory_tables"], bench["trajectory_methods"].METHODS
    assert set(tables.COLORS) == {tables.REFERENCE, *methods}
    names = ("other", "clean @ 0.3", "field", "clean", "pseudo-gt", "bayes-rays")
    cells = [cell(name, "a", 0.5, [(0.5, 20.0)], psnr=20.0) for name in names]
    cells = [{**cells[2], "table": "ablation"}, *cells]
    in_order = ["pseudo-gt", "field", "bayes-rays", "clean @ 0.3", "clean", "other", "field"]
    assert [row["method"] for row in tables.summary_rows(cells)] == in_order


def test_a_run_with_less_coverage_than_curves_reach_counts_for_nobody(bench):
    cells = [
        cell("field", "a", 0.8, [(0.8, 18.0), (0.1, 21.0)]),
        cell("bold", "a", 0.05, [(0.05, 30.0)]),
        cell("field", "b", 0.8, [(0.8, 18.0), (0.1, 20.0)]),
        cell("bold", "b", 0.1, [(0.1, 25.0)]),
        cell("field", "c", 0.8, [(0.8, 18.0), (0.1, 20.0)]),
        cell("bold", "c", 0.0, []),
    ]
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows(cells)}
    assert (rows["field"]["psnr_at_coverage"], rows["bold"]["psnr_at_coverage"]) == (20.0, 25.0)  # of b alone


def test_area_by_hand(bench):
    cells = [
        cell("field", "a", 0.5, [(0.5, 10.0), (0.3, 12.0), (0.1, 20.0)], [(0.5, 10.0), (0.1, 14.0)]),
        cell("bold", "a", 0.3, [(0.3, 11.0), (0.05, 11.0)]),
    ]
    rows = {row["method"]: row for row in bench["trajectory_tables"].summary_rows(cells)}
    assert rows["field"]["psnr_area"] == pytest.approx(16.0)  # from .1 to .3
    assert rows["field"]["psnr_area_by_spread"] == pytest.approx((14.0 + 12.0) / 2)
    assert rows["bold"]["psnr_area"] == pytest.approx(11.0)


@pytest.mark.parametrize(
    ("ours", "rival", "said"),
    [
        ((20.0, 22.0, 24.0) * 2, (19.0, 20.0, 23.5) * 2, "we win"),
        ((19.0, 20.0, 23.5) * 2, (20.0, 22.0, 24.0) * 2, "we lose"),
        ((20.0, 20.0, 26.0) * 2, (19.0, 21.0, 24.0) * 2, "we win, within chance"),
        ((20.0, 22.0, 24.0) * 2, (20.0, 22.0, 24.0) * 2, "a tie"),
        ((20.0, 22.0), (19.0, 20.0), "we win, on 2 scenes: too few to tell"),
        ((20.0,), (21.0,), "we lose, on 1 scene: too few to tell"),
    ],
)
def test_the_verdict_counts_scenes_not_means(bench, ours, rival, said):
    page, cells = bench["trajectory_page"], []
    for scene, first, second in zip("abcdef", ours, rival):
        cells += [cell("clean", scene, 0.5, [(0.5, first)]), cell("field", scene, 0.5, [(0.5, second)])]
    rows = bench["trajectory_tables"].summary_rows(cells)
    short, _, _, _, line = page.who_wins({"rows": rows, "cells": cells})
    assert short == f"- **{said[0].upper()}{said[1:]}**: masked PSNR at equal coverage."
    assert line.startswith(f"| masked PSNR at equal coverage | **{said}** | `clean` ")
    assert f"| `field` {np.mean(rival):.2f} dB |" in line


def test_an_order_that_all_have_is_nobodys_own(bench):
    page, cells = bench["trajectory_page"], []
    for scene in "abcdef":
        cells += [
            cell(method, scene, 0.5, [(0.5, 20.0), (0.1, score)], photos=[(0.5, 20.0), (0.1, score)])
            for method, score in (("photo-doubt", 30.0), ("clean", 24.0), ("fitted", 30.0))
        ]
    rows = bench["trajectory_tables"].summary_rows(cells)
    lines = page.who_wins({"rows": rows, "cells": cells})
    own, photos = (
        next(line for line in lines if line.startswith(f"| masked PSNR, {name} |"))
        for name in ("mean over equal coverages", "mean, all cut by photo doubt")
    )
    assert "| `photo-doubt` 25.00 dB | `fitted` 25.00 dB |" in own
    assert "| **we lose** | `clean` 22.00 dB | `fitted` 25.00 dB | -3.00 (-3.00 to -3.00) |" in photos


@pytest.fixture
def stage(bench, monkeypatch):
    """A tiny room and a barely trained field of it."""
    scenes = bench["trajectory_scenes"]
    monkeypatch.setattr(scenes, "POINTS", 4000)
    monkeypatch.setattr(scenes, "FEWEST_SEEN", 0.0)
    # a field that has hardly been trained puts everything far away
    monkeypatch.setattr(scenes.TrajectoryScene, "extent", scenes.SceneExtent(limit=60.0, unit=1.0))
    scene = scenes.synthetic_scene(2026, "room-1", photos=4, views=2, width=24, resolution=24)
    scene = dataclasses.replace(scene, points=depth_points(scene))
    pseudo = scene.pseudo(lambda cameras: np.zeros(0))
    return bench["trajectory_scores"].Stage(scene, pseudo, scene.truth(pseudo), 20, 2)


@pytest.mark.slow
def test_every_method_runs_and_a_run_goes_on_where_it_was_broken_off(bench, stage, tmp_path, monkeypatch):
    main, methods, rivals = bench["two_trajectory"], bench["trajectory_methods"], bench["trajectory_rivals"]
    monkeypatch.setattr(rivals, "FREE_POINTS", 500)
    monkeypatch.setattr(rivals, "SPARSITY_POINTS", 500)
    monkeypatch.setattr(methods, "UNCERTAINTY_THRESHOLDS", (1.0, 0.9))
    monkeypatch.setattr(methods, "STRENGTHS", (0.5, 0.1))
    careful = bench["trajectory_job"].Weights(bayes_rays=1.0)  # of so poor a field all is uncertain
    monkeypatch.setattr(main, "Job", functools.partial(main.Job, weights=careful))
    options = main.Options(seeds=(0,), fit_steps=8, steps=2, out=tmp_path, cache=tmp_path / "cache", threads=1)
    cache, ledger = main.FitCache(options.cache), main.Ledger(options)

    def run(steps_options, table):
        plan = main.Plan([*table], dict.fromkeys(table, 1.0))
        main.run_stage(steps_options, stage, cache, ledger, plan)

    run(options, options.methods)
    done = {row["method"]: row for row in ledger.cells}
    assert set(options.methods) <= set(done)
    assert done["bayes-rays @ 0.9"]["coverage"] <= done["bayes-rays"]["coverage"]
    assert all(row["convention"] == "proper" for row in done.values())
    assert done["visibility"]["trained_steps"] == 2
    assert done["dsds-restoration"]["seconds"] > 0 < done["dsds-restoration"]["cpu_seconds"]
    assert done["fitted"]["coverage"] == done["bayes-rays"]["coverage"]
    assert done["photo-doubt"]["psnr"] == done["fitted"]["psnr"]
    assert done["photo-doubt"]["seconds"] > 0 == done["fitted"]["seconds"]
    for method in options.methods:
        curves = done[method]["curves"]
        assert {"own", "spread", "photos"} == set(curves)
        assert len({tuple(each["coverage"]) for each in curves.values()}) == 1
        assert (curves["own"] != curves["spread"]) == (
            method in ("photo-doubt", "scratch+all")
            or any(part in method for part in ("bayes", "clean", "restor", "once", "sight-lines"))
        )
    assert {"own", "spread"} == set(done["bayes-rays @ 0.9"]["curves"])
    assert done["clean"]["trained_steps"] == 0
    assert done["scratch"]["psnr"] == done["fitted"]["psnr"]
    assert done["scratch"]["trained_steps"] == done["scratch+all"]["trained_steps"] == stage.fit_steps
    assert done["scratch"]["seconds"] > 0
    trained = [row for row in done.values() if row["trained_steps"] and row["method"] != "scratch"]
    assert all(row["changed_share"] > 0 for row in trained if "@" not in row["method"])
    assert done["fitted"]["changed_share"] == done["scratch"]["changed_share"] == 0
    with_points = {name for name, row in done.items() if row.get("points")}
    assert with_points == set(methods.WITH_POINTS)
    keys = ("psnr_visible", "free_space_error", "disparity_mae")
    apart = {name: [done[name][key] for key in keys] for name in ("visibility", *methods.WITH_POINTS)}
    assert [name for name in apart if apart[name] == apart["visibility"]] == ["visibility"]  # each does something
    stored = json.loads((tmp_path / "two_trajectory.json").read_text())
    assert all(done[method]["curves"]["own"]["coverage"][0] == done[method]["coverage"] for method in options.methods)
    assert {row["method"] for row in stored["rows"]} == set(done)
    assert "NaN" not in (tmp_path / "two_trajectory.json").read_text()
    assert done["field"]["coverage"] > 0.1
    monkeypatch.setattr(bench["trajectory_page"].sys, "argv", ["", str(ledger.path)])
    bench["trajectory_page"].main()
    assert (tmp_path / "two_trajectory.png").stat().st_size > 10_000
    text = (tmp_path / "README.md").read_text()
    assert "## At equal coverage" in text
    assert "masked PSNR, mean over equal coverages" in text
    assert "| room-1 | 0 | 4 | 2 |" in text  # the scene, its seeds and its photos
    assert all(f"| {method} |" in text for method in options.methods)

    again = main.Ledger(options)
    monkeypatch.setattr(main, "fitted", lambda *ignored: pytest.fail("a finished row was done again"))
    main.run_stage(options, stage, cache, again, main.Plan([*options.methods], dict.fromkeys(options.methods, 1.0)))
    assert len(again.cells) == len(ledger.cells)


def test_a_row_with_other_factors_takes_the_place_of_the_old_one(bench, tmp_path):
    main = bench["two_trajectory"]
    ledger = main.Ledger(main.Options(out=tmp_path, cache=tmp_path))
    row = {"table": "main", "scene": "a", "seed": 0, "convention": "proper", "coverage": 0.5}
    old = ("tv", "tv @ 0.3", "tv @ 0.5", "field")
    ledger.add([{**row, "method": name, "psnr": 20.0, "factor": [0.1, 0.2]} for name in old])
    ledger.add([{**row, "method": name, "psnr": 30.0, "factor": [0.1, 0.3]} for name in ("tv", "tv @ 0.3")])
    ledger.add([{**row, "method": "tv", "seed": 1, "psnr": 40.0, "factor": [0.1, 0.3]}])
    ledger.add([{**row, "method": "field", "psnr": 50.0, "factor": [0.1, 0.2]}])  # the same once more: both stay
    found = [(cell["method"], cell["seed"], cell["psnr"]) for cell in ledger.cells]
    assert sorted(found) == [
        ("field", 0, 20.0),
        ("field", 0, 50.0),
        ("tv", 0, 30.0),
        ("tv", 1, 40.0),
        ("tv @ 0.3", 0, 30.0),
    ]


def test_pairs_of_sweeps(bench, tmp_path, monkeypatch, capsys):
    main = bench["two_trajectory"]
    folder = tmp_path / "a:b"
    options = main.Options(capture=folder, train="one", eval="two", capture_pairs=(f"{folder}:two:one",))
    assert options.pairs() == [(folder, "one", "two"), (folder, "two", "one")]
    with pytest.raises(ValueError, match="--capture-pairs: must be FOLDER:TRAIN:EVAL each, got room:one"):
        main.Options(capture_pairs=("room:one",)).pairs()
    assert "no nowhere" in refusal(main, monkeypatch, capsys, "--capture-pairs", "nowhere:one:two")


def test_pairs_of_one_capture_count_as_one(bench):
    tables, page = bench["trajectory_tables"], bench["trajectory_page"]
    scores = {"room-0": (1.0, 0.0), "plush a to b at 1:8": (2.0, 0.0), "plush b to a at 1:8": (6.0, 0.0)}
    cells = [
        cell(method, scene, 0.5, [(0.5, value)], psnr=value)
        for scene, values in scores.items()
        for method, value in zip(("clean", "field"), values)
    ]
    rows = {row["method"]: row for row in tables.summary_rows(cells)}
    assert rows["clean"]["psnr"] == (1.0 + (2.0 + 6.0) / 2) / 2
    assert rows["clean"]["runs"] == 3
    apart = page.difference(cells, "clean", "field", "psnr", 1)
    assert (apart.mean, apart.count) == (2.5, 2)
    text = page.scenes_page({"cells": cells, "rows": tables.summary_rows(cells)})
    assert "| method | plush a to b at 1:8 | plush b to a at 1:8 | room-0 |" in text
    assert "| clean | 2.00 | 6.00 | 1.00 |" in text


def test_processes_share_the_file(bench, tmp_path):
    main = bench["two_trajectory"]
    two, one = (main.Options(out=tmp_path, cache=tmp_path, threads=threads) for threads in (2, 1))
    first, second = main.Ledger(two), main.Ledger(one)  # both have read an empty file
    row = {"table": "main", "scene": "a", "method": "field", "convention": "proper", "coverage": 0.5}
    first.add([{**row, "seed": 0, "seconds": 3.0, "psnr": 20.0}])
    second.add([{**row, "seed": 1, "seconds": 9.0, "psnr": 30.0}])
    stored = importlib.import_module("benchmarks.two_trajectory.compact").read_expanded(first.path)
    assert [(cell["seed"], cell["threads"]) for cell in stored["cells"]] == [(0, 2), (1, 1)]
    (mean,) = stored["rows"]
    assert (mean["runs"], mean["psnr"], mean["seconds"]) == (2, 25.0, 3.0)


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

    wanted = ("pseudo-gt", "fitted", "field", "bayes-rays")
    seconds = main.Options(
        seeds=(0,), fit_steps=8, methods=wanted, out=tmp_path, cache=tmp_path / "c", threads=1, equal_seconds=True
    )
    assert seconds.names() == ("field",)
    assert "pseudo-gt" in options.methods
    assert "pseudo-gt" not in main.Options().names(seed=1)
    with pytest.raises(ValueError, match="do the main table of room-1 first"):
        main.run_stage(seconds, stage, cache, main.Ledger(seconds), main.Plan(["field"], {"field": 1.0}))
    ledger = main.Ledger(seconds)
    took = [
        {
            "table": "main",
            "scene": "room-1",
            "seed": seed,
            "method": "visibility",
            "convention": "proper",
            "coverage": 0.5,
            "seconds": each,
        }
        for seed, each in enumerate((0.2, 0.4, 9.0))
    ]
    ledger.add(took)
    elsewhere = main.Ledger(main.Options(out=tmp_path, cache=tmp_path / "c", threads=2))
    elsewhere.add([{**took[0], "seconds": 500.0}])  # on another number of threads: no yardstick
    ledger.read()
    main.run_stage(seconds, stage, cache, ledger, main.Plan(["field"], {"field": 1.0}))
    found = ledger.cells[-1]
    assert (found["table"], found["method"]) == ("equal seconds", "field")
    assert 0.3 < found["seconds"] < 3.0  # the median, and the step that was under way


def test_of_factors_that_cost_no_psnr_the_best_disparity_is_taken(bench):
    sweep = importlib.import_module("benchmarks.two_trajectory.sweep")
    tried = (
        ("tv", "a", 20.0, 0.3),
        ("tv", "b", 19.95, 0.2),
        ("tv", "c", 19.8, 0.1),
        ("sparsity", "a", 20.0, 0.3),
        ("sparsity", "b", 19.0, 0.2),
        ("bayes_rays", "a", None, None),  # left no pixel to score
    )
    rows = [
        {"table": loss, "method": name, "psnr_at_coverage": psnr, "disparity_mae_at_coverage": disparity}
        for loss, name, psnr, disparity in tried
    ]
    assert sweep.chosen_factors(rows) == {"tv": "b", "sparsity": "a"}


def test_the_factors_are_those_that_the_sweep_chose(bench):
    stored = json.loads((ROOT / "docs" / "results" / "two_trajectory_sweep.json").read_text())
    chosen = {row["table"]: float(row["method"].split()[1]) for row in stored["rows"] if row.get("chosen")}
    weights, sweep = bench["trajectory_job"].Weights(), importlib.import_module("benchmarks.two_trajectory.sweep")
    assert chosen == {factor: getattr(weights, factor) for factor in sweep.FACTORS if factor in chosen}
    assert set(sweep.FACTORS) - set(chosen) <= set(sweep.POINT_LOSSES)  # those were added before anybody swept them


def test_every_factor_is_swept_by_a_method_that_depends_on_it(bench):
    sweep, methods = importlib.import_module("benchmarks.two_trajectory.sweep"), bench["trajectory_methods"]
    fields = {field.name for field in dataclasses.fields(bench["trajectory_job"].Weights)}
    assert set(sweep.FACTORS) == fields == {name for names in methods.FACTORS_OF.values() for name in names}
    assert set(methods.FACTORS_OF) <= set(methods.METHODS)
    assert sweep.swept_by("tv") == "visibility+tv"
    assert sweep.swept_by("sight_lines") == sweep.swept_by("end_points") == "visibility+sight-lines"
    assert all(sweep.swept_by(name) in methods.WITH_POINTS for name in sweep.POINT_LOSSES)


def test_our_sight_lines_weigh_as_much_as_by_default(bench):
    weights = bench["trajectory_job"].Weights()
    defaults = RegularizerSettings()
    assert (weights.sight_lines, weights.end_points) == (defaults.sight_line_weight, defaults.end_point_weight)


def test_every_eighth_photo_is_judged_from_where_it_was_taken(bench, monkeypatch):
    scenes = bench["trajectory_scenes"]
    monkeypatch.setattr(scenes, "FEWEST_SEEN", 0.0)
    scene = scenes.synthetic_scene(2026, "room-1", photos=9, views=2, width=16, resolution=24).every_nth()
    assert (len(scene.train.photos), len(scene.evaluation.photos)) == (7, 2)
    told, true = scene.evaluation.cameras, scene.again.true_cameras
    assert np.abs(told.origins - true.origins).max() > 0  # what it is told is a little off
    pseudo = scene.pseudo(lambda cameras: np.zeros(0))
    np.testing.assert_array_equal(pseudo.eval_cameras.camera_to_world, true.camera_to_world)
    np.testing.assert_array_equal(pseudo.train_cameras.camera_to_world, scene.photographed.true_cameras.camera_to_world)
    origins, directions = true.rays(1)
    hit = np.isfinite(pseudo.depth[1])
    points = (origins + directions * pseudo.depth[1][..., None])[hit]
    assert np.abs(scene.again.scene.signed_distance(points)).max() < 0.01


def test_scenes_are_named_by_what_they_are(bench):
    with pytest.raises(ValueError, match="scene 1 of seed 2026 is room-1, not objects-1"):
        bench["trajectory_scenes"].synthetic_scene(2026, "objects-1", photos=3, views=2, width=12)


def test_unseen_patches_lie_between_the_cameras(bench):
    from unghost.core.cameras import Cameras, look_at

    origins = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    cameras = Cameras.create(look_at(origins, np.zeros((2, 3))), np.array([16.0, 16.0, 12.0, 9.0]), 24, 18)
    starts, towards = bench["trajectory_rivals"].unseen_patches(cameras, np.random.default_rng(0), 5, 8)
    assert starts.shape == towards.shape == (5, 8, 8, 3)
    np.testing.assert_allclose(towards.norm(dim=-1).numpy(), 1.0, atol=1e-6)
    assert (starts == starts[:, :1, :1]).all()  # one camera a patch
    gap = towards[:, 1:, 1:] - towards[:, :-1, :-1]
    assert 0 < float(gap.norm(dim=-1).max()) < 0.2  # neighbouring rays


def test_short_and_what_is_missing(bench, monkeypatch, capsys):
    check_short(bench["two_trajectory"], scenes=("room-1",), seeds=(0,))
    assert "no nowhere" in refusal(bench["two_trajectory"], monkeypatch, capsys, "--capture", "nowhere")
