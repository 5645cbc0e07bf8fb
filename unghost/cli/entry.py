"""The command ``unghost``: one verb each, arguments from the functions of the same names."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from ..core.errors import UnghostError
from .options import in_options, option_names

USER_ERRORS = (UnghostError, OSError)  # what the user can mend; anything else is a bug of ours
USAGE_EXIT, INTERRUPTED_EXIT = 2, 130
TRACEBACK = "--traceback"


DESCRIPTION = f"""Take ghosts out of radiance fields.

An error that you can mend is one line; {TRACEBACK} after any verb shows where it arose."""

# Verb: the module of this package that has the function of that name (imported when the verb is asked for), and what
# it does, which is the first line of the function's docstring.
VERBS = {
    "demo": ("prior", "Clean a synthetic room whose ghosts are known; writes a page to look at and result.json."),
    "clean": (
        "cleaning",
        "Clean a density grid (.npz) or 3D Gaussians (.ply); writes a cleaned copy and the mask of what stays.",
    ),
    "masks": ("masks", "Visibility masks of the two-trajectory protocol, from depth and cameras alone."),
    "doubt": (
        "uncertainty",
        "Say which pixels not to trust, by the photos that were trained on; needs renders with depth, but no field.",
    ),
    "capture": (
        "captures",
        "Make a capture from two videos (or two folders of photos): one to train on, one to be scored on.",
    ),
    "convert": (
        "captures",
        "Say how hard a capture's evaluation is and, with --out, write it as stock nerfstudio reads it.",
    ),
    "points": (
        "captures",
        "Triangulate sparse points from the photos of one sweep alone, with the poses that the capture has.",
    ),
    "evaluate": (
        "evaluation",
        "Score anyone's renders against photos: a page, a results file, a table. No field is needed.",
    ),
    "report": ("evaluation", "Make the page of a results file: tables by convention, PSNR over coverage, differences."),
    "bench": ("prior", "Measure how many 32^3 cubes a second a denoiser restores through onnxruntime."),
    "curate": (
        "recipes",
        "Make training pairs from a recipe: cubes of procedural solids, booleans or meshes, and their corruptions.",
    ),
    "harvest": ("recipes", "Fit radiance fields to few photos of synthetic scenes; cut out cubes beside the truth."),
    "preview": (
        "recipes",
        "Draw a page of what is in a shard: cubes as surfaces, histograms, statistics, sources and licences.",
    ),
    "train": ("training", "Train a restoration prior from shards; writes model.safetensors, logs and checkpoints."),
    "sample": (
        "sampling",
        "Draw unconditional cubes from a diffusion prior; writes them and pictures of them as surfaces.",
    ),
    "export": ("training", "Write a trained prior as portable ONNX files, compared with torch before they appear."),
    "verify": (
        "training",
        "State how far an ONNX file is from its checkpoint in torch; exit status 1 if too far for its precision.",
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        argv: the words after ``unghost``; those of the process if None. ``--traceback`` may stand anywhere among them.

    Returns:
        0, or the status that the verb chose. What the user can mend (a missing file, an impossible value, a missing
        extra: :class:`~unghost.core.errors.UnghostError` and ``OSError``) prints one line, ``unghost VERB: message``,
        to stderr and gives 2. Any other error is raised, and so is every one with ``--traceback``.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    words = [word for word in given if word != TRACEBACK]
    verb = words[0] if words and words[0] in VERBS else ""
    try:
        status = _run(verb, words[1:]) if verb else _overview(words)
    except USER_ERRORS as error:
        if len(words) < len(given):
            raise
        message = " ".join(str(error).split()).removeprefix(f"{verb}: ") or type(error).__name__
        print(f"unghost {verb}: {in_options(message, _options_of(verb))}", file=sys.stderr)
        return USAGE_EXIT
    except KeyboardInterrupt:
        print(f"unghost {verb}: interrupted", file=sys.stderr)
        return INTERRUPTED_EXIT
    return int(status or 0)


def _run(verb: str, words: Sequence[str]) -> int | None:
    """One verb with its arguments; only its own module is imported."""
    import tyro

    module = importlib.import_module(f".{VERBS[verb][0]}", __package__)
    function: Callable[..., int | None] = getattr(module, verb)
    return tyro.cli(function, prog=f"unghost {verb}", args=words)


def _options_of(verb: str) -> set[str]:
    """The names of a verb's options, which is imported already: it has raised an error."""
    module = sys.modules.get(f"{__package__}.{VERBS[verb][0]}") if verb else None
    return set() if module is None else option_names(getattr(module, verb))


def _overview(words: Sequence[str]) -> NoReturn:
    """The help of the whole, or what is wrong with words that start with no verb; either way the process ends."""
    import tyro

    def named(summary: str) -> Callable[[], None]:
        def stand_in() -> None: ...

        stand_in.__doc__ = summary
        return stand_in

    verbs = {verb: named(summary) for verb, (_, summary) in VERBS.items()}
    tyro.extras.subcommand_cli_from_dict(verbs, prog="unghost", args=words, description=DESCRIPTION)
    raise SystemExit(USAGE_EXIT)  # no stand-in takes a verb, so this is not reached


if __name__ == "__main__":
    sys.exit(main())
