"""Fields of generation 4's sensor strip at different distances, heights and orientations."""

from __future__ import annotations

import numpy as np

from srs_twin import load_robot
from srs_twin.sensing.hall import (
    GAUSS,
    MAGNET_DIAMETER,
    MAGNET_HEIGHT,
    HallCalibration,
    Strip,
    element_place,
    field,
    fit_line,
)

MM = 1e-3
LENGTH = load_robot("gen4").geometry.segment_length
BENDS = np.linspace(-np.pi / 2, np.pi / 2, 181)


def strip(
    distance: float,
    heights: tuple[float, float],
    orientation: str,
    length: float = LENGTH,
) -> Strip:
    magnet, element = heights
    return Strip(
        segment_length=length,
        distance=distance * MM,
        orientation=orientation,
        magnet_height=magnet * MM,
        element_height=element * MM,
    )


def line(sensor: Strip) -> HallCalibration:
    """Fit the straight line from field (G) to angle."""
    return fit_line(field(BENDS, sensor) / GAUSS, BENDS)


def reach(sensor: Strip) -> float:
    """Return the difference of the fields at ±90°, G."""
    return float(
        abs(np.diff(field(np.array([-np.pi / 2, np.pi / 2]), sensor))[0]) / GAUSS
    )


def of_cylinder(sensor: Strip, elements: int = 12) -> np.ndarray:
    """Return B_n (T) at `BENDS` of the whole cylinder, as small dipoles along the magnetic moment."""
    x, y, theta = element_place(BENDS, sensor)
    across = ((np.arange(elements) + 0.5) / elements - 0.5) * MAGNET_DIAMETER
    along = ((np.arange(elements) + 0.5) / elements - 0.5) * MAGNET_HEIGHT
    u, v, w = (
        axis.ravel() for axis in np.meshgrid(across, across, along, indexing="ij")
    )
    inside = u**2 + v**2 <= (MAGNET_DIAMETER / 2) ** 2
    u = u[inside]
    v = v[inside]
    w = w[inside]
    up = sensor.orientation == "up"
    r = np.stack(
        [
            x[:, None] - (u if up else w),
            y[:, None] - (w if up else u),
            np.broadcast_to(v, (len(x), len(v))),
        ]
    )
    moment = np.array([0.0, sensor.moment, 0.0] if up else [sensor.moment, 0.0, 0.0])
    square = (r**2).sum(axis=0)
    b = 1e-7 * (
        3 * np.einsum("i,ijk->jk", moment, r) * r / square**2.5
        - moment[:, None, None] / square**1.5
    )
    b_x, b_y = b.mean(axis=2)[:2]
    return b_y * np.cos(theta) - b_x * np.sin(theta)
