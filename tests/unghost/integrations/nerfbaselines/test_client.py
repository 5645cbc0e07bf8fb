"""nerfbaselines' own command line scores with our protocols, in an environment that is installed for it."""

import json
import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[4]
NAMES = {"whole-image", "visible-only", "proper", "paper-text", "paper-code"}


@pytest.mark.nerfbaselines
@pytest.mark.skipif(os.environ.get("UNGHOST_NERFBASELINES") != "1", reason="UNGHOST_NERFBASELINES is not 1")
def test_nerfbaselines_scores_with_our_protocols(tmp_path):
    make = ["make", "nerfbaselines", f"ARGUMENTS=--out {tmp_path}"]
    done = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    check(json.loads((tmp_path / "nerfbaselines.json").read_text(encoding="utf-8")))


def test_the_committed_result_says_so_too():
    check(json.loads((ROOT / "docs" / "results" / "nerfbaselines.json").read_text(encoding="utf-8")))


def check(found):
    assert found["nerfbaselines"] == "1.2.12"
    assert set(found["registered"]) == {f"unghost-{name}" for name in NAMES}
    assert {row["method"] for row in found["rows"]} == set(found["registered"])
    for row in found["rows"]:
        assert row["largest_difference"] < 1e-5  # it rounds to five places
        assert row["images_scored"] == (3 if row["convention"] == "whole_image" else 2)
    assert found["same_formula"]["psnr_apart"] < 1e-4  # its own PSNR and SSIM of blanked images
    assert found["same_formula"]["ssim_apart"] < 1e-6


def test_the_entry_point_names_a_module_that_is_there():
    tomllib = pytest.importorskip("tomllib")
    points = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    module = points["nerfbaselines.specs"]["unghost"]
    assert (ROOT / f"{module.replace('.', '/')}.py").is_file()
