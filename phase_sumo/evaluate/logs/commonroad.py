"""CommonRoad scenarios (XML or protobuf), through commonroad-io: recorded obstacles on lanelets.

What commonroad-dataset-converter makes of exiD, highD or INTERACTION reads the same way. The reference point
of an obstacle is the centre of its rectangle, as the format says.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.logs.kinds import kind_of
from phase_sumo.evaluate.logs.quality import finished
from phase_sumo.evaluate.logs.recording import Recording
from phase_sumo.evaluate.logs.roads import SPEED_LIMIT
from phase_sumo.evaluate.logs.sampling import on_grid, path_speed
from phase_sumo.sim.lanes import Lane, LaneNetwork

FloatArray = NDArray[np.float64]
CLOSEST = 1.0  # m between points of a centre line: lanelets repeat some, which would turn it at random
VEHICLES = frozenset({"car", "truck", "bus", "motorcycle", "taxi", "priorityVehicle"})


def read_commonroad(path: str | Path) -> Recording:
    """One scenario.

    Raises:
        PhaseError: commonroad-io is not installed, or the file is no scenario with moving vehicles on
            lanelets.
    """
    path = Path(path)
    try:
        from commonroad.common.file_reader import CommonRoadFileReader
    except ImportError as error:
        raise PhaseError(
            f"{path}: CommonRoad files need commonroad-io ({error}); pip install 'phase-sumo[commonroad]'"
        ) from None
    try:
        scenario, _ = CommonRoadFileReader(str(path)).open()
    except OSError as error:
        raise PhaseError(f"{path}: cannot be read ({error.strerror}); pass an existing file") from None
    except Exception as error:  # the library raises whatever its parsers do
        raise PhaseError(f"{path}: no CommonRoad scenario ({type(error).__name__}: {error})") from error
    if not scenario.lanelet_network.lanelets:
        raise PhaseError(f"{path}: no lanelet in it; pass a scenario with its road")
    name = path.name.partition(".")[0]
    obstacles = [o for o in scenario.dynamic_obstacles if o.obstacle_type.value in VEHICLES and _is_track(o)]
    if not obstacles:
        raise PhaseError(f"{path}: no vehicle with a trajectory in it; pass a recorded scenario")
    return finished(_recording(path, name, scenario, obstacles), path)


def _is_track(obstacle: Any) -> bool:
    return hasattr(obstacle.prediction, "trajectory") and hasattr(obstacle.obstacle_shape, "length")


def _recording(path: Path, name: str, scenario: Any, obstacles: list[Any]) -> Recording:
    samples = [
        (v, s)
        for v, o in enumerate(obstacles)
        for s in (o.initial_state, *o.prediction.trajectory.state_list)
    ]
    rows = np.array(
        [(v, s.time_step, *s.position, s.orientation, getattr(s, "velocity", np.nan)) for v, s in samples],
        np.float64,
    )
    yaw, speed = rows[:, 4], rows[:, 5]
    columns = [rows[:, 2], rows[:, 3], np.cos(yaw), np.sin(yaw), np.abs(speed)]
    grid = on_grid(path, rows[:, 0].astype(np.int64), rows[:, 1] * scenario.dt, np.stack(columns))
    x, y, cos, sin, speeds = grid.values
    length = np.array([o.obstacle_shape.length for o in obstacles], np.float64)
    classes = [o.obstacle_type.value for o in obstacles]
    told = len(set(classes)) > 1  # where all are "car", nobody has looked
    return Recording(
        name=name,
        source="commonroad",
        network=lane_network(scenario.lanelet_network, name),
        present=grid.present,
        x=x,
        y=y,
        yaw=np.arctan2(sin, cos),
        speed=np.where(np.isnan(speeds), path_speed(x, y, grid.present), speeds),
        length=length,
        width=np.array([o.obstacle_shape.width for o in obstacles], np.float64),
        kind=tuple(kind_of(a, b if told else None) for a, b in zip(length, classes, strict=True)),
        flags=(frozenset(),) * len(obstacles),
    )


def lane_network(lanelets: Any, name: str) -> LaneNetwork:
    """A lane for every lanelet, as wide as it is in the median.

    Lanelets abreast in the same direction share an edge; a change is allowed across any marking but a solid
    one. A lanelet without a successor (predecessor) ends (begins) within the road where one abreast goes on.
    """
    found = lanelets.lanelets
    number = {lanelet.lanelet_id: i for i, lanelet in enumerate(found)}
    beside = [
        (
            number.get(lanelet.adj_left, -1) if lanelet.adj_left_same_direction else -1,
            number.get(lanelet.adj_right, -1) if lanelet.adj_right_same_direction else -1,
        )
        for lanelet in found
    ]
    edges = _edges(beside)
    follows = [any(n in number for n in lanelet.successor) for lanelet in found]
    leads = [any(n in number for n in lanelet.predecessor) for lanelet in found]
    lanes = []
    for i, (lanelet, (left, right)) in enumerate(zip(found, beside, strict=True)):
        abreast = [k for k, edge in enumerate(edges) if edge == edges[i]]
        solid_left = left >= 0 and _is_solid(lanelet.line_marking_left_vertices)
        solid_right = right >= 0 and _is_solid(lanelet.line_marking_right_vertices)
        points = _centre(lanelet)
        lanes.append(
            Lane(
                id=str(lanelet.lanelet_id),
                edge=str(found[edges[i]].lanelet_id),
                points=points,
                width=_width(lanelet),
                speed_limit=SPEED_LIMIT,
                length=float(np.hypot(*np.diff(points, axis=0).T).sum()),
                left=-1 if solid_left else left,
                right=-1 if solid_right else right,
                solid_left=solid_left,
                solid_right=solid_right,
                dead_start=not leads[i] and any(leads[k] for k in abreast),
                dead_end=not follows[i] and any(follows[k] for k in abreast),
            )
        )
    links = tuple((i, number[n]) for i, lanelet in enumerate(found) for n in lanelet.successor if n in number)
    return LaneNetwork(name, tuple(lanes), links)


def _edges(beside: list[tuple[int, int]]) -> list[int]:
    """Per lane the first of all lanes that can be reached from it sideways."""
    edge = list(range(len(beside)))
    for _ in beside:
        lower = [min(e, *(edge[k] for k in pair if k >= 0), e) for e, pair in zip(edge, beside, strict=True)]
        if lower == edge:
            break
        edge = lower
    return edge


def _is_solid(marking: Any) -> bool:
    return marking.value in ("solid", "broad_solid")


def _centre(lanelet: Any) -> FloatArray:
    points = np.asarray(lanelet.center_vertices, np.float64)
    keep = [0]
    for i in range(1, len(points)):
        if np.hypot(*(points[i] - points[keep[-1]])) >= CLOSEST:
            keep.append(i)
    if len(keep) > 1 and keep[-1] != len(points) - 1:
        keep[-1] = len(points) - 1
    return points[keep] if len(keep) > 1 else points[[0, -1]]


def _width(lanelet: Any) -> float:
    """Median distance from the points of one bound to the line of the other."""
    left, right = (np.asarray(v, np.float64) for v in (lanelet.left_vertices, lanelet.right_vertices))
    along = np.gradient(0.5 * (left + right), axis=0)
    normal = np.stack((-along[:, 1], along[:, 0]), -1) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    return float(np.median(np.abs(((left - right) * normal).sum(1))))
