from dataclasses import dataclass

import numpy as np
import pytest

from unghost.core.channels import CHANNEL_NAMES, UNKNOWN
from unghost.prior.training.batches import BLIND_SEVERITY, Mixture
from unghost.prior.training.blend import Blend, Online, split_batch


@dataclass
class Counted:
    """Pairs whose values say which sample they are."""

    first: int
    count: int

    def __post_init__(self):
        numbers = np.arange(self.first, self.first + self.count)
        self.channels = np.broadcast_to((numbers / 1000)[:, None, None, None, None], (self.count, 1, 32, 32, 32))
        self.labels = np.zeros((self.count, 32, 32, 32), np.uint8)
        self.severity = np.full(self.count, 0.5, np.float32)
        self.edge_fraction = (0.1 + numbers / 1000).astype(np.float32)


class Counting:
    """An endless source that knows whether its stream was closed."""

    def __init__(self):
        self.closed = 0

    def stream(self, first_step, batch_size):
        try:
            while True:
                yield Counted(first_step * batch_size, batch_size)
                first_step += 1
        finally:
            self.closed += 1


@pytest.fixture
def mixture(shard_paths):
    return Mixture([(shard_paths["seen"], 1.0)], seed=0, channels=CHANNEL_NAMES)


def take(blend, first, count):
    stream = blend.stream(first)
    batches = [next(stream) for _ in range(count)]
    stream.close()
    return batches


def test_shares_by_hand():
    assert split_batch(48, []) == [48]
    assert split_batch(48, [0.3, 0.2]) == [24, 14, 10]
    assert split_batch(4, [0.01]) == [3, 1]
    assert split_batch(5, [1.0]) == [0, 5]


@pytest.mark.parametrize("shares", [[0.0], [-0.1], [1.5], [0.6, 0.6], [float("nan")]])
def test_impossible_shares_are_refused(shares):
    with pytest.raises(ValueError, match="split_batch: "):
        split_batch(10, shares)


def test_parts_of_a_batch(mixture):
    source = Counting()
    blend = Blend(mixture, [Online("counted", 0.4, source)], batch_size=5, channels=CHANNEL_NAMES, seed=1)
    for step, batch in zip((3, 4), take(blend, 3, 2)):
        stored = mixture.batch(step, 3)
        assert np.array_equal(batch.channels[:3], stored.channels)
        assert np.array_equal(batch.timestep[:3], stored.timestep)
        np.testing.assert_allclose(batch.channels[3:, 0, 0, 0, 0], [2 * step / 1000, (2 * step + 1) / 1000], rtol=1e-6)
        assert (batch.channels[3:, 1:] == UNKNOWN).all()
        assert batch.harvested.tolist() == [True] * 3 + [False] * 2
        assert batch.channels.dtype == np.float32
        assert batch.timestep.dtype == np.int64
    assert source.closed == 1


def test_a_stream_that_starts_later_goes_on_with_the_same_batches(mixture):
    def blend():
        online = [Online("one", 0.2, Counting()), Online("two", 0.4, Counting())]
        return Blend(mixture, online, batch_size=5, channels=CHANNEL_NAMES, seed=1)

    whole, later = take(blend(), 0, 4), take(blend(), 2, 2)
    for first, second in zip(whole[2:], later):
        for name in ("channels", "labels", "timestep", "edge_fraction", "harvested"):
            assert np.array_equal(getattr(first, name), getattr(second, name))
    drawn = np.concatenate([batch.timestep[2:] for batch in take(blend(), 0, 60)])
    assert drawn.min() >= 499
    assert drawn.max() > 900 >= BLIND_SEVERITY * 999
    assert len(np.unique(drawn)) > 100


def test_online_alone_and_shards_alone(mixture):
    alone = Blend(None, [Online("counted", 1.0, Counting())], batch_size=3, channels=("signed_opacity",), seed=0)
    assert take(alone, 0, 1)[0].channels.shape == (3, 1, 32, 32, 32)
    plain = Blend(mixture, [], batch_size=3, channels=CHANNEL_NAMES, seed=0)
    assert np.array_equal(take(plain, 2, 1)[0].channels, mixture.batch(2, 3).channels)
    with pytest.raises(ValueError, match="Blend: no shards, and 3 of 5 cubes a step are left for them"):
        Blend(None, [Online("counted", 0.4, Counting())], batch_size=5, channels=CHANNEL_NAMES, seed=0)
    with pytest.raises(ValueError, match="Blend: shards, and 0 of 5"):
        Blend(mixture, [Online("counted", 1.0, Counting())], batch_size=5, channels=CHANNEL_NAMES, seed=0)


def test_a_source_that_fails_ends_the_others(mixture):
    class Failing:
        def stream(self, first_step, batch_size):
            yield Counted(0, batch_size)
            raise RuntimeError("no more")

    source = Counting()
    online = [Online("counted", 0.4, source), Online("failing", 0.2, Failing())]
    with pytest.raises(RuntimeError, match="no more"):
        take(Blend(mixture, online, batch_size=5, channels=CHANNEL_NAMES, seed=0), 0, 2)
    assert source.closed == 1
