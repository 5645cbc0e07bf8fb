"""The installed package is the folders on disk: in the list, in the mapping, in the symlinks, in the wheel."""

import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import unghost

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SETUPTOOLS = PROJECT["tool"]["setuptools"]
FOLDERS = sorted(path.parent.name for path in ROOT.glob("*/__init__.py") if path.parent.name != "benchmarks")
DOTTED = {"unghost" if name == "unghost" else f"unghost.{name}": name for name in FOLDERS}


def inits(folder):
    """The ``__init__.py`` of every package below a top-level folder, symlinks not followed."""
    return [
        path for path in (ROOT / folder).rglob("__init__.py") if not any(parent.is_symlink() for parent in path.parents)
    ]


def dotted(path):
    parts = path.relative_to(ROOT).parent.parts
    return ".".join(parts if parts[0] == "unghost" else ("unghost", *parts))


def test_the_list_of_packages_equals_the_folders_on_disk():
    assert sorted(SETUPTOOLS["packages"]) == sorted(dotted(path) for folder in FOLDERS for path in inits(folder))
    assert SETUPTOOLS["package-dir"] == DOTTED


def test_every_folder_with_modules_is_a_package():
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*.py"):
            assert (path.parent / "__init__.py").is_file(), path


def test_every_folder_has_its_symlink():
    for name in set(FOLDERS) - {"unghost"}:
        link = ROOT / "unghost" / name
        assert link.is_symlink(), link
        assert link.readlink() == Path("..") / name  # relative, so that a clone works anywhere
        assert link.resolve() == ROOT / name


def test_version_is_the_projects():
    assert unghost.__version__ == PROJECT["project"]["version"] == version("unghost")


def test_every_public_name_is_listed():
    assert set(unghost.__all__) <= set(dir(unghost))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = unghost.nothing


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what the build reads: building in the checkout would leave things behind."""
    copy = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


@pytest.mark.slow
def test_the_wheel_holds_every_module(source, tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run(
        [*command, "--wheel-dir", str(tmp_path), str(source)], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {
        ("" if folder == "unghost" else "unghost/") + path.relative_to(ROOT).as_posix()
        for folder in FOLDERS
        for pattern in ("*.py", "*.toml", "*.jinja", "*.css", "*.js")
        for path in (ROOT / folder).rglob(pattern)
        if not any(parent.is_symlink() for parent in path.parents)
    }
    assert len(expected) > 200
    assert expected <= names, expected - names
    assert {f"unghost/core/pages/templates/{name}" for name in ("base.html.jinja", "style.css", "slider.js")} <= names
    assert "unghost/py.typed" in names
    assert {f"unghost/weights/{path.name}" for path in (ROOT / "unghost" / "weights").glob("*")} <= names
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"unghost"}  # nothing lands beside the package
