import io
import sys

import pytest

from unghost.core import progress
from unghost.core.progress import StagedProgress, progress_bar


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def log(monkeypatch, capsys):
    """What stands in a log when every state of a bar is written to it."""
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)
    return lambda: capsys.readouterr().err


def test_a_log_has_whole_lines_and_no_control_characters(log):
    with progress_bar(4, unit="cube", describe="work") as bar:
        for _ in range(4):
            bar.set_postfix_str("loss 1.0", refresh=False)
            bar.update(1)
    text = log()
    lines = text.split("\n")
    assert "\r" not in text
    assert "\x1b" not in text
    assert len(lines) >= 3
    assert lines[-2].startswith("work: 100%|")
    assert lines[-2].endswith("loss 1.0]")
    assert lines[-1] == ""


def test_quick_work_leaves_no_line_in_a_log(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with progress_bar(4, unit="cube") as bar:
        bar.update(4)
    assert sys.stderr.getvalue() == ""


def test_a_terminal_has_a_bar_that_redraws(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with progress_bar(4, unit="cube") as bar:
        bar.update(4)
    assert "\r" in sys.stderr.getvalue()
    assert "4/4" in sys.stderr.getvalue()


def test_nothing_is_shown_unasked(log):
    with progress_bar(4, unit="cube", shown=False) as bar:
        bar.update(4)
    assert log() == ""


def test_stages_have_bars_of_their_own(log):
    with StagedProgress("photo") as show:
        for stage in ("features", "pairs"):
            for done in range(3):
                show(done + 1, 3, stage=stage, unit="pair" if stage == "pairs" else None)
        show(1, 5, stage="pairs")  # the count starts again
    text = log()
    assert "features: 100%" in text
    assert "pairs: 100%" in text
    assert "pairs:  20%" in text
    assert "photo/s" in text
    assert show.bar is None
