"""The lane ahead as a frame of reference: metres along it and to its left, from what a vehicle sees of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phase_sumo.sim.geometry import wrap_angle
from phase_sumo.sim.road_map import RoadKind, RoadMap
from phase_sumo.sim.road_view import OWN_AHEAD
from phase_sumo.sim.vehicles import TensorBatch

LANE_CENTRE = int(RoadKind.LANE_CENTRE)
ROAD_EDGE = int(RoadKind.ROAD_EDGE)
BEHIND = 4.0  # m behind the rear axle from where on edges count
STRAIGHT = 1e-5  # 1/m: below that an arc counts as a straight line


@dataclass
class Sight:
    """The road as vehicles see it.

    Attributes:
        road_map: of all.
        view: [R] rows of `RoadMap.view`.
        x, y, yaw: [R] the nearest lane node in m, and the direction of its lane in rad.
    """

    road_map: RoadMap
    view: Tensor
    x: Tensor
    y: Tensor
    yaw: Tensor

    @property
    def points(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """x, y, cos, sin and kind [R, P] of the road points."""
        return self.road_map.seen_in(self.view)

    def take(self, index: Tensor) -> Sight:
        """Of vehicles ``index``."""
        return Sight(self.road_map, *(v[index] for v in (self.view, self.x, self.y, self.yaw)))


@dataclass
class Path(TensorBatch):
    """Circular arcs through the lane's centre, one path per vehicle; R vehicles x P points.

    Before the first point and behind the last one the path goes on as it does there.

    Attributes:
        x, y, yaw: [R, P] points in m and the direction of the lane in rad.
        s: [R, P] metres along the path from the first point; infinite where there is none.
        curvature: [R, P] of the arc that begins at each point, 1/m, positive to the left.
    """

    x: Tensor
    y: Tensor
    yaw: Tensor
    s: Tensor
    curvature: Tensor

    @staticmethod
    def ahead(sight: Sight) -> Path:
        """The own lane; it begins at the nearest lane node.

        The first road points of a view are the centres ahead in the own lane (`road_view.RoadView`).
        """
        own = len(OWN_AHEAD)
        x, y, cos, sin, kind = (column[:, :own] for column in sight.points)
        there = (kind == LANE_CENTRE).to(torch.int8).cumprod(1).bool()
        first = torch.ones_like(there[:, :1])
        there = torch.cat((first, there), 1)
        x, y = (torch.cat((a.unsqueeze(1), b), 1) for a, b in zip((sight.x, sight.y), (x, y), strict=True))
        yaw = torch.cat((sight.yaw.unsqueeze(1), torch.atan2(sin, cos)), 1)
        chord = torch.hypot(x.diff(dim=1), y.diff(dim=1))
        turn = wrap_angle(yaw.diff(dim=1))
        arc = chord * (1.0 + turn.square() / 24.0)
        linked = there[:, 1:] & (arc > 0.5)
        s = torch.cat((torch.zeros_like(arc[:, :1]), torch.where(linked, arc, torch.inf).cumsum(1)), 1)
        bend = torch.where(linked, turn / arc.clamp_min(0.5), 0.0)
        return Path(x, y, yaw, s, torch.cat((bend, torch.zeros_like(bend[:, :1])), 1))

    def locate(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions [R] relative to each path.

        On an arc with curvature k from a point, with the position u m ahead of it and w m to the left,
        turn = atan2(k u, 1 - k w), s = turn / k and d = (2 w - k (u^2 + w^2)) / (1 + hypot(k u, 1 - k w)).

        Returns:
            s and d (to the left) in m, and the direction of the path there in rad, all [R].
        """
        dx, dy = x.unsqueeze(1) - self.x, y.unsqueeze(1) - self.y
        cos, sin = torch.cos(self.yaw), torch.sin(self.yaw)
        passed = (dx * cos + dy * sin >= 0.0) & torch.isfinite(self.s)
        point = (passed.to(torch.int8).cumprod(1).sum(1, keepdim=True) - 1).clamp_min(0)
        dx, dy, cos, sin, yaw, s, k = (
            values.gather(1, point).squeeze(1)
            for values in (dx, dy, cos, sin, self.yaw, self.s, self.curvature)
        )
        u, w = dx * cos + dy * sin, dy * cos - dx * sin
        along, across = k * u, 1.0 - k * w
        turn = torch.atan2(along, across)
        d = (2.0 * w - k * (u.square() + w.square())) / (1.0 + torch.hypot(along, across))
        return s + torch.where(k.abs() > STRAIGHT, turn / k, u), d, yaw + turn

    def at(self, s: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """x and y [R] of places s, d [R] m along and to the left; the inverse of `locate`."""
        point = ((s.unsqueeze(1) >= self.s).sum(1, keepdim=True) - 1).clamp_min(0)
        x, y, yaw, start, k = (
            values.gather(1, point).squeeze(1)
            for values in (self.x, self.y, self.yaw, self.s, self.curvature)
        )
        along = s - start
        half = 0.5 * k * along
        chord = along * torch.sinc(half / torch.pi)
        turned = yaw + 2.0 * half
        x = x + chord * torch.cos(yaw + half) - d * torch.sin(turned)
        return x, y + chord * torch.sin(yaw + half) + d * torch.cos(turned)

    def curvature_at(self, s: Tensor) -> Tensor:
        """[R, T] curvature at places [R, T] along the paths."""
        step = torch.diff(self.curvature, dim=1)
        reached = s.unsqueeze(2) >= self.s[:, None, 1:]
        return self.curvature[:, :1] + (reached * step.unsqueeze(1)).sum(2)


def road_between(sight: Sight, path: Path, s: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
    """The road's edges to the right and to the left of lanes from s [R] on, along the next ``ahead`` [R] m.

    Returns:
        d of the edge points on either side that are nearest to the lane's centre, [R] in m, infinite where
        there is none.
    """
    x, y, _, _, kind = sight.points
    row, point = (kind == ROAD_EDGE).nonzero(as_tuple=True)
    along, aside, _ = path.take(row).locate(x[row, point], y[row, point])
    there = (along > s[row] - BEHIND) & (along < (s + ahead)[row])
    # not those beside the vehicle: who is over the right edge has it to the left
    left = torch.where(there & (aside > 0.0), aside, torch.inf)
    right = torch.where(there & (aside < 0.0), aside, -torch.inf)
    none = torch.full_like(s, torch.inf)
    return (-none).scatter_reduce_(0, row, right, "amax"), none.scatter_reduce_(0, row, left, "amin")
