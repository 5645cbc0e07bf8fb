"""Start a network from one that sees fewer channels: it says exactly the same until it learns what the others mean."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from .network import RestorationNet

BLOCK = 8  # input features of the stem per aligned channel: space-to-depth


def can_extend(old: nn.Module, new: nn.Module) -> bool:
    """Whether two networks differ in nothing but channels that the new one has on top."""
    if not isinstance(old, RestorationNet) or not isinstance(new, RestorationNet):
        return False
    alike = dataclasses.replace(old.config, channels=new.config.channels) == new.config
    return alike and set(old.config.channels) <= set(new.config.channels)


@torch.no_grad()
def extend(old: nn.Module, new: nn.Module) -> None:
    """Give ``new`` the weights of ``old``; whatever joins channels that ``old`` does not know to the rest is zero.

    What the branch for the surroundings computes stays as it was drawn: only the way out of it starts at zero, so that
    it learns from the first step.

    Args:
        old: sees some of the channels of ``new``, in any order.
        new: changed in place.

    Raises:
        ValueError: networks that differ in more than their channels.
    """
    if not (isinstance(old, RestorationNet) and isinstance(new, RestorationNet) and can_extend(old, new)):
        told = [getattr(network, "config", type(network).__name__) for network in (old, new)]
        raise ValueError(f"extend: {told[1]} is not {told[0]} with further channels")
    given, state = old.state_dict(), new.state_dict()
    for name, value in state.items():
        if name == "stem.weight":
            value.copy_(_stem(old, new, given[name]))
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
        target = columns[old.config.channels[index]]
        wide[:, BLOCK * target : BLOCK * (target + 1)] = weight[:, BLOCK * place : BLOCK * (place + 1)]
    return wide
