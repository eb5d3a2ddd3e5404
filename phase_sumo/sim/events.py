"""What happened in a step: contacts, fault, goal reached, goal behind."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import SimConfig
from phase_sumo.sim.geometry import box_touches_segment, boxes_overlap, segment_distance
from phase_sumo.sim.road_map import RoadKind, RoadMap
from phase_sumo.sim.vehicles import Task, TensorBatch, VehicleShape, VehicleState, boxes

ROAD_EDGE = int(RoadKind.ROAD_EDGE)


@dataclass
class Events(TensorBatch):
    """Indicators of one step, all [W, N] bool and False for inactive agents.

    Attributes:
        goal: the goal region was reached (G_i).
        unrecoverable: the goal lies behind and was not reached.
        collision: some box overlaps another agent's.
        at_fault: such a collision is this agent's fault (F_i).
        road_edge: a box touches the border of the road, or the vehicle is beside the road (E_i).
        lane_boundary: a box touches a lane boundary (L_i).
    """

    goal: Tensor
    unrecoverable: Tensor
    collision: Tensor
    at_fault: Tensor
    road_edge: Tensor
    lane_boundary: Tensor


@dataclass
class Outcome(TensorBatch):
    """How one agent's episode ended or stands; all [W, N].

    Attributes:
        goal: reached its goal.
        collision, at_fault, road_edge: it happened at least once.
    """

    goal: Tensor
    collision: Tensor
    at_fault: Tensor
    road_edge: Tensor

    def after(self, events: Events) -> Outcome:
        """With what happened in one more step."""
        return Outcome(
            self.goal | events.goal,
            self.collision | events.collision,
            self.at_fault | events.at_fault,
            self.road_edge | events.road_edge,
        )


def detect(
    shape: VehicleShape,
    before: VehicleState,
    after: VehicleState,
    task: Task,
    active: Tensor,
    road_map: RoadMap,
    map_index: Tensor,
    config: SimConfig,
    trailers: int,
) -> Events:
    """All events of the step from ``before`` to ``after``.

    Args:
        active: [W, N] bool.
        map_index: [W].
        trailers: only this many slots, the first ones, may have a trailer.
    """
    box = boxes(shape, after)
    goal = goal_reached(before, after, task, config.goal_radius) & active
    collision, guilty = agent_contacts(box, active, trailers)
    edge, boundary = road_contacts(box, road_map, map_index, trailers)
    return Events(
        goal=goal,
        unrecoverable=goal_behind(after, task) & active & ~goal & config.early_termination,
        collision=collision,
        at_fault=guilty,
        road_edge=edge & active,
        lane_boundary=boundary & active,
    )


def goal_reached(before: VehicleState, after: VehicleState, task: Task, radius: float) -> Tensor:
    """Whether the segment between two reference points passes within ``radius`` m of the goal.

    The sweep matters: at 30 m/s a step is 3 m long and would jump over the region.
    """
    return segment_distance((before.x, before.y), (after.x, after.y), (task.goal_x, task.goal_y)) <= radius


def goal_behind(state: VehicleState, task: Task) -> Tensor:
    """The paper's unrecoverable rule: goal vector times forward vector < 0."""
    dx, dy = task.goal_x - state.x, task.goal_y - state.y
    return dx * torch.cos(state.yaw) + dy * torch.sin(state.yaw) < 0.0


def agent_contacts(box: Tensor, active: Tensor, trailers: int) -> tuple[Tensor, Tensor]:
    """Overlaps of all box pairs of all pairs of agents, and the paper's fault rule for each.

    Args:
        box: [6, 2, W, N].
        active: [W, N] bool.
        trailers: only this many slots, the first ones, may have a trailer.

    Returns:
        collision and at_fault, both [W, N] bool.
    """
    # a box that is nowhere overlaps nothing
    box = torch.cat((torch.where(active, box[:1], torch.nan), box[1:]))
    tractor, trailer = box[:, 0], box[:, 1, :, :trailers]
    worst = _worst(tractor, tractor, tractor, tractor)
    if trailers:
        towing = tractor[..., :trailers]
        worst = torch.maximum(worst, _worst(tractor, tractor, trailer, towing))
        behind = torch.maximum(
            _worst(trailer, towing, tractor, tractor), _worst(trailer, towing, trailer, towing)
        )
        worst = torch.maximum(worst, torch.nn.functional.pad(behind, (0, active.shape[1] - trailers)))
    return worst > 0.0, worst > 1.0


