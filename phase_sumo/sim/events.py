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


def detect(
    shape: VehicleShape,
    before: VehicleState,
    after: VehicleState,
    task: Task,
    active: Tensor,
    road_map: RoadMap,
    map_index: Tensor,
    config: SimConfig,
) -> Events:
    """All events of the step from ``before`` to ``after``.

    Args:
        active: [W, N] bool.
        map_index: [W].
    """
    box = boxes(shape, after)
    goal = goal_reached(before, after, task, config.goal_radius) & active
    touching, fault = agent_contacts(box, active)
    edge, boundary = road_contacts(box, road_map, map_index)
    return Events(
        goal=goal,
        unrecoverable=goal_behind(after, task) & active & ~goal,
        collision=touching.any(1),
        at_fault=(touching & fault).any(1),
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


def agent_contacts(box: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
    """Overlaps of all box pairs of all pairs of agents, and the paper's fault rule for each.

    Args:
        box: [6, 2, W, N].
        active: [W, N] bool.

    Returns:
        touching [W, N, N] bool, symmetric, and whether it is the fault of the agent of the last axis.
    """
    slot = torch.arange(active.shape[1], device=active.device)
    pair = active.unsqueeze(2) & active.unsqueeze(1) & (slot != slot.unsqueeze(-1))
    return any_overlap(box, box) & pair, at_fault(box[:, 0].unsqueeze(2), box[:, 0].unsqueeze(3))


def any_overlap(a: Tensor, b: Tensor) -> Tensor:
    """[W, M, N] bool: a box of vehicle m of ``b`` [6, 2, W, M] overlaps one of n of ``a`` [6, 2, W, N]."""
    a, b = a.unsqueeze(3), b.unsqueeze(4)
    touching = boxes_overlap(a[:, 0], b[:, 0])
    for mine, other in ((0, 1), (1, 0), (1, 1)):
        touching = touching | boxes_overlap(a[:, mine], b[:, other])
    return touching


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


def road_contacts(box: Tensor, road_map: RoadMap, map_index: Tensor) -> tuple[Tensor, Tensor]:
    """Contact of both boxes with the road's borders.

    Args:
        box: [6, 2, W, N].
        map_index: [W].

    Returns:
        road_edge (or beside the road) and lane_boundary, both [W, N] bool.
    """
    edge, boundary = _border_contacts(box[:, 0], road_map, cell := road_map.cell(map_index, *box[:2, 0]))
    # a trailer without extent lies on its tractor's reference point and adds no contact of its own
    behind = _border_contacts(box[:, 1], road_map, road_map.cell(map_index, *box[:2, 1]))
    return edge | behind[0] | road_map.cell_off_road[cell], boundary | behind[1]


def _border_contacts(box: Tensor, road_map: RoadMap, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Contact of boxes [6, W, N] in their cells [W, N] with road edges and with lane boundaries."""
    index = road_map.cell_segments[cell]
    touch = box_touches_segment(box.unsqueeze(-1), [c[index] for c in road_map.segment.unbind(-1)])
    is_edge = road_map.segment_kind[index] == ROAD_EDGE
    return (touch & is_edge).any(-1), (touch & ~is_edge).any(-1)
