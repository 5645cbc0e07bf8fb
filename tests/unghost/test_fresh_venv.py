"""The wheel in an environment that holds numpy and onnxruntime, and nothing else that is not ours."""

import importlib.util
import os
import shutil
import subprocess
import sys
import textwrap
import venv
from pathlib import Path

import numpy as np
import pytest

from unghost.denoisers import load_denoiser
from unghost.export.onnx.quantization import calibration_inputs, convert_onnx

ROOT = Path(__file__).resolve().parents[2]
NEEDED = ("numpy", "onnxruntime")
ABSENT = ("torch", "onnx", "safetensors", "scipy", "tyro", "tqdm", "jinja2", "markupsafe", "pip")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The interpreter of a fresh environment: the built wheel, unpacked by pip, and the two packages lent to it."""
    root = tmp_path_factory.mktemp("fresh")
    source = root / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for folder in ROOT.glob("*/__init__.py"):
        name = folder.parent.name
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    wheel = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(root), str(source)]
    done = subprocess.run(wheel, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    venv.create(root / "venv", with_pip=False, symlinks=os.name != "nt")
    interpreter = root / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    packages = Path(ask(interpreter, "import sysconfig; print(sysconfig.get_path('purelib'))").stdout.strip())
    (built,) = root.glob("*.whl")
    install = [*pip, "install", "--no-deps", "--no-index", "--no-compile", "--target", str(packages), str(built)]
    done = subprocess.run(install, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    for name in NEEDED:
        origin = Path(importlib.util.find_spec(name).origin).parent
        for path in (origin, origin.with_name(f"{name}.libs")):
            if path.is_dir():
                (packages / path.name).symlink_to(path, target_is_directory=True)
    return interpreter


def ask(interpreter, program, *arguments):
    """Run a program there, with none of this environment's paths."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run(
        [str(interpreter), "-W", "error", "-c", textwrap.dedent(program), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        env=env,
        cwd=Path(interpreter).parent,
        check=False,
    )


def test_nothing_else_is_there(python):
    done = ask(python, f"import importlib.util as u; print([n for n in {ABSENT!r} if u.find_spec(n)])")
    assert done.stdout.strip() == "[]", done.stderr
    done = ask(python, "import unghost, sys; print(unghost.__file__)")
    assert Path(python).parents[1] in Path(done.stdout.strip()).parents, done.stderr


def test_every_precision_denoises_there_as_here(python, tmp_path):
    """The shipped model by name, and others from files: the numbers are those of this environment."""
    from unghost.denoisers import WEIGHTS
    from unghost.export.onnx.to_onnx import export_onnx

    export_onnx(WEIGHTS / "default.safetensors", tmp_path / "fp32.onnx")
    cubes = np.random.default_rng(0).uniform(-1, 1, (3, 1, 32, 32, 32)).astype(np.float32)
    np.save(tmp_path / "cubes.npy", cubes)
    inputs = calibration_inputs(cubes, np.full(3, 0.1), default_timestep=900)
    convert_onnx(tmp_path / "fp32.onnx", tmp_path / "int8.onnx", precision="int8", calibration=inputs)
    done = ask(
        python,
        """
        import sys
        import numpy as np, unghost
        folder = sys.argv[1]
        cubes = np.load(folder + "/cubes.npy")
        for name in ("default", folder + "/fp32.onnx", folder + "/int8.onnx"):
            denoiser = unghost.load_denoiser(name, threads=1)
            np.save(folder + "/" + denoiser.precision + ".npy", denoiser(cubes, 900, 0.1))
        assert "torch" not in sys.modules and "onnx" not in sys.modules
        """,
        tmp_path,
    )
    assert done.returncode == 0, done.stderr
    files = {"fp16": "default", "fp32": tmp_path / "fp32.onnx", "int8": tmp_path / "int8.onnx"}
    for precision, name in files.items():
        expected = load_denoiser(name, threads=1)(cubes, 900, 0.1)
        np.testing.assert_array_equal(np.load(tmp_path / f"{precision}.npy"), expected)


def test_what_needs_more_says_so(python):
    done = ask(python, "import unghost; unghost.load_denoiser('default', backend='torch')")
    assert done.returncode == 1
    assert "pip install unghost[torch]" in done.stderr
