"""What a training run watches about itself: finite numbers and memory."""

from __future__ import annotations

import math
import resource
import sys

import torch

MEGABYTE = 1e6
RSS_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes; getrusage counts in different units


def is_finite(losses: dict[str, float], network: torch.nn.Module) -> bool:
    """Whether losses, gradients and the weights that came of them are numbers.

    The losses are those before each step, so the weights after the last one are looked at too.
    """
    weights = torch.stack([parameter.isfinite().all() for parameter in network.parameters()])
    return all(map(math.isfinite, losses.values())) and bool(weights.all())


def peak_memory(device: torch.device) -> dict[str, float]:
    """Most memory that the process has held so far, in MB: resident, and of the GPU where there is one."""
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * RSS_UNIT
    peak = {"peak_memory_mb": resident / MEGABYTE}
    if device.type == "cuda":
        peak["peak_gpu_memory_mb"] = torch.cuda.max_memory_allocated(device) / MEGABYTE
    return peak
