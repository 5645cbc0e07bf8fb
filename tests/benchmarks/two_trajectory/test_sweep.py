"""Options of benchmarks/two_trajectory/sweep.py; its choice is tested in test_run.py."""

import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short, parsed

from benchmarks.two_trajectory import sweep


def test_short():
    check_short(sweep, scenes=("room-1",), factors=2)


def test_no_losses_means_to_choose_anew():
    assert parsed(sweep, "--losses").losses == ()
