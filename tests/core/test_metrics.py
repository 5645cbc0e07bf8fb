"""Every number that is shown has one label, unit, direction and number of decimals."""

import json
import re
from pathlib import Path

import pytest

from unghost.core.metrics import METRICS, Metric, format_value, get_metric
from unghost.demo.run import SCORES
from unghost.evaluation.metrics.perceptual import LPIPS_CONVENTIONS
from unghost.evaluation.metrics.pixelwise import PSNR_CONVENTIONS, SSIM_CONVENTIONS
from unghost.evaluation.report.rows import TABLE_KEYS
from unghost.evaluation.report.tables import EQUAL_KEYS, OWN_KEYS
from unghost.evaluation.scoring.conventions import CONVENTIONS, PLAIN_CONVENTIONS

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = {  # what a row was asked for or had, not what it scored
    "asked",
    "batch",
    "cameras",
    "edge_fraction",
    "faces",
    "fields",
    "holes",
    "level",
    "lines",
    "observations",
    "places",
    "points",
    "positions",
    "rays",
    "regularized_steps",
    "seed",
    "severity",
    "steps",
    "target",
    "threads",
    "threshold",
    "timestep",
    "workers",
}


def numeric(row):
    return {key for key, value in row.items() if isinstance(value, (int, float)) and not isinstance(value, bool)}


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "results").glob("*.json")), ids=lambda path: path.stem)
def test_every_number_of_the_results_is_a_metric_or_a_setting(path):
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    found = set().union(*map(numeric, rows))
    assert found
    assert sorted(found - set(METRICS) - SETTINGS) == []


def test_no_setting_is_a_metric():
    assert SETTINGS & set(METRICS) == set()


def test_everything_that_a_table_shows_or_a_convention_defines_is_registered():
    shown = {*TABLE_KEYS, *OWN_KEYS, *EQUAL_KEYS, *SCORES}
    shown |= {key for rule in (*CONVENTIONS.values(), *PLAIN_CONVENTIONS.values()) for key in rule.keys}
    assert shown - set(METRICS) == set()


def test_everything_that_the_formats_name_is_registered():
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    paragraph = re.search(r"\nMetrics: (.*?)\n\n", text + "\n\n", re.S).group(1)
    names = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", paragraph))))
    names -= {"convention", "_largest", "metrics", "py", "core"}
    assert len(names) > 20
    assert names - set(METRICS) == set()


def test_conventions_are_those_of_the_metrics_themselves():
    assert get_metric("psnr").conventions == tuple(PSNR_CONVENTIONS)
    assert get_metric("ssim").conventions == tuple(SSIM_CONVENTIONS)
    assert get_metric("lpips").conventions == tuple(LPIPS_CONVENTIONS)
    for rule in CONVENTIONS.values():
        assert rule.coverage_of in get_metric("coverage").conventions
        assert rule.dice in get_metric("dice").conventions


def test_an_unknown_key_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"get_metric: key must be one of psnr, ssim, .*, got 'sigma'") as caught:
        get_metric("sigma")
    assert all(key in str(caught.value) for key in METRICS)


def test_labels_directions_and_decimals():
    assert {get_metric(key).better for key in ("psnr", "ssim", "iou", "cubes_per_second")} == {"higher"}
    assert {get_metric(key).better for key in ("lpips", "disparity_mae", "ause", "seconds")} == {"lower"}
    assert [get_metric(key).sign for key in ("psnr", "flip", "coverage")] == [1, -1, 0]
    derived = get_metric("disparity_mae_area_by_photos")
    assert (derived.better, derived.decimals) == ("lower", 3)
    assert derived.name == "disparity error, mean, all cut by photo doubt"
    assert get_metric("psnr_at_coverage").name == "masked PSNR at equal coverage"
    assert get_metric("psnr_at_coverage").label == "PSNR at equal coverage"
    assert Metric("a", "b", "none").name == "b"
    for key, metric in METRICS.items():
        assert (metric.key, metric.decimals >= 0, bool(metric.label)) == (key, True, True)


def test_values_are_rounded_and_none_is_a_dash():
    assert format_value(21.976, "psnr") == "21.98"
    assert format_value(0.0031, "free_space_error") == "0.0031"
    assert format_value(None, "psnr") == "–"
    with pytest.raises(ValueError, match="key must be one of"):
        format_value(1.0, "unknown")
