import numpy as np
import pytest
import torch

from unghost.fields.frequency_mlp import FrequencyConfig, FrequencyField, frequency_encode


def test_encoding_by_hand():
    # f = 0.25 and 0.5 at x = 1: angles pi/2 and pi; at y = 0.5: pi/4 and pi/2; at z = 0: 0
    found = frequency_encode(torch.tensor([[1.0, 0.5, 0.0]]), torch.tensor([0.25, 0.5]))[0]
    half = 2**-0.5
    expected = [1, 0.5, 0, 1, 0, half, 1, 0, 0, 0, -1, half, 0, 1, 1]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("resolution", [4, 64, 80, 127, 128, 160])
@pytest.mark.parametrize("contracted", [True, False])
def test_field_pitch_is_half_the_shortest_wavelength(resolution, contracted):
    field = FrequencyField(FrequencyConfig(resolution, contract=contracted))
    side = 4.0 if contracted else 2.0
    assert field.field_pitch == pytest.approx(side / resolution)
    wavelengths = 1.0 / field.frequencies
    assert wavelengths[-1].item() == pytest.approx(2 * field.field_pitch)
    assert side / 2 < wavelengths[0] <= side * (1 + 1e-6)  # the longest fills the cube at most once, and nearly
    torch.testing.assert_close(wavelengths[:-1], 2 * wavelengths[1:])
    # its finest input goes from its minimum to its maximum within one pitch
    start = field.field_pitch / 2
    points = torch.tensor([[start, 0.0, 0.0], [-start, 0.0, 0.0]])
    finest = field.encode(points)[:, 3 + field.config.octaves - 1]
    torch.testing.assert_close(finest, torch.tensor([1.0, -1.0]), atol=1e-5, rtol=0)


def test_gradient_equals_finite_differences():
    field = FrequencyField(FrequencyConfig(8, width=5, hidden=2)).double()
    positions = torch.rand(6, 3, generator=torch.Generator().manual_seed(0)) * 3 - 1.5
    encoded = field.encode(positions.double())

    def trunk(weight):
        return torch.func.functional_call(field.trunk, {"0.weight": weight}, (encoded,))

    assert torch.autograd.gradcheck(trunk, (field.trunk[0].weight.detach().clone().requires_grad_(),))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resolution": 2}, "FrequencyConfig: resolution must be >= 4, got 2"),
        ({"hidden": 0}, "width and hidden must be >= 1, got 64 and 0"),
        ({"initial_opacity": 0.0}, r"FrequencyConfig: initial_opacity must lie in \(0, 1\), got 0.0"),
    ],
)
def test_bad_configs_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        FrequencyConfig(**arguments)
