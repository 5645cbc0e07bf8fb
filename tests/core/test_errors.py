"""The kinds of errors, and that every deliberate error of the package is of one."""

import ast
import pickle
from pathlib import Path

import pytest

from unghost.core import errors

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
    "unghost",
)
BARE = {"Exception", "ValueError", "TypeError", "ImportError", "ModuleNotFoundError", "FileNotFoundError"}
KINDS = {
    errors.InvalidArgument: ValueError,
    errors.InvalidType: TypeError,
    errors.InvalidFile: ValueError,
    errors.MissingFile: FileNotFoundError,
    errors.MissingExtra: ImportError,
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_caught_as_the_builtin_one_and_pickles(kind):
    for error in (kind("f: x must be > 0, got 0"), pickle.loads(pickle.dumps(kind("f: x must be > 0, got 0")))):
        assert isinstance(error, KINDS[kind])
        assert isinstance(error, errors.UnghostError)
        assert type(error) is kind
        assert str(error) == "f: x must be > 0, got 0"


def test_a_missing_extra_keeps_the_name_of_the_package():
    error = pickle.loads(pickle.dumps(errors.MissingExtra("f needs torch", name="torch")))
    assert (str(error), error.name) == ("f needs torch", "torch")


def test_errors_with_classes_of_their_own_are_kinds_too_and_pickle():
    from unghost.data_recipes.engines import WorkerDied
    from unghost.data_recipes.meshes.reading import MeshEmpty, MeshRejected
    from unghost.data_recipes.pairs import SampleError
    from unghost.evaluation.metrics.perceptual import LpipsUnavailable
    from unghost.fields.adapters.msgpack_stream import MsgpackError
    from unghost.prior.training.distributed import RankLost
    from unghost.prior.training.run_state import TrainingDiverged

    own = {
        WorkerDied: ChildProcessError,
        MeshEmpty: ValueError,
        MeshRejected: ValueError,
        SampleError: ValueError,
        LpipsUnavailable: ImportError,
        MsgpackError: ValueError,
        RankLost: RuntimeError,
        TrainingDiverged: RuntimeError,
    }
    for kind, builtin in own.items():
        assert issubclass(kind, errors.UnghostError)
        assert issubclass(kind, builtin)
        assert str(pickle.loads(pickle.dumps(kind("because")))) == "because"


def bare_raises(source):
    """Lines of ``raise ValueError("...")`` and its like, where one of the package's kinds is due."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Raise)
        and isinstance(node.exc, ast.Call)
        and isinstance(node.exc.func, ast.Name)
        and node.exc.func.id in BARE
    ]


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS)
def test_deliberate_errors_are_of_the_packages_kinds(folder):
    paths = [path for path in (ROOT / folder).rglob("*.py") if not any(parent.is_symlink() for parent in path.parents)]
    assert paths
    found = {path.relative_to(ROOT).as_posix(): bare_raises(path.read_text(encoding="utf-8")) for path in paths}
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_the_check_of_kinds_can_fail():
    assert bare_raises("def f():\n    raise ValueError('x')") == [2]
    assert bare_raises("raise InvalidArgument('x')\nraise AttributeError('x')\nraise\nraise ValueError") == []
