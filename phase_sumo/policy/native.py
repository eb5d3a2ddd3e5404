"""Compiles `scene_encoder.cpp` for this machine and a network's sizes, and makes it a torch function."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import subprocess
import sys
import tempfile
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from phase_sumo.config import NetworkConfig
from phase_sumo.sim.compiler import cpp_compiler
from phase_sumo.sim.observation import PARTNER, ROAD, Observation

SOURCE = Path(__file__).with_name("scene_encoder.cpp")
HEADERS = ("vectors.h", "products_fp32.h", "products_bf16.h", "layers.h")
# -ffast-math but for its change of rounding in the whole process that loads the library
FAST = [
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros"),
    *("-fassociative-math", "-freciprocal-math"),
]
# the threads that torch keeps anyway
THREADS = ["-fopenmp"] if sys.platform == "linux" else []
FLAGS = ["-std=c++17", "-O3", "-march=native", *FAST, *THREADS, "-shared", "-fPIC"]
VECTOR = 16  # numbers in the kernel's vectors
_CAPABILITIES = getattr(torch.cpu, "get_capabilities", dict)()
TILES = sys.platform == "linux" and all(_CAPABILITIES.get(name) for name in ("amx_bf16", "avx512_bf16"))


class Kernel:
    """`SceneEncoder.forward` for fixed sizes; its result can be differentiated by the weights."""

    def __init__(self, library: Path) -> None:
        self.library = ctypes.CDLL(str(library))
        self.weight_count, self.pooled_count = self.library.weight_count(), self.library.pooled_count()

    def __call__(self, observation: Observation, weights: list[Tensor]) -> Tensor:
        return _Encode.apply(self, *self.inputs(observation), *weights)

    @staticmethod
    def inputs(observation: Observation) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features side by side in memory, as observations are made, and masks as bytes."""
        return (
            observation.partner.transpose(1, 2).contiguous(),
            observation.partner_mask.contiguous(),
            observation.road.transpose(1, 2).contiguous(),
            observation.road_mask.contiguous(),
        )

    def forward(self, weights: Tensor, inputs: tuple[Tensor, ...]) -> Tensor:
        """Pooled sets [B, pooled_count]."""
        pooled = torch.empty(len(inputs[0]), self.pooled_count)
        self._call(self.library.forward, weights, *inputs, pooled)
        return pooled

    def backward(self, weights: Tensor, inputs: tuple[Tensor, ...], grad: Tensor) -> Tensor:
        """Gradient of the weights [weight_count] for that of the result."""
        grad_weights = torch.empty(torch.get_num_threads(), self.weight_count)
        self._call(self.library.backward, weights, *inputs, grad.float().contiguous(), grad_weights)
        return grad_weights.sum(0)

    @staticmethod
    def _call(function: Any, weights: Tensor, *tensors: Tensor) -> None:
        count, threads = ctypes.c_int64(len(tensors[0])), torch.get_num_threads()
        function(count, threads, *(ctypes.c_void_p(t.data_ptr()) for t in (weights, *tensors)))


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kernel: Kernel, *tensors: Tensor) -> Tensor:
        inputs, weights = tensors[:4], tensors[4:]
        flat = torch.cat([w.flatten() for w in weights])
        ctx.kernel, ctx.shapes = kernel, [w.shape for w in weights]
        ctx.save_for_backward(flat, *inputs)
        return kernel.forward(flat, inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        flat, *inputs = ctx.saved_tensors
        grad = ctx.kernel.backward(flat, tuple(inputs), grads[0])
        parts = grad.split([shape.numel() for shape in ctx.shapes])
        return (None,) * 5 + tuple(p.view(s) for p, s in zip(parts, ctx.shapes, strict=True))


@lru_cache
def load_kernel(config: NetworkConfig, partners: int, points: int, bf16: bool = False) -> Kernel | None:
    """The kernel for a network and its set sizes, compiled once per machine.

    Args:
        bf16: matrix products of factors rounded to bf16, where the processor has tiles for them (AMX).

    Returns:
        None where there is no C++ compiler, where it fails (with a warning), or for sizes that fill no whole
        vectors.
    """
    whole = (partners, points, config.width, config.hidden, config.feedforward)
    compiler = cpp_compiler()
    if compiler is None or any(size % VECTOR for size in whole) or config.width % config.heads:
        return None
    sizes = {
        "WIDTH": config.width,
        "HIDDEN": config.hidden,
        "HEADS": config.heads,
        "FEEDFORWARD": config.feedforward,
        "SEEDS": config.seeds,
        "PARTNERS": partners,
        "POINTS": points,
        "PARTNER_FEATURES": len(PARTNER),
        "ROAD_FEATURES": len(ROAD),
    }
    definitions = [f"-D{name}={size}" for name, size in sizes.items()]
    tiles = bf16 and TILES and config.width // config.heads % VECTOR == 0
    try:
        kernel = Kernel(_compile([compiler, *FLAGS, *definitions, *(["-DBF16"] if tiles else [])]))
        return kernel if kernel.library.is_ready() else load_kernel(config, partners, points)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", None) or str(error).encode()).decode(errors="replace").strip()
        warnings.warn(f"the network runs in plain torch, several times slower: {reason}", stacklevel=2)
        return None


def _compile(command: list[str]) -> Path:
    """The shared library made by ``command`` from `SOURCE`; from the cache, if it was made before."""
    sources = [SOURCE.with_name(name).read_text() for name in (SOURCE.name, *HEADERS)]
    key = "\n".join([*command, _processor(), *sources])
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "phase_sumo"
    library = cache / f"scene_encoder-{hashlib.sha256(key.encode()).hexdigest()[:16]}.so"
    if not library.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            made = Path(folder) / library.name
            subprocess.run([*command, str(SOURCE), "-o", str(made)], check=True, capture_output=True)
            os.replace(made, library)  # whole, even if another process does the same
    return library


def _processor() -> str:
    """What ``-march=native`` depends on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return platform.machine() + "".join(sorted({x for x in lines if x.startswith(("flags", "Features"))}))
