"""WGS 84 <-> coordinates of a network."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import Proj
from pyproj.exceptions import ProjError

from phase_sumo.errors import PhaseError
from phase_sumo.sim.lanes import GeoReference

FloatArray = NDArray[np.float64]


class NetProjection:
    """Geographic reference of one network.

    Args:
        reference: of the network (`LaneNetwork.geo`), None where the file has no ``<location>``.
        name: of the network, for messages.

    Raises:
        PhaseError: the network has no projection, or one that pyproj does not know.
    """

    def __init__(self, reference: GeoReference | None, name: str) -> None:
        if reference is None or reference.projection in ("", "!", "-"):
            given = "no <location>" if reference is None else f"projParameter={reference.projection!r}"
            raise PhaseError(
                f"{name}: no geographic reference ({given}); import the network again with a projection "
                "(netconvert --proj.utm)"
            )
        try:
            x, y = (float(v) for v in reference.net_offset.split(",")[:2])
            if not np.isfinite((x, y)).all():
                raise ValueError
        except ValueError:
            raise PhaseError(
                f"{name}: netOffset={reference.net_offset!r}, expected 'x,y' in m; "
                "write the network again with netconvert"
            ) from None
        try:
            self._project = Proj(reference.projection)
        except ProjError as error:
            raise PhaseError(
                f"{name}: projParameter={reference.projection!r} is no projection "
                f"({' '.join(str(error).split())}); write the network again with netconvert"
            ) from error
        self._offset = x, y

    def to_xy(self, lon: ArrayLike, lat: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Network coordinates in m of longitudes and latitudes in degrees; inf where there are none."""
        x, y = self._project(np.asarray(lon, float), np.asarray(lat, float))
        return np.asarray(x) + self._offset[0], np.asarray(y) + self._offset[1]

    def to_lonlat(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Longitudes and latitudes in degrees of network coordinates in m; inf where there are none."""
        x, y = np.asarray(x, float) - self._offset[0], np.asarray(y, float) - self._offset[1]
        lon, lat = self._project(x, y, inverse=True)
        return np.asarray(lon), np.asarray(lat)
