"""What happened in a step: contacts, fault, goal reached, goal behind."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.config import SimConfig
from phase_sumo.sim.geometry import box_touches_segment, boxes_overlap, segment_distance
from phase_sumo.sim.observation import gather
from phase_sumo.sim.road_map import RoadKind, RoadMap
from phase_sumo.sim.vehicles import Task, TensorBatch, VehicleShape, VehicleState


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
    box: Tensor,
    active: Tensor,
    neighbours: tuple[Tensor, Tensor],
    road_map: RoadMap,
    map_index: Tensor,
    config: SimConfig,
) -> Events:
    """All events of the step from ``before`` to ``after``.

    Args:
        box: [6, W, N, 2] boxes after the step.
        active: [W, N] bool.
        neighbours: index and mask of `observation.nearest` after the step.
        map_index: [W].
    """
    goal = goal_reached(before, after, task, config.goal_radius) & active
    world, agent, _, fault = agent_contacts(box, shape.reach, after.xy, neighbours)
    collision, guilty = torch.zeros_like(active), torch.zeros_like(active)
    collision[world, agent] = True
    guilty[world[fault], agent[fault]] = True
    present = torch.stack((active, active & shape.articulated), -1)
    edge, boundary = road_contacts(box, present, road_map, map_index)
    return Events(
        goal=goal,
        unrecoverable=goal_behind(after, task) & active & ~goal,
        collision=collision,
        at_fault=guilty,
        road_edge=edge,
        lane_boundary=boundary,
    )


def goal_reached(before: VehicleState, after: VehicleState, task: Task, radius: float) -> Tensor:
    """Whether the segment between two reference points passes within ``radius`` m of the goal.

    The sweep matters: at 30 m/s a step is 3 m long and would jump over the region.
    """
    return segment_distance(before.xy, after.xy, task.goal_xy) <= radius


def goal_behind(state: VehicleState, task: Task) -> Tensor:
    """The paper's unrecoverable rule: goal vector times forward vector < 0."""
    dx, dy = task.goal_x - state.x, task.goal_y - state.y
    return dx * torch.cos(state.yaw) + dy * torch.sin(state.yaw) < 0.0


def agent_contacts(
    box: Tensor, reach: Tensor, xy: Tensor, neighbours: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Overlaps with the neighbours, all box pairs, and the paper's fault rule for each.

    Args:
        box: [6, W, N, 2].
        reach: [W, N] m, no part of a vehicle is farther from its reference point.
        xy: [W, N, 2] reference points in m.
        neighbours: index and mask [W, N, K].

    Returns:
        world, agent and other agent of every overlap, and whether it is the agent's fault, all [M]; an
        overlap appears once for each of its two agents.
    """
    index, mask = neighbours
    distance = torch.hypot(*(gather(c, index) - c.unsqueeze(-1) for c in xy.unbind(-1)))
    near = mask & (distance < gather(reach, index) + reach.unsqueeze(-1))
    world, agent, neighbour = near.nonzero(as_tuple=True)
    other = index[world, agent, neighbour]
    mine, theirs = box[:, world, agent], box[:, world, other]
    touching = boxes_overlap(mine.unsqueeze(-1), theirs.unsqueeze(-2)).flatten(-2).any(-1)
    fault = at_fault(mine[..., 0], theirs[..., 0])
    return world[touching], agent[touching], other[touching], fault[touching]


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


def road_contacts(
    box: Tensor, present: Tensor, road_map: RoadMap, map_index: Tensor
) -> tuple[Tensor, Tensor]:
    """Contact of both boxes with the road's borders.

    Args:
        box: [6, W, N, 2].
        present: [W, N, 2] bool, boxes to look at.
        map_index: [W].

    Returns:
        road_edge (or beside the road) and lane_boundary, both [W, N] bool.
    """
    world, agent, part = present.nonzero(as_tuple=True)
    here = box[:, world, agent, part]
    cell = road_map.cell(map_index[world], here[:2].t())
    index = road_map.cell_segments[cell]
    touch = box_touches_segment(here.unsqueeze(-1), [c[index] for c in road_map.segment.unbind(-1)])
    is_edge = road_map.segment_kind[index] == RoadKind.ROAD_EDGE
    off_road = road_map.cell_off_road[cell] & (part == 0)
    edge = present.new_zeros(present.shape[:2])
    boundary = torch.zeros_like(edge)
    hit = ((touch & is_edge).any(-1) | off_road).nonzero().squeeze(-1)
    edge[world[hit], agent[hit]] = True
    hit = (touch & ~is_edge).any(-1).nonzero().squeeze(-1)
    boundary[world[hit], agent[hit]] = True
    return edge, boundary
