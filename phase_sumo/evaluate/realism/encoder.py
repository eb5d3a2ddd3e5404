"""A small multi-agent motion forecaster, whose frozen tokens are the embedding of trajectories.

After Scene Transformer (Ngiam et al. 2022): attention over time and over agents by turns, trained to fill in
what is masked. Distances depend on the encoder, so figures of two encoders cannot be compared.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.realism.features import ALONG, ASIDE, FEATURES, FORWARDS, SIDEWAYS, THERE

WIDTH = 64  # of a token, and of the embedding
HEADS = 4
BLOCKS = 2
BATCH = 64
RATE = 1e-3  # Adam's, falling to a tenth
MOTION = (ALONG, ASIDE, FORWARDS, SIDEWAYS)  # hidden where a token is masked
SEEN = 3  # tokens at least that a forecast starts from, 1 s
CHUNK = 256  # trajectories embedded at a time


@dataclass(frozen=True)
class Training:
    """What an encoder was trained on.

    Attributes:
        seconds: length of its windows.
        recordings: names; results on them say nothing.
        trajectories, steps, seed: how many, how long, and how it started.
        loss: mean negative log-likelihood of a masked coordinate in the last tenth of the training.
    """

    seconds: float
    recordings: tuple[str, ...]
    trajectories: int
    steps: int
    seed: int
    loss: float = float("nan")


class Forecaster(nn.Module):
    """Tokens [B, A, T, F] -> places where they are masked, with a Laplace scale."""

    def __init__(self, times: int) -> None:
        super().__init__()
        self.embed = nn.Linear(FEATURES + 1, WIDTH)  # the last one: it is masked
        self.clock = nn.Parameter(0.02 * torch.randn(times, WIDTH))
        self.over_time = nn.ModuleList(_layer() for _ in range(BLOCKS))
        self.over_agents = nn.ModuleList(_layer() for _ in range(BLOCKS))
        self.norm = nn.LayerNorm(WIDTH)
        self.head = nn.Linear(WIDTH, 4)

    def tokens(self, x: Tensor, masked: Tensor) -> Tensor:
        """[B, A, T, WIDTH]; ``masked`` [B, A, T] bool hides the motion of tokens, their presence is known."""
        batch, agents, times, _ = x.shape
        absent = x[..., THERE] == 0
        seen = x.clone()
        seen[..., MOTION] = seen[..., MOTION] * (~masked).unsqueeze(-1)
        t = self.embed(torch.cat((seen, masked.unsqueeze(-1).to(x)), -1)) + self.clock
        # an absent vehicle attends to itself alone, as attention to nothing is not defined
        in_time = _blocked(absent.flatten(0, 1))
        in_scene = _blocked(absent.transpose(1, 2).flatten(0, 1))
        for along, across in zip(self.over_time, self.over_agents, strict=True):
            t = along(t.flatten(0, 1), src_mask=in_time).view(batch, agents, times, WIDTH)
            t = t.transpose(1, 2).flatten(0, 1)
            t = across(t, src_mask=in_scene).view(batch, times, agents, WIDTH).transpose(1, 2)
        return self.norm(t)

    def loss(self, x: Tensor, masked: Tensor) -> Tensor:
        """Mean negative log-likelihood of masked places: log 2b + |z - mu| / b."""
        out = self.head(self.tokens(x, masked))
        scale = torch.exp(out[..., 2:].clamp(-6.0, 4.0))
        apart = (x[..., (ALONG, ASIDE)] - out[..., :2]).abs()
        counted = (masked & (x[..., THERE] > 0)).unsqueeze(-1).to(x)
        return ((torch.log(2.0 * scale) + apart / scale) * counted).sum() / (2.0 * counted.sum()).clamp_min(1)


def _layer() -> nn.TransformerEncoderLayer:
    return nn.TransformerEncoderLayer(
        WIDTH, HEADS, 2 * WIDTH, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
    )


def _blocked(absent: Tensor) -> Tensor:
    """[B * `HEADS`, S, S] True where attention must not go, of absent [B, S]."""
    size = absent.shape[1]
    blocked = absent[:, None, :] & ~torch.eye(size, dtype=torch.bool)
    return blocked.repeat_interleave(HEADS, 0)


@dataclass(frozen=True)
class Encoder:
    """A trained forecaster, frozen."""

    model: Forecaster
    training: Training

    @torch.no_grad()
    def embed(self, x: Tensor) -> np.ndarray:
        """[n, `WIDTH`] mean over time of the vehicle's own tokens, all of it seen, of features x [n, ...]."""
        parts = [np.zeros((0, WIDTH))]
        for part in x.split(CHUNK) if len(x) else ():
            nothing = torch.zeros(part.shape[:3], dtype=torch.bool)
            parts.append(self.model.tokens(part, nothing)[:, 0].mean(1).double().numpy())
        return np.concatenate(parts)

    def save(self, path: Path) -> None:
        """Write weights and `Training` as safetensors."""
        temporary = path.with_name(path.name + ".part")
        save_file(self.model.state_dict(), temporary, {"training": json.dumps(asdict(self.training))})
        temporary.replace(path)

    @staticmethod
    def load(path: str | Path) -> Encoder:
        """Inverse of `save`.

        Raises:
            PhaseError: the file is none of ours.
        """
        try:
            with safe_open(str(path), "pt") as file:
                found = json.loads(file.metadata()["training"])
                state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # no mapping
            training = Training(**found | {"recordings": tuple(found["recordings"])})
            model = Forecaster(len(state["clock"]))
            model.load_state_dict(state)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise PhaseError(
                f"{path}: not a trajectory encoder ({error}); leave --encoder out to train one"
            ) from None
        return Encoder(model.eval(), training)


