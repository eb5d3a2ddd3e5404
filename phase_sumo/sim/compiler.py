"""The C++ compiler that makes simulator and network fast on a CPU, where there is one."""

from __future__ import annotations

from functools import cache

from torch._inductor.cpp_builder import get_cpp_compiler


@cache
def cpp_compiler() -> str | None:
    """The compiler that torch.compile uses; None if this machine has none."""
    try:
        return get_cpp_compiler()
    except Exception:  # torch's own class for it has no public name
        return None
