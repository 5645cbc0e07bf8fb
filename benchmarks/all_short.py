"""Run the short form of every benchmark that needs no data, one after the other, and print a summary.

    python -m benchmarks.all_short                      all of them: about twenty minutes on two cores
    python -m benchmarks.all_short cleaning denoise     those whose name begins so

Results go to out/short, what each prints to out/short/logs. Exit status 1 if one fails.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from dataclasses import dataclass

import tyro

from .options import ROOT, SHORT_RESULTS
from .progress import say, wrote

WITHOUT_DATA = (
    "cleaning.cost",
    "cleaning.splats",
    "data.curate",
    "data.harvest_statistics",
    "data.point_statistics",
    "denoise.channels_study",
    "denoise.run",
    "regularizer.cost",
    "regularizer.rooms",
    "regularizer.sight_lines",
    "regularizer.stability",
    "release.recalibrate",
    "release.ship",
    "release.train_diffusion",
    "release.training_speed",
    "two_trajectory.pictures",
    "two_trajectory.run",
    "two_trajectory.sweep",
)


@dataclass(frozen=True)
class Options:
    """Which benchmarks to run.

    Attributes:
        names: beginnings of names, FOLDER or FOLDER.NAME; all if left out.
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()

    def chosen(self) -> list[str]:
        """Names of the benchmarks to run."""
        return [name for name in WITHOUT_DATA if not self.names or name.startswith(self.names)]


def processor_seconds() -> float:
    """What finished child processes have taken, all threads together."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    options = tyro.cli(Options, description=__doc__)
    chosen, lines, failed = options.chosen(), list[str](), 0
    logs = SHORT_RESULTS / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(chosen, 1):
        say(f"[{number}/{len(chosen)}] {name}")
        log, begun, spent = logs / f"{name}.txt", time.perf_counter(), processor_seconds()
        with log.open("w", encoding="utf-8") as stream:
            command = [sys.executable, "-m", f"benchmarks.{name}", "--short"]
            status = subprocess.run(command, cwd=ROOT, stdout=stream, stderr=subprocess.STDOUT, check=False).returncode
        seconds, spent = time.perf_counter() - begun, processor_seconds() - spent
        last = (log.read_text(encoding="utf-8").strip().splitlines() or [""])[-1]
        took = f"{seconds:.0f} s, of a processor {spent:.0f} s"
        lines.append(f"{name:28s} {took:32s} {'ok' if status == 0 else f'FAILED, status {status}'}")
        say(f"    {took}, status {status}: {last}")
        failed += status != 0
    say("\n".join(["", *lines]))
    wrote(logs)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
