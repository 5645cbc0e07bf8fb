"""What the benchmark's tables show is in the registry of metrics."""

from benchmarks.two_trajectory import page, tables
from benchmarks.two_trajectory.figure import COLUMNS, axis_label
from unghost.core.metrics import METRICS


def test_every_column_is_registered():
    cut = {
        f"{key}_{how}{order}" for key in tables.AT_EQUAL for how in ("at_coverage", "area") for order in tables.ORDERS
    }
    assert {*tables.KEYS, *page.PLAIN, *COLUMNS, *cut} - set(METRICS) == set()


def test_axes_say_which_way_is_better():
    assert axis_label("psnr") == "PSNR, dB (higher is better)"
    assert axis_label("disparity_mae") == "disparity error (lower is better)"
