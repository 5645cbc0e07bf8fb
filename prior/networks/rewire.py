"""Start a network from one with other channels: it says the same until it learns what its own mean."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from ...core.channels import SURROUNDINGS, UNKNOWN
from ...core.errors import InvalidArgument
from .restoration import RestorationNet

BLOCK = 8  # input features of the stem per aligned channel: space-to-depth


def can_rewire(old: nn.Module, new: nn.Module) -> bool:
    """Whether two networks differ in nothing but their channels, and the new one still has the surroundings.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES, RestorationNet
        >>> can_rewire(RestorationNet(SIZES["xs"]), RestorationNet(SIZES["s"]))
        False
    """
    if not isinstance(old, RestorationNet) or not isinstance(new, RestorationNet):
        return False
    alike = dataclasses.replace(old.config, channels=new.config.channels) == new.config
    return alike and SURROUNDINGS not in set(old.config.channels) - set(new.config.channels)


@torch.no_grad()
def rewire(old: nn.Module, new: nn.Module) -> None:
    """Give ``new`` the weights of ``old``; whatever joins channels that ``old`` does not know to the rest is zero.

    Channels that ``new`` does without are unknown for good: what a cube full of that adds moves into the bias of the
    first convolution, which is exact but for the outermost two voxels.

    What the branch for the surroundings computes stays as it was drawn: only the way out of it starts at zero, so that
    it learns from the first step.

    Args:
        old: with other channels, in any order.
        new: changed in place.

    Raises:
        ValueError: networks that differ in more than their channels, or surroundings to be done without.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES, RestorationNet
        >>> old = RestorationNet(SIZES["xs"])
        >>> new = RestorationNet(dataclasses.replace(SIZES["xs"], channels=("signed_opacity", "view_count")))
        >>> rewire(old, new)  # new now answers as old does, whatever its second channel holds
    """
    if not (isinstance(old, RestorationNet) and isinstance(new, RestorationNet) and can_rewire(old, new)):
        told = [getattr(network, "config", type(network).__name__) for network in (old, new)]
        raise InvalidArgument(f"rewire: {told[1]} is not {told[0]} with other channels (surroundings must stay)")
    given, state = old.state_dict(), new.state_dict()
    for name, value in state.items():
        if name == "stem.weight":
            value.copy_(_stem(old, new, given[name]))
        elif name == "stem.bias":
            value.copy_(given[name] + UNKNOWN * _dropped(old, new, given["stem.weight"]))
        elif name == "condition.0.weight":
            value.zero_()
            value[:, : given[name].shape[1]] = given[name]
        elif name in given:
            value.copy_(given[name])
        elif name == "context.project.weight":
            value.zero_()
    new.load_state_dict(state)


def _stem(old: RestorationNet, new: RestorationNet, weight: Tensor) -> Tensor:
    """The first convolution's weights with the columns of each known channel where the new network has them."""
    wide = weight.new_zeros(weight.shape[0], BLOCK * len(new.config.aligned), *weight.shape[2:])
    columns = {new.config.channels[index]: place for place, index in enumerate(new.config.aligned)}
    for place, index in enumerate(old.config.aligned):
        target = columns.get(old.config.channels[index])
        if target is None:
            continue
        wide[:, BLOCK * target : BLOCK * (target + 1)] = weight[:, BLOCK * place : BLOCK * (place + 1)]
    return wide


def _dropped(old: RestorationNet, new: RestorationNet, weight: Tensor) -> Tensor:
    """``(widths[0],)``: what the first convolution adds for channels of ones that the new network does without."""
    gone = [
        column
        for place, index in enumerate(old.config.aligned)
        if old.config.channels[index] not in new.config.channels
        for column in range(BLOCK * place, BLOCK * (place + 1))
    ]
    return weight[:, gone].sum(dim=(1, 2, 3, 4))
