"""The compiled scene encoder does what the torch operations do, for results and gradients."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import platformdirs
import pytest
import torch
from torch import Tensor

from phase_sumo.config import NetworkConfig
from phase_sumo.policy import native
from phase_sumo.policy.scene_encoder import SceneEncoder, softmax_with_zero
from phase_sumo.sim.compiler import cpp_compiler
from phase_sumo.sim.observation import Observation
from tests.helpers.observations import observation

compiled = pytest.mark.skipif(cpp_compiler() is None, reason="no C++ compiler here")
SIZES = [NetworkConfig(), NetworkConfig(width=48, hidden=32, heads=3, feedforward=16, seeds=5)]


def encoder(config: NetworkConfig) -> SceneEncoder:
    torch.manual_seed(1)
    return SceneEncoder(config)


def gradients(net: SceneEncoder, pooled: Tensor) -> list[Tensor]:
    towards = torch.randn(pooled.shape, generator=torch.Generator().manual_seed(2))
    return list(torch.autograd.grad((pooled * towards).sum(), list(net.parameters())))


def seen() -> Observation:
    """Some agents, one that sees no partner and one that sees no road."""
    result = observation(37)
    result.partner_mask[3] = False
    result.road_mask[5] = False
    return result


@compiled
@pytest.mark.parametrize("config", SIZES)
@pytest.mark.parametrize("threads", [1, 2])
def test_results_and_gradients_are_those_of_torch(config: NetworkConfig, threads: int):
    net, before = encoder(config), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        ours, theirs = net(seen()), net.reference(seen())
        assert ours.grad_fn is not None and "Encode" in ours.grad_fn.name()
        torch.testing.assert_close(ours, theirs, atol=2e-6, rtol=1e-5)
        for mine, right in zip(gradients(net, ours), gradients(net, theirs), strict=True):
            torch.testing.assert_close(mine, right, atol=1e-5 * float(right.abs().max()), rtol=1e-4)
    finally:
        torch.set_num_threads(before)


@compiled
@pytest.mark.skipif(not native.TILES, reason="no tiles for bf16 here")
@pytest.mark.parametrize("config", SIZES)
@pytest.mark.parametrize("threads", [1, 2])
def test_products_in_bf16_are_off_by_their_rounding(config: NetworkConfig, threads: int):
    net, before = encoder(config), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.autocast("cpu", torch.bfloat16):
            ours, theirs = net(seen()), net.reference(seen()).float()
        right = net.reference(seen())
        mine, exact = gradients(net, ours), gradients(net, right)
        off, allowed = (ours - right).norm(), (theirs - right).norm()
        assert 0.01 * allowed < off < allowed  # rounded, but less often than torch does
        rounding = [(g - e).norm() / e.norm() for g, e in zip(gradients(net, theirs), exact, strict=True)]
        for gradient, e, r in zip(mine, exact, rounding, strict=True):
            assert (gradient - e).norm() / e.norm() < max(2.0 * float(r), 0.02)
    finally:
        torch.set_num_threads(before)


@compiled
@pytest.mark.skipif(not native.TILES, reason="no tiles for bf16 here")
def test_what_an_agent_gives_does_not_depend_on_the_others():
    net = encoder(SIZES[0])
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        together = net(seen())
        alone = torch.cat([net(seen().map(lambda t, i=i: t[i : i + 1])) for i in range(5)])
    assert torch.equal(together[:5], alone)


@compiled
def test_large_scores_do_not_overflow():
    """Scores of some thousands, where e^s is none of the floats and one element takes all the weight."""
    net = encoder(SIZES[0])
    with torch.no_grad():
        for layer in (net.score, net.road_out, net.query):
            layer.weight.mul_(1000.0)
    ours, theirs = (
        net(seen()),
        net.double().reference(seen().map(lambda t: t if t.dtype == torch.bool else t.double())),
    )
    assert ours.isfinite().all()
    same = (ours - theirs).abs() < 1e-3 * theirs.abs() + 1e-2
    assert same.float().mean() > 0.99  # but where two scores are equal to six digits


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder for compiled code, and nothing loaded yet."""
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda *args, **kwargs: tmp_path / "cache")
    forget()
    yield tmp_path / "cache"
    forget()


def forget() -> None:
    native.load_kernel.cache_clear()
    native._cache.cache_clear()


@compiled
def test_it_is_compiled_once(cache: Path):
    assert native.load_kernel(SIZES[0], 16, 32) is not None
    (library,) = cache.glob("*.so")
    made = library.stat().st_mtime_ns
    native.load_kernel.cache_clear()
    assert native.load_kernel(SIZES[0], 16, 32) is not None
    assert library.stat().st_mtime_ns == made


@compiled
@pytest.mark.parametrize("damage", ["cut off", "another file", "no digest", "digest of something else"])
def test_a_damaged_library_is_compiled_anew(cache: Path, damage: str):
    kernel = native.load_kernel(SIZES[0], 16, 32)
    assert kernel is not None
    (library,) = cache.glob("*.so")
    content, digest = library.read_bytes(), library.with_suffix(".sha256")
    library.unlink()  # this process has it in memory
    library.write_bytes(content[:5000] if damage == "cut off" else content)
    if damage == "another file":
        library.write_bytes(b"\x7fELF" + bytes(9000))
    if damage == "no digest":
        digest.unlink()
    if damage == "digest of something else":
        digest.write_bytes(b"\xff" * 64)
    native.load_kernel.cache_clear()
    assert native.load_kernel(SIZES[0], 16, 32) is not None
    assert library.read_bytes() == content
    assert digest.read_text() == hashlib.sha256(content).hexdigest()


@compiled
def test_without_a_folder_to_keep_it_in_it_is_compiled_for_the_run(
    cache: Path, monkeypatch: pytest.MonkeyPatch
):
    cache.write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match="XDG_CACHE_HOME"):
        assert native.load_kernel(SIZES[0], 16, 32) is not None

    def homeless(*args: object, **kwargs: object) -> None:
        raise RuntimeError("Could not determine home directory.")

    forget()
    monkeypatch.setattr(platformdirs, "user_cache_path", homeless)
    with pytest.warns(UserWarning, match="home directory"):
        assert native.load_kernel(SIZES[0], 16, 32) is not None


@pytest.mark.parametrize("missing", ["compiler", "success", "vectors"])
@pytest.mark.usefixtures("cache")
def test_without_the_kernel_torch_does_it(missing: str, monkeypatch: pytest.MonkeyPatch):
    config = NetworkConfig(width=24, heads=3) if missing == "vectors" else SIZES[0]
    if missing == "compiler":
        monkeypatch.setattr(native, "cpp_compiler", lambda: None)
    if missing == "success":

        def fail(*args: object, **kwargs: object) -> None:
            raise subprocess.CalledProcessError(1, "c++", stderr=b"no such flag")

        monkeypatch.setattr(subprocess, "run", fail)
    net = encoder(config)
    with pytest.warns(match="no such flag") if missing == "success" else nullcontext():
        assert torch.equal(net(seen()), net.reference(seen()))


def test_softmax_with_zero_leaves_room_for_nothing():
    score, mask = torch.tensor([[0.0, 0.0, 5.0]]), torch.tensor([[True, True, False]])
    torch.testing.assert_close(softmax_with_zero(score, mask), torch.tensor([[1 / 3, 1 / 3, 0.0]]))
    assert softmax_with_zero(score, mask & False).tolist() == [[0.0, 0.0, 0.0]]
