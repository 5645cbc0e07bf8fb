"""The command ``unghost``: one verb each, arguments from the functions of the same names."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from ..core.errors import UnghostError

USER_ERRORS = (UnghostError, OSError)  # what the user can mend; anything else is a bug of ours
USAGE_EXIT, INTERRUPTED_EXIT = 2, 130
TRACEBACK = "--traceback"


DESCRIPTION = f"""Take ghosts out of radiance fields.

An error that you can mend is one line; {TRACEBACK} after any verb shows where it arose."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        argv: the words after ``unghost``; those of the process if None. ``--traceback`` may stand anywhere among them.

    Returns:
        0, or the status that the verb chose. What the user can mend (a missing file, an impossible value, a missing
        extra: :class:`~unghost.core.errors.UnghostError` and ``OSError``) prints one line, ``unghost VERB: message``,
        to stderr and gives 2. Any other error is raised, and so is every one with ``--traceback``.
    """
    import tyro

    from . import captures as commands_capture
    from . import cleaning as commands_clean
    from . import evaluation as commands_evaluate
    from . import masks as commands_masks
    from . import prior as commands
    from . import recipes as commands_recipes
    from . import sampling as commands_sample
    from . import training as commands_prior
    from . import uncertainty as commands_doubt

    verbs: dict[str, Callable[..., Any]] = {
        "demo": commands.demo,
        "clean": commands_clean.clean,
        "masks": commands_masks.masks,
        "doubt": commands_doubt.doubt,
        "capture": commands_capture.capture,
        "convert": commands_capture.convert,
        "evaluate": commands_evaluate.evaluate,
        "report": commands_evaluate.report,
        "bench": commands.bench,
        "curate": commands_recipes.curate,
        "harvest": commands_recipes.harvest,
        "preview": commands_recipes.preview,
        "train": commands_prior.train,
        "sample": commands_sample.sample,
        "export": commands_prior.export,
        "verify": commands_prior.verify,
    }
    given = list(sys.argv[1:] if argv is None else argv)
    words = [word for word in given if word != TRACEBACK]
    verb = next((word for word in words if word in verbs), "")
    try:
        status: int | None = tyro.extras.subcommand_cli_from_dict(
            verbs, prog="unghost", args=words, description=DESCRIPTION
        )
    except USER_ERRORS as error:
        if len(words) < len(given):
            raise
        message = " ".join(str(error).split()) or type(error).__name__
        print(f"unghost {verb}: {message}", file=sys.stderr)
        return USAGE_EXIT
    except KeyboardInterrupt:
        print(f"unghost {verb}: interrupted", file=sys.stderr)
        return INTERRUPTED_EXIT
    return int(status or 0)


if __name__ == "__main__":
    sys.exit(main())