def _worst(mine: Tensor, my_tractor: Tensor, other: Tensor, other_tractor: Tensor) -> Tensor:
    """2 where one of ``mine`` overlaps one of the others at my fault, 1 where at the other's alone, else 0.

    All pairs are looked at and none is stored: compiled, this is one loop within registers.

    Args:
        mine, my_tractor: boxes [6, W, N] and those of their tractors.
        other, other_tractor: the same [6, W, M]; equal slots are the same vehicle.

    Returns:
        [W, N].
    """
    slot = torch.arange(max(mine.shape[2], other.shape[2]), dtype=torch.float32, device=mine.device)
    another = slot[: other.shape[2], None, None] != slot[: mine.shape[2]]
    other, other_tractor = (box.transpose(1, 2).unsqueeze(-1) for box in (other, other_tractor))
    fault = torch.where(at_fault(my_tractor, other_tractor), 2.0, 1.0)
    return torch.where(boxes_overlap(other, mine) & another, fault, 0.0).amax(0)


def at_fault(mine: Tensor, other: Tensor) -> Tensor:
    """Fault of the owner of ``mine`` in a collision (paper: At-fault collision attribution).

    F_i = 1[(p_j - p_i) . f_j > l_j / 2]: i is behind j's rear. When neither is, both are at fault.

    Args:
        mine, other: [6, ...] tractor boxes of i and j; p is the box centre, l the box length.
    """
    dx, dy = other[0] - mine[0], other[1] - mine[1]
    i_behind = dx * other[2] + dy * other[3] > other[4]
    j_behind = -(dx * mine[2] + dy * mine[3]) > mine[4]
    return i_behind | ~j_behind


def road_contacts(box: Tensor, road_map: RoadMap, map_index: Tensor, trailers: int) -> tuple[Tensor, Tensor]:
    """Contact of both boxes with the road's borders.

    Args:
        box: [6, 2, W, N].
        map_index: [W].
        trailers: only this many slots, the first ones, may have a trailer.

    Returns:
        road_edge (or beside the road) and lane_boundary, both [W, N] bool.
    """
    tractor, trailer = box[:, 0], box[:, 1, :, :trailers]
    cells = torch.cat([road_map.cell(map_index, part[0], part[1]) for part in (tractor, trailer)], -1)
    own, behind = cells[:, : box.shape[3]], cells[:, box.shape[3] :]
    edge, boundary = _border_contacts(tractor, road_map, own)
    # a trailer without extent lies on its tractor's reference point and adds no contact of its own
    trailer_edge, trailer_boundary = _border_contacts(trailer, road_map, behind)
    others = (0, box.shape[3] - trailers)
    edge = edge | torch.nn.functional.pad(trailer_edge, others) | beside_road(tractor[:2], road_map, own)
    return edge, boundary | torch.nn.functional.pad(trailer_boundary, others)


def beside_road(xy: Tensor, road_map: RoadMap, cell: Tensor) -> Tensor:
    """Whether points lie off the drivable surface, wherever the grid lies.

    The way from the point to the lane node nearest to its cell crosses the road edge an odd number of times.
    It is at most 9 m long, so that the cell's border segments hold every edge that it can cross.

    Args:
        xy: [2, W, N] m.
        cell: [W, N] the points' cells.

    Returns:
        [W, N] bool.
    """
    px, py = (v.unsqueeze(-1) for v in xy)
    nx, ny = (v.unsqueeze(-1) for v in road_map.cell_node[cell].unbind(-1))
    ax, ay, bx, by, kind = road_map.borders_at(cell)
    way_x, way_y, edge_x, edge_y = nx - px, ny - py, bx - ax, by - ay
    a_left, b_left = (way_x * (y - py) - way_y * (x - px) > 0 for x, y in ((ax, ay), (bx, by)))
    p_left, n_left = (edge_x * (y - ay) - edge_y * (x - ax) > 0 for x, y in ((px, py), (nx, ny)))
    crossings = ((a_left != b_left) & (p_left != n_left) & (kind == ROAD_EDGE)).float().sum(-1)
    return (torch.remainder(crossings, 2.0) > 0.5) | road_map.cell_off_road[cell]


def _border_contacts(box: Tensor, road_map: RoadMap, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Contact of boxes [6, W, N] in their cells [W, N] with road edges and with lane boundaries."""
    *segment, kind = road_map.borders_at(cell)
    touch = box_touches_segment(box.unsqueeze(-1), segment)
    is_edge = kind == ROAD_EDGE
    return (touch & is_edge).any(-1), (touch & ~is_edge).any(-1)
