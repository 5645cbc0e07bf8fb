"""What pyproject.toml declares is what the code imports: no package missing, none idle, all of them pinned."""

import ast
import re
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
BASE, EXTRAS = PROJECT["dependencies"], PROJECT["optional-dependencies"]
PACKAGE = (
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
    "unghost",
)
OUTSIDE = ("benchmarks", "examples", "tests")  # run with every extra

SERVES = {  # extra -> the folders whose code it is for; a new extra needs a row here
    "torch": {
        "fields",
        "prior",
        "regularizer",
        "baselines",
        "cleaning",
        "data_recipes",
        "evaluation",
        "export",
        "unghost",
    },
    "recipes": {"core", "data_recipes", "scenes"},
    "export": {"export", "prior"},
    "eval": {"core", "evaluation", "baselines", "unghost"},
    "demo": {"core", "unghost", "scenes"},
    "capture": {"evaluation", "unghost"},
    "scale": {"data_recipes"},
}
NAMES = {  # distribution -> the name it is imported by, where they differ
    "pillow": "PIL",
    "scikit-image": "skimage",
    "open3d-cpu": "open3d",
    "pytest-xdist": "xdist",
}
NOT_BY_NAME = {  # declared, and used without an import statement
    "av": "imported by evaluation/captures/frames.py through a list of names",
    "tensorboard": "behind torch.utils.tensorboard",
    "xdist": "pytest -n",
    "ruff": "make check",
    "mypy": "make check",
    "build": "python -m build",
    "setuptools": "the build backend of the tests of wheels",
}
BROUGHT = {  # imported, and not ours to declare: the user's own, or brought by what is declared
    "lpips": "LPIPS is an option of `unghost evaluate` that names it where it is missing",
    "nerfstudio": "the host of an integration",
    "nerfbaselines": "the host of an integration",
    "torchmetrics": "nerfstudio's, in the benchmark of its integration",
    "packaging": "pytest's",
}
OWN = {"unghost", "benchmarks", "unghost_tests", "engine_tasks", *PACKAGE}
BY_CALL = ("import_module", "importorskip")


def imported(source):
    """Top-level names of what a file imports from outside the project and the standard library."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in BY_CALL:
            names |= {each.value for each in node.args[:1] if isinstance(each, ast.Constant)}
    tops = {name.split(".")[0] for name in names}
    return {name for name in tops if name and name not in sys.stdlib_module_names | OWN}


def folder_imports(folder):
    """Package -> the files of a folder that import it."""
    found = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        if not any(parent.is_symlink() for parent in path.parents):
            for name in imported(path.read_text(encoding="utf-8")):
                found.setdefault(name, []).append(path.relative_to(ROOT).as_posix())
    return found


def distributions(requirements):
    return {Requirement(each).name for each in requirements}


def import_name(distribution):
    lower = distribution.lower()
    return NAMES.get(lower, lower.replace("-", "_"))


def declared(requirements):
    return {import_name(each) for each in distributions(requirements)}


def everything(extra):
    """The requirements of an extra with those of the project's own extras that it names."""
    found = []
    for each in EXTRAS[extra]:
        parsed = Requirement(each)
        found += [r for name in sorted(parsed.extras) for r in everything(name)] if parsed.name == "unghost" else [each]
    return found


ROWS = [extra for extra in EXTRAS if extra not in ("all", "dev")]


def test_every_extra_has_a_row():
    assert set(ROWS) <= set(SERVES), "say in SERVES which folders the new extra is for"
    assert {path.parent.name for path in ROOT.glob("*/__init__.py")} == {*PACKAGE, "benchmarks"}


@pytest.mark.parametrize("folder", PACKAGE)
def test_what_a_folder_imports_is_declared(folder):
    served = [each for extra in ROWS if folder in SERVES[extra] for each in EXTRAS[extra]]
    allowed = declared([*BASE, *served]) | set(BROUGHT)
    missing = {name: files for name, files in folder_imports(folder).items() if name not in allowed}
    assert not missing, f"no extra for {folder} declares them"


@pytest.mark.slow
@pytest.mark.parametrize("folder", OUTSIDE)
def test_what_is_run_with_every_extra_imports_nothing_else(folder):
    allowed = declared([*BASE, *everything("dev"), *everything("scale")]) | set(BROUGHT)
    missing = {name: files for name, files in folder_imports(folder).items() if name not in allowed}
    assert not missing


@pytest.mark.slow
@pytest.mark.parametrize("extra", ["base", *ROWS])
def test_what_is_declared_is_imported(extra):
    folders = PACKAGE if extra == "base" else SERVES[extra]
    used = set().union(*(folder_imports(folder) for folder in folders)) | set(NOT_BY_NAME)
    assert declared(BASE if extra == "base" else EXTRAS[extra]) <= used


@pytest.mark.slow
def test_what_only_developers_need_is_used_outside_the_package():
    used = set().union(*(folder_imports(folder) for folder in OUTSIDE)) | set(NOT_BY_NAME)
    assert declared(EXTRAS["dev"]) - {"unghost"} <= used


@pytest.mark.slow
def test_exceptions_are_in_use():
    """A row that nothing needs any more goes."""
    requirements = declared([*BASE, *everything("dev"), *everything("scale")])
    found = set().union(*(folder_imports(folder) for folder in (*PACKAGE, *OUTSIDE)))
    assert set(NOT_BY_NAME) <= requirements
    assert set(BROUGHT) <= found
    assert not set(BROUGHT) & requirements


def test_all_is_every_extra_but_ray():
    assert set(everything("all")) == {each for extra in ROWS if extra != "scale" for each in EXTRAS[extra]}


def pins():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return {
        re.sub(r"[-_.]+", "-", found.name).lower(): found
        for line in lines
        if line and not line.startswith("#")
        for found in [Requirement(line)]
    }


def test_every_requirement_is_pinned_within_its_range():
    pinned = pins()
    for each in [*BASE, *everything("dev")]:
        wanted = Requirement(each)
        if wanted.marker is not None and not wanted.marker.evaluate():
            continue
        pin = pinned[re.sub(r"[-_.]+", "-", wanted.name).lower()]
        (number,) = (part.version for part in pin.specifier)
        assert wanted.specifier.contains(number), (each, number)


def test_the_check_can_fail():
    source = "import torch.nn\nfrom scipy import ndimage\nfrom . import x\nimport os\nimport_module('open3d')\n"
    assert imported(source) == {"torch", "scipy", "open3d"}
    assert import_name("Pillow") == "PIL"
    assert import_name("Jinja2") == "jinja2"
