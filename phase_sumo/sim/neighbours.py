"""The K nearest neighbours of every agent of every world, without a sort of all pairs.

Distance and slot are packed into one integer key per pair, so that "the K smallest keys" is all there is to
find. Compiled, that is a sorting network over the candidates: every comparator is a minimum and a maximum of
two vectors that run over the agents, which vector units do sixteen at a time. Eagerly it is `torch.topk` on
the same keys; keys are unique, so both give the same neighbours in the same order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from phase_sumo.config import SimConfig

GROUP = 16  # candidates that one network sorts
FAR = 2**31 - 1
APART = 1.0e9  # m
# Green's sorting network for 16 inputs: 60 comparators in 10 layers (Knuth, TAOCP vol. 3, 5.3.4)
SORT = (
    *((i, i + 1) for i in range(0, 16, 2)),
    *((i, i + 2) for i in (0, 4, 8, 12, 1, 5, 9, 13)),
    *((i, i + 4) for i in (0, 8, 1, 9, 2, 10, 3, 11)),
    *((i, i + 8) for i in range(8)),
    *((5, 10), (6, 9), (3, 12), (13, 14), (4, 8), (7, 11), (1, 2)),
    *((1, 4), (7, 13), (2, 8), (11, 14)),
    *((2, 4), (5, 6), (9, 10), (11, 13), (3, 8), (7, 12)),
    *((6, 8), (10, 12), (3, 5), (7, 9)),
    *((3, 4), (5, 6), (7, 8), (9, 10), (11, 12)),
    *((6, 7), (8, 9)),
)
# sorts a list of 16 that first rises and then falls (or the other way round)
MERGE = tuple((i, i + step) for step in (8, 4, 2, 1) for i in range(16) if not i & step)


def nearest(x: Tensor, y: Tensor, active: Tensor, config: SimConfig) -> tuple[Tensor, Tensor]:
    """The nearest active others of each agent, nearest first.

    Squared distances are told apart to 1 part in 2^(31 - bits) of the squared range, where ``bits`` hold a
    slot: 0.7 mm^2 ... 3 cm^2 for 64 ... 256 slots and 150 m.

    Args:
        x, y: [W, N] m.
        active: [W, N] bool.

    Returns:
        index [W, N, K] int32 and mask [W, N, K] bool: False beyond the range, where there is none (the index
        then means nothing) and for agents that are not active.
    """
    slots = active.shape[1]
    bits = max((slots - 1).bit_length(), 1)
    beyond = 2 ** (31 - bits) - 129  # first distance that counts as out of range, exact in float32
    key = _keys(x, y, active, config.neighbour_range, bits, beyond)
    count = min(config.neighbours, slots)
    if torch.compiler.is_compiling() and config.neighbours <= GROUP:
        smallest = _smallest(key)[:count]
    else:
        smallest = key.topk(count, dim=0, largest=False).values
    smallest = torch.nn.functional.pad(smallest, (0, 0, 0, 0, 0, config.neighbours - count), value=FAR)
    smallest = smallest.permute(1, 2, 0)
    return (smallest & (2**bits - 1)).clamp_max(slots - 1), (smallest >> bits) < beyond


def gather(values: Tensor, index: Tensor) -> Tensor:
    """values[w, index[w, n, k]] for values [W, N] and index [W, N, K]."""
    return values[torch.arange(len(values), device=values.device)[:, None, None], index]


def _keys(x: Tensor, y: Tensor, active: Tensor, reach: float, bits: int, beyond: int) -> Tensor:
    """[N, W, N] int32: squared distance from candidate j (first axis) in the high bits, j in the low ones."""
    slot = torch.arange(x.shape[1], dtype=torch.int32, device=x.device)
    # far away, each in a place of its own: cheaper than to ask of every pair whether both are active
    x = torch.where(active, x, APART * (1.0 + slot))
    squared = (x.t().unsqueeze(-1) - x).square() + (y.t().unsqueeze(-1) - y).square()
    level = torch.where(slot[:, None, None] != slot, squared * (beyond / reach**2), beyond)
    return (level.clamp_max(beyond).to(torch.int32) << bits) | slot[:, None, None]


def _smallest(key: Tensor) -> Tensor:
    """[16, W, N] the smallest keys of each column of [M, W, N], in rising order."""
    groups = 1
    while groups * GROUP < key.shape[0]:
        groups *= 2
    key = torch.nn.functional.pad(key, (0, 0, 0, 0, 0, groups * GROUP - key.shape[0]), value=FAR)
    rows = _compare(list(key.view(GROUP, groups, *key.shape[1:]).unbind(0)), SORT)
    while groups > 1:
        groups //= 2
        # of two rising lists, the smaller of first and last, second and last but one ... are the 16 smallest
        rows = [torch.minimum(rows[i][:groups], rows[15 - i][groups:]) for i in range(GROUP)]
        rows = list(torch.stack(_compare(rows, MERGE)).unbind(0))
    return torch.stack(rows).squeeze(1)


def _compare(rows: list[Tensor], comparators: tuple[tuple[int, int], ...]) -> list[Tensor]:
    for a, b in comparators:
        rows[a], rows[b] = torch.minimum(rows[a], rows[b]), torch.maximum(rows[a], rows[b])
    return rows
