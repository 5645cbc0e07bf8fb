import numpy as np
import pytest

from unghost.cleaning.sliding_window import grow, shrink, vote, window_starts, window_weight


@pytest.mark.parametrize("length", [1, 5, 15, 16, 17, 32, 33, 100, 128])
@pytest.mark.parametrize("stride", [8, 16, 24, 32])
def test_windows_cover_every_cell_alike(length, stride):
    starts = window_starts(length, 32, stride)
    cover = np.zeros(length, int)
    for start in starts:
        cover[max(start, 0) : max(start + 32, 0)] += 1
    assert cover.min() >= 32 // stride
    assert cover.max() <= -(-32 // stride)


def test_weights_favour_the_middle():
    weight = window_weight(32)
    assert weight.min() > 0
    assert weight[15, 15, 15] == weight.max()
    assert weight[0, 0, 0] < 0.01 * weight.max()


@pytest.mark.parametrize("shape", [(40, 33, 7), (1, 1, 1), (64, 64, 64)])
def test_the_identity_votes_for_what_is_there(kit, shape):
    signed = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    before = signed.copy()
    votes, _ = vote(
        signed, np.ones(shape, bool), denoiser=kit.numpy_denoiser(kit.identity), timestep=500, edge_fraction=0.1
    )
    np.testing.assert_allclose(votes, signed, atol=1e-5)
    assert (signed == before).all()


@pytest.mark.parametrize("kind", ["numpy_denoiser", "torch_denoiser"])
def test_skipping_changes_no_wanted_cell(kit, kind):
    rng = np.random.default_rng(1)
    signed = np.full((90, 50, 40), -1.0, dtype=np.float32)
    signed[3:9, 3:9, 3:9] = rng.uniform(0, 1, (6, 6, 6))
    signed[80:, 40:, 30:] = 1.0
    wanted = signed > -1

    def smear(channels):  # depends on the whole window
        return np.clip(channels - channels.mean(axis=(2, 3, 4), keepdims=True), -1, 1)

    kwargs = {"denoiser": getattr(kit, kind)(smear), "timestep": 10, "edge_fraction": 0.2}
    some, sent = vote(signed, wanted, **kwargs)
    every, all_sent = vote(signed, wanted, skip_empty=False, **kwargs)
    assert sent < all_sent / 2
    assert (some[wanted] == every[wanted]).all()


def test_progress_and_what_the_denoiser_is_told(kit):
    denoiser, seen = kit.numpy_denoiser(kit.identity), []
    vote(
        np.zeros((128, 64, 64), np.float32),
        np.ones((128, 64, 64), bool),
        denoiser=denoiser,
        timestep=7,
        edge_fraction=0.25,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1] == (225, 225)  # 9 x 5 x 5
    assert all((call[1] == 7).all() and (call[2] == np.float32(0.25)).all() for call in denoiser.calls)
    assert all(len(call[0]) <= 40 for call in denoiser.calls)


def test_shrink_and_grow():
    signed = np.full((3, 2, 5), -1.0, dtype=np.float32)
    signed[2, 1, 4] = 0.5
    small = shrink(signed, 2)
    assert small.shape == (2, 1, 3)
    assert small[1, 0, 2] == 0.5
    assert small.sum() == -5 + 0.5
    back = grow(small, 2, signed.shape)
    assert back.shape == signed.shape
    assert (back[2, :, 4] == 0.5).all()
    assert (back == 0.5).sum() == 2
    assert shrink(signed, 1) is signed
