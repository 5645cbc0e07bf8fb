import json
import os
import re
import subprocess

import numpy as np
import pytest

from unghost.core import results


def test_shape_of_the_object():
    built = results.build_results([{"method": "clean", "iou": 0.5}], command="c", seeds=(0, 1), weights="abc")
    assert list(built) == ["command", "commit", "versions", "machine", "seeds", "weights", "rows"]
    assert built["rows"] == [{"method": "clean", "iou": 0.5}]
    assert set(built["machine"]) == {"architecture", "system", "cores"}  # nothing that names the host
    assert "numpy" in built["versions"]


def test_every_row_needs_a_method():
    with pytest.raises(ValueError, match="every row needs a 'method', got keys \\['iou'\\]"):
        results.build_results([{"iou": 1}])


def test_write_makes_folders_and_leaves_no_partial(tmp_path):
    path = tmp_path / "a" / "b.json"
    results.write_results(path, {"rows": [], "nothing": None})
    assert json.loads(path.read_text(encoding="utf-8")) == {"rows": [], "nothing": None}
    assert [item.name for item in path.parent.iterdir()] == ["b.json"]


@pytest.mark.parametrize("bad", [{"x": float("nan")}, {"x": object()}])
def test_a_failed_write_leaves_the_old_file(tmp_path, bad):
    path = tmp_path / "r.json"
    results.write_results(path, {"rows": [1]})
    with pytest.raises((ValueError, TypeError)):
        results.write_results(path, bad)
    assert json.loads(path.read_text(encoding="utf-8")) == {"rows": [1]}


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "r.json"
    results.write_results(path, {"rows": [1]})

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        results.write_results(path, {"rows": [2]})
    assert json.loads(path.read_text(encoding="utf-8")) == {"rows": [1]}


def test_commit_is_unknown_without_git(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert results.commit() == "unknown"


def test_results_do_not_make_the_checkout_dirty_but_code_does(tmp_path, monkeypatch):
    def git(*words):
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=tmp_path, check=True)

    for name in ("core/results.py", "docs/results/a.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "first")
    monkeypatch.setattr(results, "__file__", str(tmp_path / "core" / "results.py"))
    clean = results.commit()
    assert re.fullmatch("[0-9a-f]{12}", clean)
    (tmp_path / "docs" / "results" / "a.json").write_text("2")
    (tmp_path / "new.txt").touch()
    assert results.commit() == clean
    (tmp_path / "core" / "results.py").write_text("2")
    assert results.commit() == f"{clean}-dirty"


def test_json_ready_turns_what_json_lacks_into_null():
    nested = {"a": float("nan"), "b": [np.float32(1.5), float("inf")], "c": (np.int64(2), "text", None, True)}
    assert results.json_ready(nested) == {"a": None, "b": [1.5, None], "c": [2, "text", None, True]}
