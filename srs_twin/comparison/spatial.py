"""Metrics of a snake whose segments bend in two directions: travel, heights and contact."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.comparison.gait import GaitWindow
from srs_twin.comparison.sampling import units_of
from srs_twin.trajectory import Trajectory

SPATIAL_UNITS = units_of("travel_speed_m_s travel_direction_rad body_height_m contact_share")
"""Metrics of a spatial snake; each is one number or None."""


def spatial_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Compute the metrics of a run of a spatial snake; a planar one has none of them.

    - ``travel_speed_m_s``: magnitude of the mean velocity of the centre of mass over whole gait periods. A
      sidewinder travels across its body, so that its forward speed is only a part of it.
    - ``travel_direction_rad``: direction of that velocity relative to the mean heading, positive to the left,
      −π to π.
    - ``body_height_m``: largest height of a connector in the same periods.
    - ``contact_share``: mean share of connectors that press on the floor.

    The first two are None without a gait of at least three whole periods.
    """
    if not trajectory.has("z"):
        return {}
    metrics: dict[str, float | None] = dict.fromkeys(SPATIAL_UNITS)
    window = GaitWindow.from_trajectory(trajectory)
    used = slice(None)
    if window is not None:
        heading, _ = window.running_mean(trajectory, trajectory["heading"])
        _, velocity = window.running_mean(trajectory, trajectory.com)
        c, s = np.cos(heading), np.sin(heading)
        ahead = float((c * velocity[:, 0] + s * velocity[:, 1]).mean())
        left = float((c * velocity[:, 1] - s * velocity[:, 0]).mean())
        metrics["travel_speed_m_s"] = math.hypot(ahead, left)
        metrics["travel_direction_rad"] = math.atan2(left, ahead)
        used = slice(int(np.searchsorted(trajectory.time, window.start)), None)
    metrics["body_height_m"] = float(trajectory.stack("z")[used].max())
    metrics["contact_share"] = float((trajectory.stack("load")[used] > 0.0).mean())
    return metrics