def train(
    scenes: Sequence[Tensor],
    training: Training,
    progress: Callable[[float, str], None] | None = None,
) -> Encoder:
    """Fit a forecaster; the same scenes and seed give the same weights on one machine.

    Half of the samples forecast: everything after a random time is masked, for all vehicles. In the other
    half each token is masked with probability 1/2, so that whole trajectories are nothing new later.

    Args:
        scenes: features [n, A, T, F] of each.
    """
    data = torch.cat([scene for scene in scenes if len(scene)] or [torch.zeros(0)])
    if len(data) < BATCH:
        raise PhaseError(
            f"only {len(data)} whole trajectories of {training.seconds:g} s to train an encoder on, "
            f"{BATCH} are needed; pass more logs or shorter windows"
        )
    draw = torch.Generator().manual_seed(training.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(training.seed)
        model = Forecaster(data.shape[2])
    optimizer = torch.optim.Adam(model.parameters(), RATE)
    decline = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.1, training.steps)
    losses = []
    for step in range(training.steps):
        x = data[torch.randint(len(data), (BATCH,), generator=draw)]
        loss = model.loss(x, _masks(x, draw))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        decline.step()
        losses.append(loss.item())
        if progress and step % 10 == 0:
            progress(step / training.steps, f"encoder, loss {losses[-1]:.2f}")
    last = float(np.mean(losses[-max(training.steps // 10, 1) :]))
    model.requires_grad_(False)
    return Encoder(model.eval(), replace(training, loss=last))


def _masks(x: Tensor, draw: torch.Generator) -> Tensor:
    """[B, A, T] bool."""
    batch, agents, times, _ = x.shape
    first = torch.randint(SEEN, times, (batch, 1, 1), generator=draw)
    forecast = (torch.arange(times) >= first).expand(batch, agents, times)
    some = torch.rand(batch, agents, times, generator=draw) < 0.5
    forecasts = torch.rand(batch, 1, 1, generator=draw) < 0.5
    return torch.where(forecasts, forecast, some)
