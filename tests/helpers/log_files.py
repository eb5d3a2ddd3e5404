"""One small scene of recorded traffic, written in every format that the log readers know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import Proj

LANES, WIDTH, ROAD = 3, 3.66, 400.0  # lane k, counted from the right, has its centre at y = (k + 1/2) WIDTH
SECONDS = 10.4
FOOT = 0.3048
ORIGIN = 351_000.0, 5_649_000.0  # UTM 32N, of exiD's local frame


@dataclass(frozen=True)
class Vehicle:
    """Drives along x at a constant speed; changes lanes on half a cosine between two times."""

    x0: float
    speed: float
    lane: int
    length: float
    width: float
    kind: str
    words: str
    begin: float = 0.0
    to_lane: int | None = None
    change: tuple[float, float] = (4.0, 7.0)

    def at(self, t):
        """Box centre x, y in m and yaw at times t in s."""
        start, end = self.change
        share = np.clip((t - start) / (end - start), 0.0, 1.0)
        way = WIDTH * ((self.lane if self.to_lane is None else self.to_lane) - self.lane)
        y = (self.lane + 0.5) * WIDTH + way * 0.5 * (1.0 - np.cos(np.pi * share))
        rate = way * 0.5 * np.pi / (end - start) * np.sin(np.pi * share)
        return self.x0 + self.speed * (t - self.begin), y, np.arctan2(rate, self.speed)

    def times(self, rate):
        first = int(np.ceil(self.begin * rate - 1e-9))
        return np.arange(first, round(SECONDS * rate) + 1) / rate


SCENE = (
    Vehicle(20.0, 30.0, 0, 4.8, 1.9, "car", "car", to_lane=1),
    Vehicle(60.0, 25.0, 2, 4.5, 1.8, "car", "car"),
    Vehicle(120.0, 22.0, 0, 18.6, 2.5, "articulated_truck", "truck"),
    Vehicle(5.0, 20.0, 2, 9.2, 2.4, "rigid_truck", "truck", begin=3.0),
)


def rows(rate):
    """(id, vehicle, t, x, y, yaw) of all samples."""
    for number, vehicle in enumerate(SCENE, start=7):
        for t in vehicle.times(rate):
            yield (number, vehicle, t, *vehicle.at(t))


def write_tracks(path: Path, direction: int = 1, **renamed: str) -> Path:
    """Columns as in I-24's: x of the rear's centre; y mirrored and lanes counted on for direction -1."""
    names = [
        "scene",
        "direction",
        "id",
        "t",
        "x_rear_m",
        "y_m",
        "lane",
        "v_mps",
        "length_m",
        "width_m",
        "class",
    ]
    lines = [",".join(renamed.get(name, name) for name in names)]
    for number, v, t, x, y, yaw in rows(10):
        x, y = x - 0.5 * v.length * np.cos(yaw), y - 0.5 * v.length * np.sin(yaw)
        middle = v.at(t)[1]
        lane, y = (
            (middle // WIDTH, y) if direction > 0 else (LANES + 2 - middle // WIDTH, (LANES + 3) * WIDTH - y)
        )
        speed = v.speed / np.cos(yaw)
        lines.append(
            f"a,{direction},{number},{t:.1f},{x:.4f},{y:.4f},{lane:.0f},{speed:.3f},{v.length},{v.width},{v.words}"
        )
    path.write_text("\n".join(lines) + "\n")
    return path


def write_levelx(folder: Path, exid: bool, upper: bool = False, number: str = "03") -> Path:
    """The three files of exiD or highD; ``upper``: turned by 180 degrees onto highD's upper carriageway."""
    tracks, meta = [], []
    if exid:
        tracks.append("recordingId,trackId,frame,laneletId,xCenter,yCenter,heading,xVelocity,yVelocity")
        meta.append("recordingId,trackId,initialFrame,width,length,class")
        about = ["recordingId,locationId,frameRate,xUtmOrigin,yUtmOrigin", f"3,2,25,{ORIGIN[0]},{ORIGIN[1]}"]
    else:
        tracks.append("frame,id,x,y,width,height,xVelocity,yVelocity,laneId")
        meta.append("id,width,height,initialFrame,class,drivingDirection")
        lines = [";".join(f"{base + k * WIDTH:.2f}" for k in range(LANES + 1)) for base in (2.0, 20.0)]
        about = [
            "id,frameRate,speedLimit,upperLaneMarkings,lowerLaneMarkings",
            f"3,25,-1,{lines[0]},{lines[1]}",
        ]
    for number_of, v, t, x, y, yaw in rows(25):
        vx, vy = v.speed, v.speed * np.tan(yaw)
        frame = round(t * 25)
        if exid:
            heading = np.rad2deg(yaw) % 360.0
            tracks.append(f"3,{number_of},{frame},12;13,{x:.4f},{y:.4f},{heading:.4f},{vx:.4f},{vy:.4f}")
            continue
        # image: y down; the lower carriageway's left border is its uppermost marking
        if upper:
            x, down, vx, vy = ROAD - x, 2.0 + y, -vx, vy
        else:
            down, vy = 20.0 + LANES * WIDTH - y, -vy
        corner = x - 0.5 * v.length, down - 0.5 * v.width
        tracks.append(
            f"{frame},{number_of},{corner[0]:.4f},{corner[1]:.4f},{v.length},{v.width},{vx:.4f},{vy:.4f},2"
        )
    for number_of, v in enumerate(SCENE, start=7):
        if exid:
            meta.append(f"3,{number_of},0,{v.width},{v.length},{v.words}")
        else:
            meta.append(f"{number_of},{v.length},{v.width},0,{v.words.capitalize()},{1 if upper else 2}")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("tracks", tracks), ("tracksMeta", meta), ("recordingMeta", about)):
        (folder / f"{number}_{name}.csv").write_text("\n".join(text) + "\n")
    return folder / f"{number}_tracks.csv"


