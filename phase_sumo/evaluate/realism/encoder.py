"""A small multi-agent motion forecaster, whose frozen tokens are the embedding of trajectories.

After Scene Transformer (Ngiam et al. 2022): attention over time and over agents by turns, trained to fill in
what is masked. Distances depend on the encoder, so figures of two encoders cannot be compared.

It sees each vehicle with those around it, in the vehicle's own frame at the begin. Only places and sizes
enter. Directions and speeds are differences of places, so that it does not matter how a log or a simulator
defines them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from phase_sumo.atomic_files import write_whole
from phase_sumo.errors import PhaseError
from phase_sumo.logs.recording import PERIOD, Recording

STRIDE = 5  # samples of a recording from one token to the next
AGENTS = 7  # the vehicle and the nearest ones around it
RANGE = 100.0  # m within which they are looked for
ALONG, ASIDE, FORWARDS, SIDEWAYS, SPEED, LENGTH, WIDTH, OWN, THERE = range(9)
FEATURES = 9
SCALE = np.array([20.0, 4.0, 10.0, 2.0, 20.0, 10.0, 2.0, 1.0, 1.0])


def trajectories(scene: Recording) -> NDArray[np.int64]:
    """[n] vehicles that are there from the first to the last sample."""
    return np.flatnonzero(scene.present.all(1))


def features(scene: Recording, rows: NDArray[np.int64]) -> Tensor:
    """[n, `AGENTS`, T, `FEATURES`] float32 of the vehicles ``rows``, T samples `STRIDE` apart.

    The frame of a vehicle has its origin at its first place and its x axis along its first direction, and
    moves on with its first speed v_0. The features are, divided by `SCALE`: place along and aside in that
    frame in m, speed along (less v_0) and aside in m/s, v_0 in m/s, length and width in m, 1 for the vehicle
    itself, 1 where the vehicle of the token is there. All are 0 where it is not; the vehicle itself comes
    first, then the others by their distance at the begin.
    """
    at = np.stack((scene.x, scene.y), -1)[:, ::STRIDE]
    there = scene.present[:, ::STRIDE]
    seconds = STRIDE * PERIOD
    way = np.diff(at, axis=1, append=np.nan)
    way[:, 1:] = np.where(np.isnan(way[:, 1:]), way[:, :-1], way[:, 1:])  # the last one has none ahead
    clock = np.arange(at.shape[1]) * seconds
    result = np.zeros((len(rows), AGENTS, at.shape[1], FEATURES))
    for k, row in enumerate(rows.tolist()):
        yaw = scene.yaw[row, 0]
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, -sin], [sin, cos]])
        speed = float((way[row, 0] @ turn)[0] / seconds)
        apart = np.hypot(*(at[:, 0] - at[row, 0]).T)
        near = np.argsort(np.where(there[:, 0] & (apart < RANGE), apart, np.inf), kind="stable")[:AGENTS]
        near = near[there[near, 0] & (apart[near] < RANGE)]
        place = (at[near] - at[row, 0]) @ turn
        velocity = way[near] @ turn / seconds
        token = result[k, : len(near)]
        token[..., ALONG], token[..., ASIDE] = place[..., 0] - speed * clock, place[..., 1]
        token[..., FORWARDS], token[..., SIDEWAYS] = velocity[..., 0] - speed, velocity[..., 1]
        token[..., SPEED] = speed
        token[..., LENGTH], token[..., WIDTH] = scene.length[near, None], scene.width[near, None]
        token[..., OWN] = (near == row)[:, None]
        token[..., THERE] = 1.0
        token[~there[near]] = 0.0
    return torch.from_numpy(np.nan_to_num(result / SCALE).astype(np.float32))


TOKEN = 64  # of a token, and of the embedding
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
        self.embed = nn.Linear(FEATURES + 1, TOKEN)  # the last one: it is masked
        self.clock = nn.Parameter(0.02 * torch.randn(times, TOKEN))
        self.over_time = nn.ModuleList(_layer() for _ in range(BLOCKS))
        self.over_agents = nn.ModuleList(_layer() for _ in range(BLOCKS))
        self.norm = nn.LayerNorm(TOKEN)
        self.head = nn.Linear(TOKEN, 4)

    def tokens(self, x: Tensor, masked: Tensor) -> Tensor:
        """[B, A, T, TOKEN]; ``masked`` [B, A, T] bool hides the motion of tokens, their presence is known."""
        batch, agents, times, _ = x.shape
        absent = x[..., THERE] == 0
        seen = x.clone()
        seen[..., MOTION] = seen[..., MOTION] * (~masked).unsqueeze(-1)
        t = self.embed(torch.cat((seen, masked.unsqueeze(-1).to(x)), -1)) + self.clock
        # an absent vehicle attends to itself alone, as attention to nothing is not defined
        in_time = _blocked(absent.flatten(0, 1))
        in_scene = _blocked(absent.transpose(1, 2).flatten(0, 1))
        for along, across in zip(self.over_time, self.over_agents, strict=True):
            t = along(t.flatten(0, 1), src_mask=in_time).view(batch, agents, times, TOKEN)
            t = t.transpose(1, 2).flatten(0, 1)
            t = across(t, src_mask=in_scene).view(batch, times, agents, TOKEN).transpose(1, 2)
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
        TOKEN, HEADS, 2 * TOKEN, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
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
        """[n, `TOKEN`] mean over time of the vehicle's own tokens, all of it seen, of features x [n, ...]."""
        parts = [np.zeros((0, TOKEN))]
        for part in x.split(CHUNK) if len(x) else ():
            nothing = torch.zeros(part.shape[:3], dtype=torch.bool)
            parts.append(self.model.tokens(part, nothing)[:, 0].mean(1).double().numpy())
        return np.concatenate(parts)

    def save(self, path: Path) -> None:
        """Write weights and `Training` as safetensors."""
        facts = {"training": json.dumps(asdict(self.training))}
        write_whole(path, save(self.model.state_dict(), facts))

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
