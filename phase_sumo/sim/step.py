"""One step of the world model and what is seen after it: the same for training, evaluation and tests."""

from __future__ import annotations

import torch
from torch import Tensor

from phase_sumo.config import SimConfig
from phase_sumo.sim import kinematics
from phase_sumo.sim.events import Events, detect
from phase_sumo.sim.geometry import materialise
from phase_sumo.sim.neighbours import nearest
from phase_sumo.sim.observation import Appearance, Observation, appearance, observe
from phase_sumo.sim.road_map import RoadMap
from phase_sumo.sim.vehicles import Task, VehicleShape, VehicleState


def step(
    shape: VehicleShape,
    before: VehicleState,
    task: Task,
    agents: Tensor,
    there: Tensor,
    jerk: Tensor,
    rate: Tensor,
    road_map: RoadMap,
    map_index: Tensor,
    sim: SimConfig,
    trailers: int,
    by_script: tuple[Tensor, VehicleState] | None = None,
) -> tuple[VehicleState, Events]:
    """States after ``sim.dt`` and what happened on the way; all [W, N].

    Args:
        agents: bool, who moves by the commands ``jerk`` in m/s^3 and ``rate``, of the steering, in rad/s.
        there: bool, whom agents can meet, scripted vehicles included.
        map_index: [W] row of the road map.
        trailers: only this many slots, the first ones, may have a trailer.
        by_script: who is moved by a script, and to where.
    """
    after = kinematics.advance(shape, before, jerk, rate, sim).where(agents, before)
    if by_script is not None:
        scripted, state = by_script
        after = state.where(scripted, after)
    return after, detect(shape, before, after, task, there, road_map, map_index, sim, trailers)


def look(
    shape: VehicleShape,
    state: VehicleState,
    task: Task,
    active: Tensor,
    road_map: RoadMap,
    map_index: Tensor,
    noise: tuple[Tensor, Tensor] | None,
    sim: SimConfig,
    index: Tensor | None = None,
) -> Observation:
    """What the agents in the slots ``index`` [A] of all W N see, [A, ...], or all of them, [W, N, ...].

    Rows of inactive slots mean nothing.
    """
    if index is None:
        every = torch.arange(active.numel(), device=active.device)
        seen = look(shape, state, task, active, road_map, map_index, noise, sim, every)
        return seen.map(lambda values: values.unflatten(0, active.shape))

    def rows(values: Tensor) -> Tensor:
        return values.flatten(0, 1)[index]

    near, mask = nearest(state.x, state.y, active, sim)
    (near,) = materialise(near)
    first = index - index % active.shape[1]  # slot of each agent's world
    table = materialise(*(values.flatten() for values in vars(appearance(shape, state)).values()))
    others = Appearance(*(values[rows(near) + first.unsqueeze(-1)] for values in table))
    cell = road_map.cell(map_index, state.x, state.y)
    cell, view = materialise(cell, road_map.cell_view[cell])
    return observe(
        shape.map(rows),
        state.map(rows),
        task.map(rows),
        others,
        rows(mask),
        road_map,
        rows(view),
        road_map.cell_yaw[rows(cell)],
        sim,
        None if noise is None else (rows(noise[0]), rows(noise[1])),
    )