def write_lanelet2(path: Path) -> Path:
    """Two lanelets per lane; the marking left of lane 1 is solid, every other bound is drawn backwards."""
    project = Proj(proj="utm", zone=32, ellps="WGS84")
    places = np.linspace(0.0, ROAD, 21)
    lines = ["<?xml version='1.0'?>", "<osm version='0.6'>"]
    for k in range(LANES + 1):
        for i, x in enumerate(places):
            lon, lat = project(ORIGIN[0] + x, ORIGIN[1] + k * WIDTH, inverse=True)
            lines.append(f"<node id='{100 * (k + 1) + i}' lat='{lat:.12f}' lon='{lon:.12f}'/>")
    for k in range(LANES + 1):
        for half in (0, 1):
            refs = range(10 * half, 10 * half + 11)
            nodes = "".join(f"<nd ref='{100 * (k + 1) + i}'/>" for i in (refs if k % 2 else reversed(refs)))
            subtype = "solid" if k in (0, 2, LANES) else "dashed"
            lines.append(
                f"<way id='{1000 + 10 * k + half}'>{nodes}<tag k='type' v='line_thin'/>"
                f"<tag k='subtype' v='{subtype}'/></way>"
            )
    for k in range(LANES):
        for half in (0, 1):
            lines += [
                f"<relation id='{5000 + 10 * k + half}'>"
                f"<member type='way' ref='{1010 + 10 * k + half}' role='left'/>"
                f"<member type='way' ref='{1000 + 10 * k + half}' role='right'/>"
                "<tag k='type' v='lanelet'/><tag k='subtype' v='highway'/></relation>"
            ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*lines, "</osm>"]) + "\n")
    return path


