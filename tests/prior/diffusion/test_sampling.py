"""The samplers with denoisers that are exact: what comes out must be distributed as the data."""

import itertools
import math

import numpy as np
import pytest
import torch

from unghost.core.schedule import alphas_cumprod, flip_log_odds, strided_timesteps
from unghost.prior.diffusion.formulas import kept_share
from unghost.prior.diffusion.model import DiffusionConfig, DiffusionNet
from unghost.prior.diffusion.sampling import sample_bernoulli, sample_cubes, sample_gaussian
from unghost.prior.networks.restoration import NetworkConfig

ONE = torch.full((1,), 0.1)
TINY = NetworkConfig(widths=(8, 8, 8), condition_width=8)


def seeded(seed=0):
    return [torch.Generator().manual_seed(seed)]


def normal_data(mean, deviation):
    """E[x0 | xt] for x0 ~ N(mean, deviation^2), voxels independent."""

    def denoise(xt, timestep, edge_fraction):
        kept = kept_share(timestep, xt).float()
        gain = deviation**2 * kept.sqrt() / (kept * deviation**2 + 1 - kept)
        return mean + gain * (xt - kept.sqrt() * mean)

    return denoise


def patterns_under_noise(patterns, shares):
    """E[x0 | xt] for x0 one of a few rows ``(K, V)`` with given shares; xt ``(..., V)``, Gaussian noise."""

    def denoise(xt, timestep, edge_fraction):
        kept = kept_share(timestep, xt).double()
        distance = ((xt.double()[..., None, :] - kept.sqrt()[..., None] * patterns.double()) ** 2).sum(-1)
        weight = torch.softmax(torch.log(shares.double()) - distance / (2 * (1 - kept)), dim=-1)
        return (weight @ patterns.double()).float()

    return denoise


def patterns_under_flips(patterns, shares):
    """The same for flipped bits; rows are of -1 and +1."""
    odds = torch.from_numpy(flip_log_odds())

    def denoise(xt, timestep, edge_fraction):
        agreement = (xt.double()[..., None, :] * patterns.double()).sum(-1)
        weight = torch.softmax(torch.log(shares.double()) + odds[timestep] * agreement / 2, dim=-1)
        return (weight @ patterns.double()).float()

    return denoise


def ladder_deviation(deviation, steps, eta):
    """What the Gaussian sampler must give for N(0, deviation^2), followed in closed form: every step is linear."""
    kept = np.append(alphas_cumprod(), 1.0)
    variance = 1.0
    ladder = [*strided_timesteps(steps).tolist(), -1]
    for step, following in itertools.pairwise(ladder):
        late, early = kept[step], kept[following]
        gain = deviation**2 * math.sqrt(late) / (late * deviation**2 + 1 - late)  # x0 = gain xt
        added = eta**2 * (1 - late / early) * (1 - early) / (1 - late)
        epsilon = (1 - math.sqrt(late) * gain) / math.sqrt(1 - late)
        factor = math.sqrt(early) * gain + math.sqrt(max(0.0, 1 - early - added)) * epsilon
        variance = factor**2 * variance + added
    return math.sqrt(variance)


def test_ancestral_sampling_of_a_normal_distribution():
    count = 40_000
    found = sample_gaussian(normal_data(0.4, 0.5), (1, count), ONE, generators=seeded())
    assert found.mean().item() == pytest.approx(0.4, abs=5 * 0.5 / math.sqrt(count))
    assert found.std().item() == pytest.approx(ladder_deviation(0.5, 1000, 1.0), rel=0.02)
    assert ladder_deviation(0.5, 1000, 1.0) == pytest.approx(0.5, rel=0.02)  # and that is the data's, nearly
    skew = ((found - found.mean()) ** 3).mean() / found.std() ** 3
    kurtosis = ((found - found.mean()) ** 4).mean() / found.std() ** 4
    assert abs(skew) < 0.06
    assert abs(kurtosis - 3) < 0.12


@pytest.mark.parametrize(("steps", "eta"), [(1000, 0.0), (100, 0.0), (100, 1.0), (20, 0.5), (1, 1.0)])
def test_strided_sampling_follows_its_closed_form(steps, eta):
    found = sample_gaussian(normal_data(0.0, 0.5), (1, 40_000), ONE, generators=seeded(1), steps=steps, eta=eta)
    expected = ladder_deviation(0.5, steps, eta)
    assert found.std().item() == pytest.approx(expected, rel=0.02, abs=1e-5)


def test_more_steps_come_closer_to_the_data():
    errors = [abs(ladder_deviation(0.5, steps, 0.0) - 0.5) for steps in (10, 30, 100, 1000)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "eta"), [(1000, 1.0), (100, 1.0), (100, 0.0)])
def test_two_points_keep_their_shares(steps, eta):
    """A voxel that is +1 with probability 0.3."""
    denoise = patterns_under_noise(torch.tensor([[1.0], [-1.0]]), torch.tensor([0.3, 0.7]))
    count = 8_000
    found = sample_gaussian(denoise, (1, count, 1), ONE, generators=seeded(2), steps=steps, eta=eta)
    assert (found.abs() - 1).abs().max() < 1e-3
    assert (found > 0).float().mean().item() == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / count) + 0.005)


