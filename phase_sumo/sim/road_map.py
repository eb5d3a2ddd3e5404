"""Road geometry as tensors, with a grid index that answers every query in constant time.

One `RoadMap` holds one or many maps side by side: tables are concatenated and each map knows its own
grid, so worlds on different maps are stepped in one batch without padding the maps to each other.
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


CELL_SIZE = 4.0  # m
BLOCK_BITS = 5
BLOCK = 2**BLOCK_BITS  # grid squares along a block's side; only blocks with road in them are stored
POINTS_PER_CELL = 32  # R, road points of an observation
SEGMENTS_PER_CELL = 32  # border segments that a box centred in the cell can touch
CONTACT_REACH = 12.0  # m: half diagonal of the longest box + half diagonal of a cell


# tables of a map that hold no index into another table
OWN_VALUES = ("point_xy", "point_dir", "point_kind", "segment", "segment_kind", "cell_yaw", "cell_off_road")


@dataclass(frozen=True)
class RoadMap:
    """Road points, border segments and their grid index for M maps.

    Attributes:
        point_xy: [P, 2] road points in m (lane centres, lane boundaries, road edges).
        point_dir: [P, 2] unit tangent in driving direction.
        point_kind: [P] `RoadKind`; -1 for the padding point, which is the last one.
        segment: [S, 4] border segments ax, ay, bx, by in m; the padding segment is last and far away.
        segment_kind: [S] `RoadKind` (never LANE_CENTRE).
        cell_points: [C, R] indices into the points, seen from a cell; the padding cell is last.
        cell_segments: [C, G] indices into the segments within `CONTACT_REACH` of the cell centre.
        cell_yaw: [C] direction in rad of the lane centre nearest to the cell centre.
        cell_off_road: [C] bool, no lane reaches into the cell.
        grid: [blocks * BLOCK^2] compact cell of every grid square of the stored blocks, C-1 where there is
            no road. Squares are 4 m wide; within a block they are row-major. Each map's first block is empty.
        grid_block: [sum of nx*ny + 1] first square in ``grid`` of every block; where there is no road, and
            in each map's last entry, which stands for positions off the map, that of an empty block.
        grid_offset: [M] first block of each map in ``grid_block``.
        grid_origin: [M, 2] lower left corner in m.
        grid_shape: [M, 2] nx, ny in blocks, row-major: index = ix * ny + iy.
    """

    point_xy: Tensor
    point_dir: Tensor
    point_kind: Tensor
    segment: Tensor
    segment_kind: Tensor
    cell_points: Tensor
    cell_segments: Tensor
    cell_yaw: Tensor
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


def merge(maps: list[RoadMap]) -> RoadMap:
    """Concatenate maps; map index m of the result is ``maps[m]`` (each must hold a single map).

    Each map's padding point, segment and cell are dropped in favour of one shared set at the end.
    """
    points = sum(m.point_kind.shape[0] - 1 for m in maps)
    segments = sum(m.segment_kind.shape[0] - 1 for m in maps)
    cells = sum(m.cell_yaw.shape[0] - 1 for m in maps)
    tables: dict[str, list[Tensor]] = {f.name: [] for f in fields(RoadMap)}
    first_point = first_segment = first_cell = first_square = first_block = 0
    for m in maps:
        own_points, own_segments = m.point_kind.shape[0] - 1, m.segment_kind.shape[0] - 1
        own_cells = m.cell_yaw.shape[0] - 1
        for name in OWN_VALUES:
            tables[name].append(getattr(m, name)[:-1])
        tables["cell_points"].append(_shift(m.cell_points[:-1], own_points, first_point, points))
        tables["cell_segments"].append(_shift(m.cell_segments[:-1], own_segments, first_segment, segments))
        tables["grid"].append(_shift(m.grid, own_cells, first_cell, cells))
        tables["grid_block"].append(m.grid_block + first_square)
        tables["grid_offset"].append(m.grid_offset + first_block)
        tables["grid_origin"].append(m.grid_origin)
        tables["grid_shape"].append(m.grid_shape)
        first_point, first_segment, first_cell = (
            first_point + own_points,
            first_segment + own_segments,
            first_cell + own_cells,
        )
        first_square, first_block = first_square + m.grid.shape[0], first_block + m.grid_block.shape[0]
    for name in OWN_VALUES:
        tables[name].append(getattr(maps[0], name)[-1:])
    tables["cell_points"].append(torch.full_like(maps[0].cell_points[-1:], points))
    tables["cell_segments"].append(torch.full_like(maps[0].cell_segments[-1:], segments))
    return RoadMap(**{name: torch.cat(parts) for name, parts in tables.items()})


def _shift(index: Tensor, padding: int, offset: int, new_padding: int) -> Tensor:
    return torch.where(index == padding, new_padding, index + offset)
