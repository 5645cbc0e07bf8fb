"""One run over several processes: each rank learns from its part of every batch, and all take the same steps.

Start them with ``torchrun --nproc-per-node N -m unghost.cli train …``. Rank r of N learns samples ``r B / N`` up to
``(r + 1) B / N`` of each batch of B, the very samples a single process would draw; gradients and loss are averaged over
ranks (parts are of one length and each cube counts alike, so that this is the mean over the batch), then every rank
clips, steps and averages its weights by itself, from equal numbers to equal numbers. Rank 0 alone writes. The result
is that of one process but for the order in which float32 sums are taken (4e-8 of a weight after six steps).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ...core.errors import InvalidArgument, UnghostError
from .batches import Batch

if TYPE_CHECKING:
    from .config import TrainConfig

TIMEOUT_SECONDS = 1800.0  # the others wait while rank 0 validates
TIMEOUT_VARIABLE = "UNGHOST_RANK_TIMEOUT"  # in seconds, to change that


class RankLost(UnghostError, RuntimeError):
    """Another process of the run is gone or did not answer; the last checkpoint is good."""


@dataclass(frozen=True)
class Group:
    """The processes of a run, as one of them sees it; a single process by default."""

    rank: int = 0
    size: int = 1
    timeout: float = TIMEOUT_SECONDS

    @property
    def first(self) -> bool:
        """Whether this is the one that writes."""
        return self.rank == 0

    def check(self, config: TrainConfig) -> None:
        """Refuse a configuration whose batches cannot be shared out evenly."""
        if config.batch_size % self.size:
            raise InvalidArgument(
                f"train: batch_size must be a multiple of the number of processes, "
                f"got {config.batch_size} for {self.size}"
            )

    def share(self, batch: Batch) -> Batch:
        """This rank's rows of a whole batch."""
        if self.size == 1:
            return batch
        part = len(batch.labels) // self.size
        rows = slice(self.rank * part, (self.rank + 1) * part)
        return type(batch)(**{name: value[rows] for name, value in vars(batch).items()})

    def average(self, network: nn.Module, loss: Tensor) -> Tensor:
        """Replace the gradients by their mean over ranks, in place; the mean of the loss.

        Every rank gets the same bits: if a loss is not finite somewhere, it is not finite everywhere.

        Raises:
            RankLost: another rank is gone, or silent for ``timeout``.
        """
        if self.size == 1:
            return loss
        gradients = [value.grad for value in network.parameters() if value.grad is not None]
        flat = torch.cat([loss.detach().reshape(1).float(), *(gradient.reshape(-1) for gradient in gradients)])
        self._collect("averaging gradients", torch.distributed.all_reduce, flat)
        flat /= self.size
        parts = torch.split(flat[1:], [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts):
            gradient.copy_(part.view(gradient.shape))
        return flat[0]

    def agree(self, value: float) -> float:
        """Rank 0's value, on every rank.

        Raises:
            RankLost: as :meth:`average`.
        """
        if self.size == 1:
            return value
        device = "cuda" if torch.distributed.get_backend() == "nccl" else "cpu"
        held = torch.tensor([value], dtype=torch.float64, device=device)
        self._collect("agreeing on the time", lambda tensor: torch.distributed.broadcast(tensor, 0), held)
        return float(held[0])

    def _collect(self, what: str, call: Any, tensor: Tensor) -> None:
        try:
            call(tensor)
        except RuntimeError as error:  # torch's errors of communication have no narrower class in common
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise RankLost(
                f"train: rank {self.rank} of {self.size}, {what}: another rank is gone or was silent for "
                f"{self.timeout:g} s ({reason})"
            ) from error


@contextlib.contextmanager
def joined(device: str) -> Iterator[Group]:
    """Join the processes that ``torchrun`` started, as its environment variables say; alone without them.

    gloo on CPUs, nccl on GPUs, where each process takes the GPU of its ``LOCAL_RANK``.

    Raises:
        ValueError: a timeout that is no positive number.
        RankLost: the others did not come.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield Group()
        return
    from torch import distributed

    group = Group(int(os.environ["RANK"]), size, _timeout())
    cuda = torch.device(device).type == "cuda"
    if cuda:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    try:
        distributed.init_process_group(
            "nccl" if cuda else "gloo", rank=group.rank, world_size=size, timeout=timedelta(seconds=group.timeout)
        )
    except RuntimeError as error:
        raise RankLost(f"train: rank {group.rank} of {size}: the others did not come ({error})") from error
    try:
        yield group
    finally:
        distributed.destroy_process_group()


def _timeout() -> float:
    text = os.environ.get(TIMEOUT_VARIABLE, str(TIMEOUT_SECONDS))
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise InvalidArgument(f"train: {TIMEOUT_VARIABLE} must be a number of seconds > 0, got {text!r}")
    return seconds