def write_ngsim(path: Path, periods: int = 1, header: bool = True) -> Path:
    """Feet, centre of the front, Local_X to the right of the left border; lanes counted from the left."""
    names = (
        "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,Global_X,Global_Y,v_length,v_Width,"
        "v_Class,v_Vel,v_Acc,Lane_ID,Preceding,Following,Space_Headway,Time_Headway"
    )
    lines = [names] if header else []
    for period in range(periods):
        for number, v, t, x, y, yaw in rows(10):
            front = x + 0.5 * v.length * np.cos(yaw), y + 0.5 * v.length * np.sin(yaw)
            clock = 1118846000000 + 900_000 * period + round(1000 * t)
            fields = (
                number,
                round(10 * t) + 13,
                100,
                clock + 1300,
                f"{(LANES * WIDTH - front[1]) / FOOT:.3f}",
                f"{front[0] / FOOT:.3f}",
                0,
                0,
                f"{v.length / FOOT:.3f}",
                f"{v.width / FOOT:.3f}",
                3 if v.words == "truck" else 2,
                f"{v.speed / FOOT:.2f}",
                0,
                int(LANES - y // WIDTH),
                0,
                0,
                0,
                0,
            )
            lines.append(("," if header else "  ").join(map(str, fields)))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_commonroad(path: Path, words: bool = True) -> Path:
    """A scenario of format 2020a; ``words``: obstacles have types, instead of all being cars."""

    def bound(name, y, x0, x1):
        points = "".join(
            f"<point><x>{x:.3f}</x><y>{y:.3f}</y></point>" for x in np.repeat(np.linspace(x0, x1, 5), 2)
        )
        return f"<{name}>{points}<lineMarking>dashed</lineMarking></{name}>"

    def lanelet(k, half):
        links = f'<successor ref="{10 * k + 1}"/>' if half == 0 else f'<predecessor ref="{10 * k}"/>'
        x0, x1 = half * ROAD / 2, (half + 1) * ROAD / 2
        if k + 1 < LANES:
            links += f'<adjacentLeft ref="{10 * (k + 1) + half}" drivingDir="same"/>'
        if k:
            links += f'<adjacentRight ref="{10 * (k - 1) + half}" drivingDir="same"/>'
        return (
            f'<lanelet id="{10 * k + half}">{bound("leftBound", (k + 1) * WIDTH, x0, x1)}'
            f"{bound('rightBound', k * WIDTH, x0, x1)}{links}<laneletType>highway</laneletType></lanelet>"
        )

    def state(tag, v, t):
        x, y, yaw = v.at(t)

        def exact(name, value):
            return f"<{name}><exact>{value}</exact></{name}>"

        return (
            f"<{tag}><position><point><x>{x:.4f}</x><y>{y:.4f}</y></point></position>"
            f"{exact('orientation', f'{yaw:.5f}')}{exact('time', round(10 * t))}"
            f"{exact('velocity', f'{v.speed / np.cos(yaw):.4f}')}</{tag}>"
        )

    def obstacle(number, v):
        first, *others = v.times(10)
        trajectory = "".join(state("state", v, t) for t in others)
        return (
            f'<dynamicObstacle id="{number}"><type>{v.words if words else "car"}</type><shape><rectangle>'
            f"<length>{v.length}</length><width>{v.width}</width></rectangle></shape>"
            f"{state('initialState', v, first)}<trajectory>{trajectory}</trajectory></dynamicObstacle>"
        )

    lanelets = "".join(lanelet(k, half) for k in range(LANES) for half in (0, 1))
    obstacles = "".join(obstacle(number, v) for number, v in enumerate(SCENE, start=107))
    path.write_text(
        '<?xml version="1.0"?><commonRoad benchmarkID="DEU_Straight-1_1_T-1" commonRoadVersion="2020a" '
        'date="2024-01-01" author="" affiliation="" source="" timeStepSize="0.1"><location>'
        "<geoNameId>-999</geoNameId><gpsLatitude>999</gpsLatitude><gpsLongitude>999</gpsLongitude></location>"
        f"<scenarioTags><highway/></scenarioTags>{lanelets}{obstacles}</commonRoad>\n"
    )
    return path
