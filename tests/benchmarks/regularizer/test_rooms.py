"""Options and parts of benchmarks/regularizer/rooms.py."""

import numpy as np
import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short

from benchmarks.regularizer import rooms


def test_short():
    check_short(rooms, rooms=(9,), steps=3)


@pytest.mark.parametrize(
    ("before", "labels", "others", "failed"),
    [
        ([0.9, 0.9, 0.0, 0.9], [1, 1, 1, 0], 2, False),
        ([0.9, 0.9, 0.0, 0.0], [1, 1, 1, 0], 2, True),  # no ghost
        ([0.0, 0.0, 0.0, 0.9], [1, 1, 1, 0], 2, True),  # no surface
        ([0.9, 0.9, 0.0, 0.9], [1, 1, 1, 0], 0, True),  # nobody else looks
    ],
)
def test_a_room_with_nothing_to_score_has_failed(before, labels, others, failed):
    room = object.__new__(rooms.FittedRoom)
    surface, free = rooms.SURFACE_LABEL, rooms.FREE_LABEL
    room.before, room.labels = np.array(before), np.where(np.array(labels) == 1, surface, free)
    room.others = ([None] * others, None)
    assert room.failed() == failed
