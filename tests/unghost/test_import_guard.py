"""What must work on the base install, with the heavy packages absent; and proof that the guard can fail."""

import subprocess
import sys
import textwrap

import pytest

ABSENT = (
    "torch",
    "onnx",
    "onnxscript",
    "safetensors",
    "trimesh",
    "open3d",
    "scipy",
    "skimage",
    "matplotlib",
    "PIL",
    "pycolmap",
    "av",
    "jinja2",
    "markupsafe",
)
BLOCKER = f"""
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {ABSENT!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}} (blocked)", name=name)
        return None

sys.meta_path.insert(0, Blocker())
"""


def run(program):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", BLOCKER + textwrap.dedent(program)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_the_base_install_imports_and_has_a_cleaner():
    done = run(
        """
        import importlib, pkgutil
        import unghost, unghost.core
        for module in pkgutil.walk_packages(unghost.core.__path__, "unghost.core."):
            importlib.import_module(module.name)
        import unghost.export.runtime
        import unghost.cli, unghost.cli.prior, unghost.fields.adapters.grids
        assert callable(unghost.clean) and callable(unghost.load_denoiser)
        assert isinstance(unghost.KeepMask, type)
        unghost.export.runtime.OnnxDenoiser
        """
    )
    assert done.returncode == 0, done.stderr


def test_cleaning_runs_without_torch():
    done = run(
        """
        import numpy as np, unghost

        class Oracle:
            kind, manifest = "numpy", None
            def __call__(self, channels, timestep, edge_fraction):
                return channels[:, :1]

        from unghost.core.manifest import Manifest
        Oracle.manifest = Manifest("oracle")
        ball = lambda p: (np.linalg.norm(p, axis=-1) < 0.6) * 80.0
        mask = unghost.clean(ball, [[-1, -1, -1], [1, 1, 1]], denoiser=Oracle(), resolution=32)
        assert mask.keep(np.zeros((1, 3)))[0]
        """
    )
    assert done.returncode == 0, done.stderr


def test_the_regularizer_names_its_extra():
    done = run(
        """
        import unghost
        try:
            unghost.DensityRegularizer
        except ImportError as error:
            assert "pip install unghost[torch]" in str(error), error
        else:
            raise SystemExit("no error")
        """
    )
    assert done.returncode == 0, done.stderr


def test_pages_name_their_extras():
    done = run(
        """
        import unghost.core.pages
        try:
            unghost.core.pages.render("demo.html.jinja")
        except ImportError as error:
            assert "pip install unghost[demo], unghost[recipes] or unghost[eval]" in str(error), error
        else:
            raise SystemExit("no error")
        """
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "package", ["torch", "jinja2", "markupsafe", "scipy.ndimage", "onnx", "unghost.prior.networks.restoration"]
)
def test_the_guard_can_fail(package):
    done = run(f"import {package}")
    assert done.returncode != 0
    assert "(blocked)" in done.stderr


def test_import_is_light():
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, unghost; print([n for n in ('numpy', 'torch', 'tyro', 'onnxruntime') if n in sys.modules])",
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.strip() == "[]"


def test_arrays_are_scored_on_the_base_install():
    done = run(
        """
        import numpy as np
        from unghost.evaluation import Renders, Truth, evaluate

        photos = np.full((2, 8, 8, 3), 0.5)
        results = evaluate({"a": Renders(photos + 0.1)}, Truth(photos), resamples=10)
        assert abs(results.scores["a"]["psnr"] - 20) < 1e-9
        results.table()
        """
    )
    assert done.returncode == 0, done.stderr
