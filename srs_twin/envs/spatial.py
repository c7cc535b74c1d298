"""Crawl3D: crawl to a goal on an open floor with a spatial robot, by a gait with a pitch wave.

Reward and endings are those of `crawling`. The agent also commands the pitch wave, so that it can undulate,
sidewind to both sides or crawl rectilinearly (`control.gait`). With a share of 0 the wave to the left and
right remains.
"""

from __future__ import annotations

import math
from typing import Any

from srs_twin.control.commands import MAX_OFFSET, GaitCommand, GaitLimits
from srs_twin.control.gait import PitchWave
from srs_twin.envs.crawling import CAMERA, Arena, CrawlEpisode, CrawlTask
from srs_twin.envs.task import Signal, Signals
from srs_twin.planning.camera import Camera
from srs_twin.robot.world import Bounds

FLOOR = Arena(
    room=Bounds((-2.0, 2.0), (-2.0, 2.0)),
    headings=(-math.pi, math.pi),
    distances=(0.4, 1.0),
    bearings=(-math.pi, math.pi),
)
"""Open floor; the goal may be in any direction, because a sidewinder does not travel along its heading."""

FREQUENCY_RANGE_HZ = (0.25, 1.0)
"""Gait frequencies, Hz; at 1 Hz the inertia of the lifted parts is no longer small (docs/spatial.md)."""

RELATIVE_PRESSURE_RANGE = (0.25, 0.6)
"""Supply pressures divided by the nominal one, 1: 12 to 29 kPa for `spatial_example`, bends of 0.4 to 0.9
rad per segment."""


class SpatialCrawlTask(CrawlTask):
    """Task of crawling to a goal with a spatial robot (module docstring)."""

    spatial = True

    def __init__(
        self,
        *,
        robot: str = "spatial_example",
        limit_s: float = 30.0,
        camera: Camera = CAMERA,
        **settings: Any,
    ) -> None:
        """Create the task; arguments and errors as in `CrawlTask`.

        Raises:
            InputError: the robot is planar, or as in `CrawlTask`.
        """
        super().__init__("Crawl3D", FLOOR, robot=robot, limit_s=limit_s, camera=camera, **settings)

    def _gait_limits(self) -> GaitLimits:
        low, high = (ratio * self.robot.supply.nominal for ratio in RELATIVE_PRESSURE_RANGE)
        return GaitLimits((-MAX_OFFSET, MAX_OFFSET), FREQUENCY_RANGE_HZ, (low, high))

    def _action_signals(self) -> Signals:
        lag = "lag of the pitch wave; π/2: sidewinding to the right"
        return (
            *super()._action_signals(),
            Signal("pitch_share", "1", 0.0, 1.0, "share of the pitch wave in the sum of the amplitudes"),
            Signal("pitch_lag_rad", "rad", -math.pi, math.pi, lag),
        )

    @property
    def _episode_class(self) -> type[CrawlEpisode]:
        return SpatialCrawlEpisode


class SpatialCrawlEpisode(CrawlEpisode):
    """Episode of crawling to a goal with a spatial robot."""

    state_attributes = ("_pitch",)

    _pitch = (0.0, 0.0)
    """Share and lag (rad) of the last pitch wave."""

    def _command(self, action: list[float]) -> tuple[GaitCommand, PitchWave | None]:
        share, lag = self._pitch = action[3], action[4]
        return super()._command(action[:3])[0], PitchWave(share, lag)

    def _last_command(self) -> list[float]:
        return [*super()._last_command(), *self._pitch]
