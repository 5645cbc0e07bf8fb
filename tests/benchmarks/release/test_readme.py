"""No number stands in the README's results that docs/results does not hold."""

import json
from pathlib import Path

from benchmarks.release import readme

ROOT = Path(__file__).resolve().parents[3]


def test_the_section_is_what_the_results_say():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text == readme.replaced(text, readme.section())


def test_a_changed_result_changes_the_section(tmp_path):
    folder = tmp_path / "docs" / "results"
    folder.mkdir(parents=True)
    row = {"method": "clean", "floater_recall": 0.5, "floater_precision": 1, "surface_kept": None}
    row |= {"iou_before": 0.1, "iou": 0.9, "seconds": 2}
    for recall in (0.5, 0.25):
        body = {"command": "unghost demo", "rows": [row | {"floater_recall": recall}]}
        (folder / "demo.json").write_text(json.dumps(body), encoding="utf-8")
        text = readme.section(tmp_path)
        assert f"| clean | {recall:.3f} | 1.000 | – | 0.100 | 0.900 | 2.0 |" in text


def test_every_result_has_its_provenance():
    for path in sorted((ROOT / "docs" / "results").glob("*.json")):
        body = json.loads(path.read_text(encoding="utf-8"))
        missing = {"command", "commit", "versions", "machine", "seeds", "rows"} - set(body)
        assert not missing, (path.name, missing)
        assert all("method" in row for row in body["rows"]), path.name
