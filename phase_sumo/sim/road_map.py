"""Road geometry as tensors: a grid of cells, each with a row of what a vehicle there sees and may touch.

A lookup takes constant time and reads one contiguous row. One `RoadMap` holds one or many maps side by side:
tables are concatenated and each map knows its own grid, so worlds on different maps are stepped in one batch
without padding the maps to each other.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
import torch
from torch import Tensor


class RoadKind(IntEnum):
    """Category of a road point or segment."""

    LANE_CENTRE = 0
    LANE_BOUNDARY = 1  # may be crossed
    SOLID_BOUNDARY = 2  # lane change forbidden
    ROAD_EDGE = 3  # border of the drivable surface


ABSENT = -1.0  # kind of a row's empty places
FAR = 1.0e6  # m: where they lie

CELL_SIZE = 4.0  # m
BLOCK_BITS = 5
BLOCK = 2**BLOCK_BITS  # grid squares along a block's side; only blocks with road in them are stored
POINTS_PER_CELL = 32  # R, road points of an observation
SEGMENTS_PER_CELL = 32  # border segments that a box centred in the cell can touch, at most
CONTACT_REACH = 12.0  # m: half diagonal of the longest box + half diagonal of a cell


@dataclass(frozen=True)
class RoadMap:
    """What M maps show at every place, by cells of 4 m; the last of the C cells stands for no road.

    Attributes:
        view: [V, 5, R] road points seen from a cell: x, y in m, cos and sin of the driving direction, kind.
        border: [B, 5, G] border segments within `CONTACT_REACH` of a cell's centre, nearest first: their ends
            ax, ay, bx, by in m, and kind.
        cell_view, cell_border: [C] rows of ``view`` and ``border``; the last rows are empty.
        cell_yaw: [C] direction in rad of the lane centre nearest to the cell centre.
        cell_node: [C, 2] the lane node nearest to the cell centre, in m.
        cell_off_road: [C] bool, no lane reaches into the cell.
        grid: [blocks * BLOCK^2] cell of every grid square of the stored blocks, C-1 where there is no road.
            Squares are 4 m wide; within a block they are row-major. Each map's first block is empty.
        grid_block: [sum of nx*ny + 1] first square in ``grid`` of every block; where there is no road, and
            in each map's last entry, which stands for positions off the map, that of an empty block.
        grid_offset: [M] first block of each map in ``grid_block``.
        grid_origin: [M, 2] lower left corner in m.
        grid_shape: [M, 2] nx, ny in blocks, row-major: index = ix * ny + iy.
    """

    view: Tensor
    border: Tensor
    cell_view: Tensor
    cell_border: Tensor
    cell_yaw: Tensor
    cell_node: Tensor
    cell_off_road: Tensor
    grid: Tensor
    grid_block: Tensor
    grid_offset: Tensor
    grid_origin: Tensor
    grid_shape: Tensor

    @property
    def count(self) -> int:
        """Number of maps M."""
        return self.grid_offset.shape[0]

    def cell(self, map_index: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Cell of each position; the padding cell off the map.

        Args:
            map_index: [W] map of each world.
            x, y: [W, ...] positions in m.
        """
        axes = (-1, *(1,) * (x.dim() - 1))
        origin, shape = self.grid_origin[map_index], self.grid_shape[map_index]
        column = torch.floor((x - origin[:, 0].view(axes)) * (1.0 / CELL_SIZE)).long()
        row = torch.floor((y - origin[:, 1].view(axes)) * (1.0 / CELL_SIZE)).long()
        ix, iy = column >> BLOCK_BITS, row >> BLOCK_BITS
        columns, rows = shape[:, 0].view(axes), shape[:, 1].view(axes)
        inside = (ix >= 0) & (ix < columns) & (iy >= 0) & (iy < rows)
        block = ix * rows + iy + self.grid_offset[map_index].view(axes)
        first = self.grid_block[torch.where(inside, block, -1)]
        return self.grid[first + (column & (BLOCK - 1)) * BLOCK + (row & (BLOCK - 1))]

    def seen_in(self, view: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """x, y, cos, sin and kind [..., R] of the road points in rows [...] of ``view``."""
        return _columns(self.view, view)

    def borders_at(self, cell: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """ax, ay, bx, by and kind [..., G] of the border segments in reach of cells [...]."""
        return _columns(self.border, self.cell_border[cell])

    def segments(self) -> tuple[Tensor, Tensor]:
        """All border segments [S, 4] in m, and their kinds [S]."""
        rows = self.border.transpose(1, 2).reshape(-1, 5)
        rows = rows[rows[:, 4] != ABSENT]
        # sorting whole rows as bytes is many times faster than column by column
        _, first = np.unique(rows.numpy().view("V20"), return_index=True)
        rows = rows[torch.from_numpy(first)]
        return rows[:, :4], rows[:, 4].long()

    def to(self, device: torch.device | str) -> RoadMap:
        return RoadMap(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def arrays(self) -> dict[str, np.ndarray]:
        """The tensors as numpy arrays for an ``.npz`` bundle, indices in 32 bits."""
        arrays = {f.name: getattr(self, f.name).cpu().numpy() for f in fields(self)}
        return {k: v.astype(np.int32) if v.dtype == np.int64 else v for k, v in arrays.items()}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> RoadMap:
        """Back from `arrays`; torch gathers by 64-bit indices."""
        tensors = {f.name: torch.from_numpy(np.array(arrays[f.name])) for f in fields(RoadMap)}
        return RoadMap(**{k: v.long() if v.dtype == torch.int32 else v for k, v in tensors.items()})


def _columns(table: Tensor, row: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The five columns [..., P] of rows [...] of a table [., 5, P], read where they are used."""
    return table[row, 0], table[row, 1], table[row, 2], table[row, 3], table[row, 4]


def merge(maps: list[RoadMap]) -> RoadMap:
    """Concatenate maps; map index m of the result is ``maps[m]`` (each must hold a single map).

    Each map's empty rows and cell are dropped in favour of one shared set at the end.
    """
    widest = max(m.border.shape[2] for m in maps)
    rows = {name: sum(len(getattr(m, name)) - 1 for m in maps) for name in ("view", "border", "cell_yaw")}
    tables: dict[str, list[Tensor]] = {f.name: [] for f in fields(RoadMap)}
    first = dict.fromkeys((*rows, "grid", "grid_block"), 0)
    for m in maps:
        own = {name: len(getattr(m, name)) - 1 for name in rows}
        tables["view"].append(m.view[:-1])
        tables["border"].append(_widened(m.border[:-1], widest))
        tables["cell_view"].append(_shift(m.cell_view[:-1], own["view"], first["view"], rows["view"]))
        tables["cell_border"].append(
            _shift(m.cell_border[:-1], own["border"], first["border"], rows["border"])
        )
        tables["cell_yaw"].append(m.cell_yaw[:-1])
        tables["cell_node"].append(m.cell_node[:-1])
        tables["cell_off_road"].append(m.cell_off_road[:-1])
        tables["grid"].append(_shift(m.grid, own["cell_yaw"], first["cell_yaw"], rows["cell_yaw"]))
        tables["grid_block"].append(m.grid_block + first["grid"])
        tables["grid_offset"].append(m.grid_offset + first["grid_block"])
        tables["grid_origin"].append(m.grid_origin)
        tables["grid_shape"].append(m.grid_shape)
        for name in first:
            first[name] += own.get(name, len(getattr(m, name)))
    last = maps[0]
    tables["view"].append(last.view[-1:])
    tables["border"].append(_widened(last.border[-1:], widest))
    tables["cell_view"].append(torch.full_like(last.cell_view[-1:], rows["view"]))
    tables["cell_border"].append(torch.full_like(last.cell_border[-1:], rows["border"]))
    tables["cell_yaw"].append(last.cell_yaw[-1:])
    tables["cell_node"].append(last.cell_node[-1:])
    tables["cell_off_road"].append(last.cell_off_road[-1:])
    return RoadMap(**{name: torch.cat(parts) for name, parts in tables.items()})


def _shift(index: Tensor, padding: int, offset: int, new_padding: int) -> Tensor:
    return torch.where(index == padding, new_padding, index + offset)


def _widened(border: Tensor, width: int) -> Tensor:
    """Rows [B, 5, G] with empty places up to ``width`` segments."""
    empty = torch.full((len(border), 5, width - border.shape[2]), FAR)
    empty[:, 4] = ABSENT
    return torch.cat((border, empty), 2)
