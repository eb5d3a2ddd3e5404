"""Compiles the network's C++ for this machine and a network's sizes, and makes torch functions of it."""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import platform
import subprocess
import sys
import tempfile
import warnings
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import platformdirs
import torch
from torch import Tensor

from phase_sumo.atomic_files import write_whole
from phase_sumo.config import NetworkConfig
from phase_sumo.sim.compiler import cpp_compiler
from phase_sumo.sim.observation import PARTNER, ROAD, Observation

HERE = Path(__file__).parent
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


def autocasts_to_bf16() -> bool:
    """Whether torch works out matrix products on the CPU in bf16 just now."""
    return torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu") == torch.bfloat16


class Library:
    """Compiled functions on tensors of agents; as many threads as torch has."""

    def __init__(self, file: Path) -> None:
        self.library = ctypes.CDLL(str(file))
        self.weight_count = int(self.library.weight_count())

    def call(self, name: str, count: int, *arguments: Tensor | ctypes.Array) -> None:
        """Call a function for ``count`` agents."""
        pointers = (
            ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.cast(a, ctypes.c_void_p)
            for a in arguments
        )
        self.library[name](ctypes.c_int64(count), torch.get_num_threads(), *pointers)

    def gradient(self) -> Tensor:
        """Memory for the gradient of the weights, of each thread."""
        return torch.empty(torch.get_num_threads(), self.weight_count)


class Kernel(Library):
    """`SceneEncoder.forward` for fixed sizes; its result can be differentiated by the weights."""

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
        pooled = torch.empty(len(inputs[0]), self.library.pooled_count())
        self.call("forward", len(pooled), weights, *inputs, pooled)
        return pooled

    def backward(self, weights: Tensor, inputs: tuple[Tensor, ...], grad: Tensor) -> Tensor:
        """Gradient of the weights [weight_count] for that of the result."""
        grad_weights = self.gradient()
        self.call("backward", len(grad), weights, *inputs, grad.float().contiguous(), grad_weights)
        return grad_weights.sum(0)


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
    if any(size % VECTOR for size in whole) or config.width % config.heads:
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
    tiles = bf16 and TILES and config.width // config.heads % VECTOR == 0
    library = compiled("scene_encoder.cpp", sizes | ({"BF16": 1} if tiles else {}))
    kernel = None if library is None else Kernel(library)
    if kernel is not None and not kernel.library.is_ready():
        return load_kernel(config, partners, points)
    return kernel


def compiled(source: str, definitions: dict[str, int]) -> Path | None:
    """The shared library made from ``source`` with macros defined; None without a compiler or if it fails."""
    compiler = cpp_compiler()
    if compiler is None:
        return None
    try:
        return _compile(
            [compiler, *FLAGS, *(f"-D{name}={size}" for name, size in definitions.items())], source
        )
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", None) or str(error).encode()).decode(errors="replace").strip()
        warnings.warn(f"the network runs in plain torch, several times slower: {reason}", stacklevel=3)
        return None


def _compile(command: list[str], source: str) -> Path:
    """The shared library made by ``command``; from the cache, if it was made before."""
    parts = [HERE / source, *sorted(HERE.glob("*.h"))]
    key = "\n".join([*command, _processor(), *(part.read_text(encoding="utf-8") for part in parts)])
    cache = _cache()
    library = cache / f"{parts[0].stem}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.so"
    if not _intact(library):
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            made = Path(folder) / library.name
            subprocess.run([*command, str(parts[0]), "-o", str(made)], check=True, capture_output=True)
            content = made.read_bytes()
            write_whole(library, content)
            write_whole(_digest_of(library), hashlib.sha256(content).hexdigest().encode())
    return library


@cache
def _cache() -> Path:
    """The folder for compiled libraries: the user's, or one for this process where that cannot be had."""
    try:
        folder = platformdirs.user_cache_path("phase_sumo", appauthor=False)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError, KeyError) as error:  # the last two: a user without home or name
        temporary = tempfile.TemporaryDirectory(prefix="phase_sumo-")
        atexit.register(temporary.cleanup)
        warnings.warn(
            f"there is no folder to keep compiled code in ({error}), so it is compiled for this run alone; "
            f"set XDG_CACHE_HOME to a folder that can be written",
            stacklevel=2,
        )
        return Path(temporary.name)


def _digest_of(library: Path) -> Path:
    return library.with_suffix(".sha256")


def _intact(library: Path) -> bool:
    """Whether a library is there as it was written: one that is cut off ends a process that loads it."""
    try:
        digest = _digest_of(library).read_text(encoding="ascii")
        return hashlib.sha256(library.read_bytes()).hexdigest() == digest
    except (OSError, UnicodeDecodeError):
        return False


def _processor() -> str:
    """What ``-march=native`` depends on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    return platform.machine() + "".join(sorted({x for x in lines if x.startswith(("flags", "Features"))}))
