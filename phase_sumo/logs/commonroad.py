"""CommonRoad scenarios (XML or protobuf), through commonroad-io: recorded obstacles on lanelets.

What commonroad-dataset-converter makes of exiD, highD or INTERACTION reads the same way. The reference point
of an obstacle is the centre of its rectangle, as the format says. The 13 scenes of US-101 do not contradict:
over 414 pairs of follower and leader, the spacing depends on half the difference of leader's and follower's
length with a slope of 0.5 +- 0.6, where positions of the centre would give 0, of the front 1, of the rear -1;
boxes of neighbours in a lane overlap with none of the three.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from phase_sumo.errors import PhaseError
from phase_sumo.logs.recorded_roads import Strip, strip_road
from phase_sumo.logs.recording import Recording, kind_of
from phase_sumo.logs.sampling import on_grid, path_speed
from phase_sumo.logs.windows import finished
from phase_sumo.sim.lanes import LaneNetwork

VEHICLES = frozenset({"car", "truck", "bus", "motorcycle", "taxi", "priorityVehicle"})


def file_reader(path: Path) -> Any:
    """CommonRoad's own reader.

    Raises:
        PhaseError: commonroad-io is not installed; ``path`` is what needs it.
    """
    try:
        from commonroad.common.file_reader import CommonRoadFileReader
    except ImportError as error:
        raise PhaseError(
            f"{path}: CommonRoad files need commonroad-io ({error}); pip install 'phase-sumo[commonroad]'"
        ) from None
    return CommonRoadFileReader


def read_commonroad(path: str | Path) -> Recording:
    """One scenario.

    Raises:
        PhaseError: commonroad-io is not installed, or the file is no scenario with moving vehicles on
            lanelets.
    """
    path = Path(path)
    reader = file_reader(path)
    try:
        scenario, _ = reader(str(path)).open()
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
    vehicle, time = rows[:, 0].astype(np.int64), rows[:, 1] * scenario.dt
    grid = on_grid(path, vehicle, time, np.stack(columns), len(obstacles))
    x, y, cos, sin, speeds = grid.values
    length = np.array([o.obstacle_shape.length for o in obstacles], np.float64)
    classes = [o.obstacle_type.value for o in obstacles]
    told = len(set(classes)) > 1  # where all are "car", nobody has looked
    return Recording(
        name=name,
        source=f"{scenario.scenario_id.country_id}_{scenario.scenario_id.map_name}",
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
    """A lane for every lanelet; a change is allowed across any marking but a solid one."""
    found = lanelets.lanelets
    number = {lanelet.lanelet_id: i for i, lanelet in enumerate(found)}
    return strip_road(
        name,
        [
            Strip(
                id=str(lanelet.lanelet_id),
                left=np.asarray(lanelet.left_vertices, np.float64),
                right=np.asarray(lanelet.right_vertices, np.float64),
                left_of=number.get(lanelet.adj_left, -1) if lanelet.adj_left_same_direction else -1,
                right_of=number.get(lanelet.adj_right, -1) if lanelet.adj_right_same_direction else -1,
                solid_left=_is_solid(lanelet.line_marking_left_vertices),
                solid_right=_is_solid(lanelet.line_marking_right_vertices),
                successors=tuple(number[n] for n in lanelet.successor if n in number),
            )
            for lanelet in found
        ],
    )


def _is_solid(marking: Any) -> bool:
    return marking.value in ("solid", "broad_solid")
