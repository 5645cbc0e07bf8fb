"""Command line options that all benchmarks share: ``--short``, ``--out``, ``--threads``, and the data they need."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NoReturn, TypeVar

import tyro

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
SHORT_RESULTS = ROOT / "out" / "short"
SAMPLE = ROOT / "docs" / "harvest" / "sample"  # harvested cubes that the repository holds
NOT_GIVEN = Path("not-given")  # default of a required path, so that no benchmark has to handle None
CAPTURE = "a capture: a folder with transforms.json, splits.json and the photos"
HARVEST = "a folder of harvested shards (`unghost harvest`)"
MESHES = "a folder of meshes with a manifest.csv"
SHARDS = "folders of training shards (`unghost curate`, `unghost harvest`), each FOLDER or FOLDER=WEIGHT"
WHERE = ("out", "cache", "runs", "weights")  # say where files go, not what is measured


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """Options of every benchmark.

    Attributes:
        short: the same work with fewer scenes, steps and cubes, in minutes at most; what you set yourself stays as
            you set it. Results go to out/short, never to docs/results.
        out: folder of the results.
        threads: of torch and onnxruntime.
    """

    SHORT: ClassVar[dict[str, Any]] = {}
    """Values that ``--short`` gives to options that were left at their defaults."""
    DATA: ClassVar[dict[str, str]] = {}
    """Options that are paths of data that must exist, and what to put there."""
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ()
    """Required data without which ``--short`` leaves some rows out, or makes cubes of its own."""

    short: bool = False
    out: Path = RESULTS
    threads: int = 2

    def shortened(self) -> Any:
        """These options, with the values of ``SHORT`` where ``short`` is set and an option has its default."""
        if not self.short:
            return self
        defaults = _defaults(type(self))
        changes = {name: value for name, value in self.SHORT.items() if getattr(self, name) == defaults[name]}
        if self.out.resolve() == RESULTS:
            changes["out"] = SHORT_RESULTS
        return dataclasses.replace(self, **changes)

    def lacking(self) -> str | None:
        """What data is missing, in one line; None if nothing is."""
        for name, what in self.DATA.items():
            value = getattr(self, name)
            if value in (NOT_GIVEN, (), None):
                if value is not None and not (self.short and name in self.SHORT_WITHOUT):
                    return f"needs {name.upper()}, {what}"
                continue
            for path in value if isinstance(value, tuple) else (value,):
                folder = Path(str(path).split("=")[0])
                if not folder.exists():
                    return f"{name}: there is no {folder}; needs {what}"
        return None

    def command(self) -> str:
        """The command that repeats this run: every option that is not at its default, file names without folders."""
        defaults = _defaults(type(self)) | (self.SHORT if self.short else {})
        positional, named = list[str](), list[str]()
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value == defaults[field.name] or field.name in WHERE:
                continue
            words = [_word(each) for each in (value if isinstance(value, tuple) else (value,))]
            if "Positional" in str(field.type):
                positional += words
            elif isinstance(value, bool):
                named.append(f"--{'' if value else 'no-'}{field.name.replace('_', '-')}")
            else:
                named += [f"--{field.name.replace('_', '-')}", *words]
        return " ".join([f"python -m {module_of(type(self))}", *positional, *named])


Kind = TypeVar("Kind", bound=BenchmarkOptions)


def given(path: Path) -> bool:
    """Whether a path whose default is ``NOT_GIVEN`` was given."""
    return path != NOT_GIVEN


def parse(kind: type[Kind], description: str | None, args: Sequence[str] | None = None) -> Kind:
    """Options from the command line, shortened if they say so.

    Args:
        kind: dataclass of the benchmark's options.
        description: text of ``--help``.
        args: words of the command line; ``sys.argv`` if left out.

    Raises:
        SystemExit: with status 2 after one line on the standard error, if data is missing.
    """
    options: Kind = tyro.cli(kind, description=description, args=args).shortened()
    lacking = options.lacking()
    if lacking:
        give_up(kind, lacking)
    return options


def give_up(kind: type, reason: str) -> NoReturn:
    """Print one line that says what is missing; exit with status 2.

    Raises:
        SystemExit: always.
    """
    print(f"{module_of(kind)}: {reason}", file=sys.stderr)
    raise SystemExit(2)


def module_of(kind: type) -> str:
    """Dotted name of the module of a class, also where that module runs as a script."""
    if kind.__module__ != "__main__":
        return kind.__module__
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return spec.name if spec is not None else Path(sys.argv[0]).stem


def _defaults(kind: type[BenchmarkOptions]) -> dict[str, Any]:
    return {field.name: field.default for field in dataclasses.fields(kind)}


def _word(value: Any) -> str:
    """A value of the command line without folders: FOLDER/NAME, FOLDER/NAME=WEIGHT and NAME=FOLDER/FILE lose FOLDER."""
    if isinstance(value, Path):
        return value.resolve().name
    name, sign, file = str(value).partition("=")
    if isinstance(value, float):
        return f"{value:g}"
    return Path(name).name + sign + (Path(file).name if "/" in file else file)
