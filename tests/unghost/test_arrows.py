"""Which folder may import which: the table of the design, checked over the syntax trees."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "core",
    "fields",
    "splats",
    "scenes",
    "data_recipes",
    "prior",
    "export",
    "cleaning",
    "regularizer",
    "baselines",
    "evaluation",
)
ALLOWED = {
    "core": set(),
    "fields": {"core"},
    "splats": {"core"},
    "scenes": {"core"},
    "data_recipes": {"core"},
    "prior": {"core"},
    "export": {"core"},
    "cleaning": {"core", "splats"},
    "regularizer": {"core", "cleaning"},
    "baselines": {"core", "fields", "splats"},
    "evaluation": {"core"},
    "unghost": set(FOLDERS),
}
EXCEPTIONS = {  # subfolders that may import more than their folder
    "data_recipes/harvest/": {"core", "fields", "scenes", "splats"},
    "export/onnx/": {"core", "prior"},
}
OUTSIDE_CORE = {"numpy"}  # the only package from outside that core may use
OUTSIDE_CORE_PAGES = {"numpy", "jinja2"}  # and what core/pages may, inside functions: core imports without it


OUTSIDE_CORE_MODULES = {"core/progress.py": {"tqdm"}}  # what one module of core may use, inside functions


def violations(source, path):
    """What ``source``, standing at ``path`` (``folder/module.py``), imports against the table."""
    folder = path.split("/")[0]
    outside = OUTSIDE_CORE_PAGES if path.startswith("core/pages/") else OUTSIDE_CORE
    outside = OUTSIDE_CORE_MODULES.get(path, outside)
    allowed = next((targets for start, targets in EXCEPTIONS.items() if path.startswith(start)), ALLOWED[folder])
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            tops = {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            tops = {(node.module or "").split(".")[0]}
        elif isinstance(node, ast.ImportFrom):
            found += _relative(node, path, allowed)
            continue
        else:
            continue
        found += [f"{top}: between folders, imports are relative" for top in tops & {"unghost", *FOLDERS}]
        if folder == "core":
            found += [f"core imports {top}" for top in tops if top not in outside and not _standard(top)]
    return found


def _relative(node, path, allowed):
    """Violations of ``from .x import y`` and ``from ..x import y``: the folder that they reach."""
    folder = path.split("/")[0]
    package = ("unghost/" + path if folder != "unghost" else path).split("/")[:-1]
    up = node.level - 1
    if up >= len(package):
        return [f"{path} reaches {node.level} levels up"]
    base = package[: len(package) - up] + (node.module.split(".") if node.module else [])
    targets = {base[1]} if len(base) > 1 else {alias.name for alias in node.names}
    if folder == "unghost":
        return []
    return [f"{path} imports {target}" for target in sorted(targets - allowed - {folder})]


def _standard(top):
    return top in sys.stdlib_module_names


def modules():
    return [
        pytest.param(path, id=path.relative_to(ROOT).as_posix())
        for folder in ALLOWED
        for path in sorted((ROOT / folder).rglob("*.py"))
        if not any(parent.is_symlink() for parent in path.parents)
    ]


@pytest.mark.parametrize("path", modules())
def test_arrows(path):
    assert violations(path.read_text(encoding="utf-8"), path.relative_to(ROOT).as_posix()) == []


@pytest.mark.parametrize(
    ("source", "path"),
    [
        ("from ..prior.networks.restoration import RestorationNet", "regularizer/removal.py"),
        ("from .. import export", "regularizer/removal.py"),
        ("def f():\n    from ..export import runtime", "regularizer/removal.py"),
        ("from ..prior import checkpoint", "export/runtime.py"),
        ("from ..fields.radiance import RadianceField", "data_recipes/curation.py"),
        ("from ...fields.radiance import RadianceField", "data_recipes/meshes/files.py"),
        ("from ...prior.checkpoint import load_model", "cleaning/pipeline.py"),
        ("from ..regularizer.losses import dsds_loss", "cleaning/pipeline.py"),
        ("from ..regularizer.losses import upcast", "baselines/losses.py"),
        ("from ....fields.radiance import RadianceField", "scenes/labelled_room/room.py"),
        ("from ...fields import radiance", "scenes/labelled_room/room.py"),
        ("from unghost.core.frames import CubeFrame", "prior/checkpoint.py"),
        ("import core", "prior/checkpoint.py"),
        ("import torch", "core/frames.py"),
        ("import torch", "core/shards/storage.py"),
        ("import jinja2", "core/frames.py"),
        ("def f():\n    from jinja2 import Environment", "core/pages_of_another_kind.py"),
        ("from markupsafe import Markup", "core/shards/storage.py"),
        ("import torch", "core/pages/rendering.py"),
        ("def f():\n    from tqdm import tqdm", "core/frames.py"),
        ("from ...cleaning.pipeline import clean", "evaluation/scoring/engine.py"),
    ],
)
def test_the_check_can_fail(source, path):
    assert violations(source, path)


@pytest.mark.parametrize(
    ("source", "path"),
    [
        ("from ..core.frames import CubeFrame\nfrom .losses import dsds_loss\nimport torch", "regularizer/removal.py"),
        ("from ..cleaning.keep_mask import KeepMask", "regularizer/removal.py"),
        ("from ...fields.radiance import RadianceField", "data_recipes/harvest/run.py"),
        ("from ...prior.checkpoint import load_model", "export/onnx/to_onnx.py"),
        ("from .cleaning.pipeline import clean", "unghost/facade.py"),
        ("from ..regularizer import DensityRegularizer", "unghost/cli/cleaning.py"),
        ("from ..meshes.files import load_mesh", "data_recipes/solids/csg.py"),
        ("import numpy as np\nimport os.path", "core/frames.py"),
        ("def f():\n    from jinja2 import Environment", "core/pages/rendering.py"),
    ],
)
def test_what_is_allowed_passes(source, path):
    assert violations(source, path) == []


def imports_of_the_command_line(source):
    """Imports of ``unghost.cli``, however they are written, in a module outside it."""
    imports = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom))
    found = [
        f"{'.' * getattr(node, 'level', 0)}{getattr(node, 'module', '') or ''}.{alias.name}"
        for node in imports
        for alias in node.names
    ]
    return [name for name in found if "cli" in name.replace("unghost.", ".").strip(".").split(".")[:1]]


@pytest.mark.slow
@pytest.mark.parametrize("folder", [*ALLOWED, "benchmarks", "examples"])
def test_only_the_command_line_imports_the_command_line(folder):
    for path in sorted((ROOT / folder).rglob("*.py")):
        if "cli" not in path.parts and not any(parent.is_symlink() for parent in path.parents):
            assert imports_of_the_command_line(path.read_text(encoding="utf-8")) == [], path


def test_imports_of_the_command_line_are_seen():
    for line in ("from unghost.cli.training import x", "from .cli.training import x", "from ..cli import x"):
        assert imports_of_the_command_line(line)
    assert imports_of_the_command_line("from unghost import cli")
    assert imports_of_the_command_line("from .client import cli_name") == []


def test_no_folder_is_forgotten():
    on_disk = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"benchmarks"}
    assert on_disk == set(ALLOWED)