PATTERNS = torch.tensor([[1.0, 1, 1, -1, -1, -1], [-1, -1, -1, 1, 1, 1], [1, -1, 1, -1, 1, -1]])
SHARES = torch.tensor([0.5, 0.3, 0.2])


def shares_of(found, patterns):
    """Share of rows that equal each pattern, and of those that equal none."""
    same = (found.sign()[:, None] == patterns).all(-1)
    return [*same.float().mean(0).tolist(), (~same.any(1)).float().mean().item()]


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1000, 200])
def test_gaussian_samples_are_whole_patterns(steps):
    """Voxels that depend on one another: no mixtures, and each pattern as often as in the data."""
    denoise = patterns_under_noise(PATTERNS, SHARES)
    found = sample_gaussian(denoise, (1, 4000, 6), ONE, generators=seeded(3), steps=steps)[0]
    *shares, none = shares_of(found, PATTERNS)
    assert none < 0.002
    assert shares == pytest.approx(SHARES.tolist(), abs=4 * math.sqrt(0.25 / 4000))


def test_bits_of_one_voxel_are_exact_at_any_stride():
    denoise = patterns_under_flips(torch.tensor([[1.0], [-1.0]]), torch.tensor([0.3, 0.7]))
    count = 20_000
    for steps in (1, 3, 50):
        found = sample_bernoulli(denoise, (1, count, 1), ONE, generators=seeded(steps), steps=steps)
        assert set(found.unique().tolist()) == {-1.0, 1.0}
        assert (found > 0).float().mean().item() == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / count))


@pytest.mark.slow
def test_bits_are_whole_patterns():
    denoise = patterns_under_flips(PATTERNS, SHARES)
    found = sample_bernoulli(denoise, (1, 4000, 6), ONE, generators=seeded(4))[0]
    *shares, none = shares_of(found, PATTERNS)
    assert none < 0.01
    assert shares == pytest.approx(SHARES.tolist(), abs=4 * math.sqrt(0.25 / 4000) + none)
    rough = sample_bernoulli(denoise, (1, 4000, 6), ONE, generators=seeded(4), steps=2)[0]
    assert shares_of(rough, PATTERNS)[-1] > 5 * none + 0.01  # as documented: few steps lose the agreement


@pytest.fixture(scope="module")
def networks():
    torch.manual_seed(0)
    return {name: DiffusionNet(DiffusionConfig(name, TINY)).eval() for name in ("epsilon", "x0", "bernoulli")}


@pytest.mark.parametrize("objective", ["epsilon", "x0", "bernoulli"])
def test_cube_i_depends_on_seed_and_i_alone(networks, objective):
    several = sample_cubes(networks[objective], count=3, edge_fraction=0.1, seed=7, steps=3, batch_size=2)
    single = sample_cubes(networks[objective], count=1, edge_fraction=0.1, seed=7, steps=3)
    other = sample_cubes(networks[objective], count=1, edge_fraction=0.1, seed=8, steps=3)
    assert several.shape == (3, 1, 32, 32, 32)
    assert several.abs().max() <= 1
    assert ((several[:1] - single).abs() > 1e-4).float().mean() < 1e-3
    assert not torch.equal(single, other)
    assert not torch.equal(several[0], several[1])


def test_steps_are_reported_and_deterministic_sampling_draws_once(networks):
    seen = []
    generators = seeded(9)
    sample_gaussian(
        normal_data(0.0, 0.5),
        (1, 5),
        ONE,
        generators=generators,
        steps=4,
        eta=0.0,
        on_step=lambda step, x0: seen.append((step, x0.shape)),
    )
    assert seen == [(999, (1, 5)), (666, (1, 5)), (333, (1, 5)), (0, (1, 5))]
    fresh = seeded(9)[0]
    torch.randn((5,), generator=fresh)
    assert torch.equal(fresh.get_state(), generators[0].get_state())


def test_refusals(networks):
    with pytest.raises(ValueError, match="eta must lie in"):
        sample_gaussian(normal_data(0, 1), (1, 2), ONE, generators=seeded(), eta=1.5)
    with pytest.raises(ValueError, match=r"count must lie in \[1, 1000\]"):
        sample_gaussian(normal_data(0, 1), (1, 2), ONE, generators=seeded(), steps=1001)
    with pytest.raises(ValueError, match=r"edge_fraction must have shape \(2,\)"):
        sample_bernoulli(normal_data(0, 1), (2, 2), ONE, generators=seeded())
    with pytest.raises(ValueError, match="one for each of 1 samples, got 2"):
        sample_bernoulli(normal_data(0, 1), (1, 2), ONE, generators=seeded() * 2)
    with pytest.raises(ValueError, match="shape must start with one sample"):
        sample_bernoulli(normal_data(0, 1), (0, 2), ONE[:0], generators=[])
    for wrong, message in (
        ({"count": 0}, "count and batch_size must be >= 1"),
        ({"edge_fraction": 0.0}, "edge_fraction must be finite and > 0"),
        ({"eta": 0.5}, "eta must be 1 for objective 'bernoulli'"),
    ):
        with pytest.raises(ValueError, match=message):
            sample_cubes(networks["bernoulli"], **{"count": 1, "edge_fraction": 0.1, "seed": 0, **wrong})
