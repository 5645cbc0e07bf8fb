import pytest
import torch

from unghost.prior.training.objective import interesting_voxels, restoration_loss


def empty_case():
    signed = torch.full((1, 1, 8, 8, 8), -1.0)
    labels = torch.zeros(1, 8, 8, 8, dtype=torch.uint8)
    return signed, labels


def test_interesting_is_a_dilated_union():
    signed, labels = empty_case()
    signed[0, 0, 1, 1, 1] = 0.5
    labels[0, 7, 7, 7] = 1
    mask = interesting_voxels(signed, labels)
    # 27 voxels around (1, 1, 1), 8 in the corner around (7, 7, 7)
    assert mask.sum() == 27 + 8
    assert mask[0, 0, 0, 0, 0]
    assert mask[0, 0, 6, 6, 6]
    assert not mask[0, 0, 3, 1, 1]


def test_threshold_of_interest_is_opacity_a_tenth():
    signed, labels = empty_case()
    signed[0, 0, 4, 4, 4] = -0.81  # opacity .095
    assert not interesting_voxels(signed, labels).any()
    signed[0, 0, 4, 4, 4] = -0.79  # opacity .105
    assert interesting_voxels(signed, labels).sum() == 27


def test_loss_by_hand():
    signed, labels = empty_case()
    logits = torch.zeros_like(signed)
    assert restoration_loss(logits, labels, signed, interesting_weight=4.0).item() == pytest.approx(0.693147, abs=1e-5)
    labels[0, 4, 4, 4] = 1
    logits[0, 0, 4, 4, 4] = 2.0
    # 26 neighbours and the voxel itself weigh 4, the other 485 weigh 1; ln 2 everywhere but log(1 + e^-2) in one
    expected = (4 * 0.126928 + (26 * 4 + 485) * 0.693147) / (27 * 4 + 485)
    assert restoration_loss(logits, labels, signed, interesting_weight=4.0).item() == pytest.approx(expected, abs=1e-5)


def test_ignored_voxels_have_no_gradient_and_others_do():
    signed, labels = empty_case()
    labels[0, :4] = 2
    logits = torch.zeros_like(signed, requires_grad=True)
    restoration_loss(logits, labels, signed, interesting_weight=4.0).sum().backward()
    assert (logits.grad[0, 0, :4] == 0).all()
    assert (logits.grad[0, 0, 4:] > 0).all()


def test_nothing_valid_gives_zero():
    signed, labels = empty_case()
    labels[:] = 2
    assert restoration_loss(torch.ones_like(signed), labels, signed, interesting_weight=4.0).item() == 0.0


def test_is_per_sample_and_leaves_inputs():
    signed, labels = empty_case()
    signed, labels = signed.repeat(2, 1, 1, 1, 1), labels.repeat(2, 1, 1, 1)
    logits = torch.stack([torch.zeros(1, 8, 8, 8), torch.full((1, 8, 8, 8), 3.0)])
    kept = (logits.clone(), labels.clone(), signed.clone())
    losses = restoration_loss(logits, labels, signed, interesting_weight=1.0)
    assert losses.tolist() == pytest.approx([0.693147, 3.048587], abs=1e-5)  # ln 2, ln(1 + e^3)
    assert all(torch.equal(a, b) for a, b in zip(kept, (logits, labels, signed)))


def test_keep_weight_acts_on_opaque_surface_alone():
    signed, labels = empty_case()
    labels[0, 4, 4, 4] = labels[0, 4, 4, 5] = 1
    signed[0, 0, 4, 4, 4] = signed[0, 0, 1, 1, 1] = 0.5  # true surface that is there, and a ghost
    logits = torch.zeros_like(signed, requires_grad=True)
    gradients = []
    for keep in (None, torch.tensor([5.0])):
        loss = restoration_loss(logits, labels, signed, interesting_weight=4.0, keep_weight=keep)
        (gradient,) = torch.autograd.grad(loss.sum(), logits)
        gradients.append(gradient[0, 0] / gradient[0, 0, 7, 7, 7])  # in units of a plain empty voxel's
    ratio = gradients[1] / gradients[0]
    assert ratio[4, 4, 4].item() == pytest.approx(5.0)
    ratio[4, 4, 4] = 1.0
    assert torch.allclose(ratio, torch.ones_like(ratio))


def test_keep_weight_moves_the_decision_to_its_odds():
    """A constant logit fitted to 9 ghosts for each true voxel ends at x0_pred = 0 if the true one weighs 9."""
    signed, labels = torch.full((1, 1, 10, 10, 10), 0.5), torch.zeros(1, 10, 10, 10, dtype=torch.uint8)
    labels.view(-1)[::10] = 1
    logit = torch.zeros((), requires_grad=True)
    loss = restoration_loss(
        logit.expand_as(signed), labels, signed, interesting_weight=4.0, keep_weight=torch.tensor([9.0])
    )
    loss.sum().backward()
    assert logit.grad.abs() < 1e-6


def test_errors():
    signed, labels = empty_case()
    with pytest.raises(ValueError, match="interesting_weight must be > 0"):
        restoration_loss(signed, labels, signed, interesting_weight=0.0)
    with pytest.raises(ValueError, match="must be \\(N, 1, R, R, R\\)"):
        restoration_loss(signed, labels[:, None], signed, interesting_weight=1.0)
