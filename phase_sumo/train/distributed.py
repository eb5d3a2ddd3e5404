"""One training by several processes, which `torchrun` starts: each has its share of the worlds.

Statistics, minibatch means and gradients are those of all samples together, so that the processes make the
update that one process with all the worlds would make. With one process everything here is an identity.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import Tensor, nn

from phase_sumo.errors import PhaseError

SEED_STRIDE = 1_000_003  # between the seeds of two processes


def start(wanted: str | None = None) -> torch.device:
    """Join the others if `torchrun` started this process: on GPUs, where there are any, through NCCL.

    Args:
        wanted: device of a process of its own, e.g. ``"cuda"``; None is the CPU.
    """
    if "WORLD_SIZE" not in os.environ:
        return _device(wanted or "cpu")
    if wanted:
        raise PhaseError(
            f"--device {wanted}: under torchrun every process has a device of its own; leave it out"
        )
    local = int(os.environ["LOCAL_RANK"])
    device = torch.device("cuda", local) if torch.cuda.is_available() else torch.device("cpu")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return device


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        raise PhaseError(f"--device {name}: not here; take cpu, or cuda where torch finds a GPU") from None
    return device


def stop() -> None:
    """Leave the others."""
    if dist.is_initialized():
        dist.destroy_process_group()


def rank() -> int:
    """Number of this process, from 0; the first one writes the run's files."""
    return dist.get_rank() if dist.is_initialized() else 0


def size() -> int:
    return dist.get_world_size() if dist.is_initialized() else 1


@contextmanager
def first_before_others() -> Iterator[None]:
    """Let the first process do alone what the others then find done."""
    if size() > 1 and rank() > 0:
        dist.barrier()
    yield
    if size() > 1 and rank() == 0:
        dist.barrier()


def own_seed(seed: int) -> int:
    return seed + SEED_STRIDE * rank()


def share(worlds: int) -> tuple[int, int]:
    """This process has every n-th of the worlds from the k-th on: (k, n)."""
    if worlds < size():
        raise PhaseError(f"{worlds} worlds are too few for {size()} processes; start fewer with torchrun")
    return rank(), size()


def total(values: Tensor) -> Tensor:
    """Sum over the processes, element by element."""
    if size() == 1:
        return values
    values = values.clone()
    dist.all_reduce(values)
    return values


def totals(numbers: list[float]) -> list[float]:
    """`total` of plain numbers."""
    if size() == 1:
        return numbers
    device = "cuda" if dist.get_backend() == "nccl" else "cpu"
    return total(torch.tensor(numbers, dtype=torch.float64, device=device)).tolist()


def anywhere(flag: bool) -> bool:
    """Whether the flag is set in any process."""
    return totals([float(flag)])[0] > 0


def mean(values: Tensor) -> Tensor:
    """Mean of the values [S] of all processes."""
    (count,) = totals([values.numel()])
    return total(values.sum()) / max(count, 1)


def joint(values: Tensor) -> Tensor:
    """The values [S] of all processes in a row, however many each has."""
    if size() == 1:
        return values
    counts = [int(n) for n in totals([len(values) * (r == rank()) for r in range(size())])]
    padded = F.pad(values, (0, max(counts) - len(values)))
    parts = [torch.empty_like(padded) for _ in counts]
    dist.all_gather(parts, padded)
    return torch.cat([part[:count] for part, count in zip(parts, counts, strict=True)])


def sum_gradients(network: nn.Module) -> None:
    """Replace every gradient by its sum over the processes, in one message."""
    if size() == 1:
        return
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    summed = total(torch.cat([g.flatten() for g in gradients]))
    for gradient, part in zip(gradients, summed.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(part.view_as(gradient))


def gather(state: Any) -> Any:
    """The processes' states in a list, on the CPU, for a checkpoint; one process's own as it is."""
    if size() == 1:
        return state
    buffer = io.BytesIO()
    torch.save(state, buffer)
    parts: list[Any] = [None] * size()
    dist.all_gather_object(parts, buffer.getvalue())
    return [torch.load(io.BytesIO(part), map_location="cpu", weights_only=True) for part in parts]


def own(gathered: Any) -> Any:
    """This process's part of what `gather` returned, perhaps in an earlier run."""
    count = len(gathered) if isinstance(gathered, list) else 1
    if count != size():
        raise PhaseError(
            f"the run was made by {count} processes, not {size()}; resume it with torchrun and as many"
        )
    return gathered[rank()] if count > 1 else gathered
