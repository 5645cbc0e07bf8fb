"""nerfstudio's own nerfacto trains with the regularizer on, in an environment that is installed for it."""

import ast
import json
import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[4]


@pytest.mark.nerfstudio
@pytest.mark.skipif(os.environ.get("UNGHOST_NERFSTUDIO") != "1", reason="UNGHOST_NERFSTUDIO is not 1")
def test_nerfacto_trains_with_the_regularizer_on(tmp_path):
    make = ["make", "nerfstudio", f"ARGUMENTS=--steps 25 --rays 256 --threads 1 --out {tmp_path}"]
    done = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    found = json.loads((tmp_path / "nerfstudio.json").read_text(encoding="utf-8"))
    check(found)


def test_the_committed_result_says_so_too():
    check(json.loads((ROOT / "docs" / "results" / "nerfstudio.json").read_text(encoding="utf-8")))


def check(found):
    plain, ours = found["rows"]
    assert (plain["method"], ours["method"]) == ("nerfacto", "unghost-nerfacto")
    assert found["installed"]["nerfstudio"] == "1.1.5"
    assert max(found["pixel_error"], found["pixel_error_bent"]) < 1e-2
    assert ours["fields"] == 3  # the field and two proposal networks
    assert ours["contraction_error"] < 1e-3  # asked at places, or rendered along rays, also beyond the box
    assert ours["cubes"] == 40
    assert ours["milliseconds_of_them"] > 0
    assert found["loaded_by_import"] == []  # the plug-in waits for the first step
    assert ours["regularized_steps"] == -(-ours["steps"] // 5)
    assert ours["last"]["unghost_visibility"] < ours["first"]["unghost_visibility"]
    assert ours["opacity_unseen"] < plain["opacity_unseen"]


def test_the_entry_point_names_a_method_that_is_there():
    tomllib = pytest.importorskip("tomllib")
    points = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    module, _, name = points["nerfstudio.method_configs"]["unghost-nerfacto"].partition(":")
    tree = ast.parse((ROOT / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
    assert name in {target.id for node in tree.body if isinstance(node, ast.Assign) for target in node.targets}
