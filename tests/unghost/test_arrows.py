"""Which folder may import which: the table of the design, checked over the syntax trees."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("core", "fields", "data_recipes", "prior", "export", "regularizer", "evaluation")
ALLOWED = {
    "core": set(),
    "fields": {"core"},
    "data_recipes": {"core"},
    "prior": {"core"},
    "export": {"core", "prior"},
    "regularizer": {"core"},
    "evaluation": {"core"},
    "unghost": set(FOLDERS),
}
EXCEPTIONS = {"data_recipes/harvest.py": {"core", "fields"}, "export/runtime.py": {"core"}}
OUTSIDE_CORE = {"numpy"}  # the only package from outside that core may use


def violations(source, folder, name):
    """What ``source``, standing in ``folder/name``, imports against the table."""
    allowed = EXCEPTIONS.get(f"{folder}/{name}", ALLOWED[folder])
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            tops = {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            tops = {(node.module or "").split(".")[0]}
        elif isinstance(node, ast.ImportFrom):
            found += _relative(node, folder, allowed)
            continue
        else:
            continue
        found += [f"{top}: between folders, imports are relative" for top in tops & {"unghost", *FOLDERS}]
        if folder == "core":
            found += [f"core imports {top}" for top in tops if top not in OUTSIDE_CORE and not _standard(top)]
    return found


def _relative(node, folder, allowed):
    """Violations of ``from .x import y`` and ``from ..x import y``."""
    path = (node.module or "").split(".") if node.module else []
    if folder == "unghost":
        return [] if node.level == 1 else [f"unghost reaches {node.level} levels up"]
    if node.level == 1:
        return []
    if node.level > 2:
        return [f"{folder} reaches {node.level} levels up"]
    targets = set(path[:1] or [alias.name for alias in node.names])
    return [f"{folder} imports {target}" for target in sorted(targets - allowed - {folder})]


def _standard(top):
    return top in sys.stdlib_module_names


def modules():
    return [
        pytest.param(folder, path, id=f"{folder}/{path.name}")
        for folder in ALLOWED
        for path in sorted((ROOT / folder).glob("*.py"))
    ]


@pytest.mark.parametrize(("folder", "path"), modules())
def test_arrows(folder, path):
    assert violations(path.read_text(encoding="utf-8"), folder, path.name) == []


@pytest.mark.parametrize(
    ("source", "folder", "name"),
    [
        ("from ..prior.network import Net", "regularizer", "clean.py"),
        ("from .. import export", "regularizer", "clean.py"),
        ("def f():\n    from ..export import runtime", "regularizer", "clean.py"),
        ("from ..prior import checkpoint", "export", "runtime.py"),
        ("from ..fields.radiance import RadianceField", "data_recipes", "curate.py"),
        ("from unghost.core.frames import CubeFrame", "prior", "train.py"),
        ("import core", "prior", "train.py"),
        ("import torch", "core", "frames.py"),
        ("from ..regularizer.clean import clean", "evaluation", "protocol.py"),
    ],
)
def test_the_check_can_fail(source, folder, name):
    assert violations(source, folder, name)


@pytest.mark.parametrize(
    ("source", "folder", "name"),
    [
        ("from ..core.frames import CubeFrame\nfrom .losses import dsds_loss\nimport torch", "regularizer", "clean.py"),
        ("from ..fields.radiance import RadianceField", "data_recipes", "harvest.py"),
        ("from ..prior.checkpoint import load_model", "export", "to_onnx.py"),
        ("from .regularizer.clean import clean", "unghost", "cleaning.py"),
        ("import numpy as np\nimport os.path", "core", "frames.py"),
    ],
)
def test_what_is_allowed_passes(source, folder, name):
    assert violations(source, folder, name) == []


def test_no_folder_is_forgotten():
    on_disk = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert on_disk == set(ALLOWED)
