"""Trunk and heads as one compiled function: what `PolicyNetwork` does with one row per agent."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from phase_sumo.config import NetworkConfig
from phase_sumo.policy.native import TILES, Library, compiled


class TrunkKernel(Library):
    """Normalisation, trunk and both heads with matrix products in bf16, all else in fp32 (`trunk.cpp`)."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.library.kept_count.restype = ctypes.c_int64
        self.library.kept_count.argtypes = [ctypes.c_int64]

    def __call__(self, rows: Tensor, weights: list[Tensor]) -> Tensor:
        """Logits and value [B, A + 1] of rows [B, inputs].

        Args:
            weights: parameters of the normalisation, the trunk's layer, the policy's two and the value's two.
        """
        return _Trunk.apply(self, rows, *weights)


class _Trunk(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kernel: TrunkKernel, rows: Tensor, *weights: Tensor) -> Tensor:
        rows = rows.float().contiguous()
        kept = torch.empty(kernel.library.kept_count(len(rows)), dtype=torch.int16)
        out = torch.empty(len(rows), len(weights[7]) + 1)
        kernel.call("forward", len(rows), _pointers(weights), rows, kept, out)
        ctx.kernel = kernel
        ctx.save_for_backward(rows, kept, *weights)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        rows, kept, *weights = ctx.saved_tensors
        grad_rows, grad = torch.empty_like(rows), ctx.kernel.gradient()
        ctx.kernel.call(
            "backward", len(rows), _pointers(weights), rows, kept, grads[0].contiguous(), grad_rows, grad
        )
        return None, grad_rows, *_split(grad.sum(0) if len(grad) > 1 else grad[0], weights)


def _split(grad: Tensor, weights: list[Tensor]) -> tuple[Tensor, ...]:
    """The gradient of each of the weights, in which both heads' layers stand below one another."""
    inputs, trunk, head = len(weights[0]), len(weights[3]), len(weights[5])
    outputs = len(weights[7]) + 1
    shapes = ((inputs,), (inputs,), (trunk, inputs), (trunk,), (2 * head, trunk), (2 * head,))
    shapes += ((outputs, 2 * head), (outputs,))
    parts = grad.split([torch.Size(shape).numel() for shape in shapes])
    parts = [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
    hidden, hidden_bias, last, last_bias = parts[4:]
    policy = hidden[:head], hidden_bias[:head], last[:-1, :head], last_bias[:-1]
    value = hidden[head:], hidden_bias[head:], last[-1:, head:], last_bias[-1:]
    return *parts[:4], *policy, *value


def _pointers(weights: tuple[Tensor, ...] | list[Tensor]) -> ctypes.Array:
    return (ctypes.c_void_p * len(weights))(*(w.data_ptr() for w in weights))


@lru_cache
def load_trunk(config: NetworkConfig, inputs: int, actions: int) -> TrunkKernel | None:
    """The compiled function for a network; None where there is no compiler or the processor has no tiles."""
    if not TILES:
        return None
    sizes = {"INPUTS": inputs, "TRUNK": config.trunk, "HEAD": config.head, "ACTIONS": actions}
    library = compiled("trunk.cpp", sizes)
    kernel = None if library is None else TrunkKernel(library)
    return kernel if kernel is not None and kernel.library.is_ready() else None
