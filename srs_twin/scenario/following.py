"""Following of a plan, as a scenario has it: gait, follower, planner, able to make the controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from srs_twin.scenario.control import GaitSettings, LearningSettings
from srs_twin.scenario.control_file import FollowFile
from srs_twin.scenario.route_finding import GIVEN, PlannerSettings

if TYPE_CHECKING:
    from srs_twin.control.base import Controller
    from srs_twin.control.following import Conditions, Steering
    from srs_twin.planning import Footprint

GAIN_PER_RAD = 0.6
NODE_M = 0.2
NEAR_M = 0.2
LOOKAHEAD_M = 0.15
SETTLE_M = 0.05
"""Defaults: docs/following.md says how they were found."""


@dataclass(frozen=True)
class FollowSettings:
    """A follower on top of a gait.

    Attributes:
        gait: what is steered.
        planner: what plans, and with which footprint.
        follower: "bearing" or "path".
        delay: of commands, s.
        camera: rate (Hz), noise of position (m) and of heading (rad).
        gain: offset for an error of bearing, 1/rad.
        spacing: of nodes, m.
        near: to a node, m.
        lookahead: L, m.
        settle: ℓ, m; None: the footprint's.
        stray: distance from the path that calls for a new plan, m; None: never.
        replans: how many new plans at most.
    """

    gait: GaitSettings | LearningSettings
    planner: PlannerSettings
    follower: str
    delay: float
    camera: tuple[float, float, float]
    gain: float
    spacing: float
    near: float
    lookahead: float
    settle: float | None
    stray: float | None
    replans: int

    def make(self) -> Controller:
        """Return a fresh controller; the first time this plans.

        Raises:
            InputError: start or goal cannot be, or the extra `ompl` is missing.
        """
        from srs_twin.control.following import Follower

        planner = self.planner
        return Follower(
            self.gait.make(), self._law(), planner.plan(), planner.problem.goal, planner.footprint,
            self._conditions(), body=planner.problem.footprint, world=planner.problem.world,
            replan=None if planner.kind == GIVEN else planner.plan_from,
        )  # fmt: skip

    def _conditions(self) -> Conditions:
        from srs_twin.control.camera import Camera
        from srs_twin.control.following import Conditions

        return Conditions(Camera(*self.camera), self.delay, self._settled, self.stray, self.replans)

    def _law(self) -> Steering:
        from srs_twin.control.following import BearingLaw, PathLaw

        if self.follower == "bearing":
            return BearingLaw(self.gain, self.spacing, self.near)
        return PathLaw(self.planner.footprint, self.lookahead, self._settled)

    @property
    def _settled(self) -> float:
        return _settling(self.planner.footprint) if self.settle is None else self.settle


def _settling(footprint: Footprint) -> float:
    """Return ℓ of a footprint: what follows with a lag of ℓ is there, but for 5 %, after 3 ℓ."""
    longest = max((each.length for each in footprint.transients), default=3 * SETTLE_M)
    return longest / 3


def follow_settings(
    given: FollowFile, gait: GaitSettings | LearningSettings, planner: PlannerSettings
) -> FollowSettings:
    """Return what a file says of its follower."""

    def or_default(value: float | None, default: float) -> float:
        return default if value is None else value

    camera = given.camera
    return FollowSettings(
        gait, planner, given.follower, given.delay_s,
        (camera.rate_hz, camera.position_noise_m, camera.heading_noise_rad),
        or_default(given.gain_per_rad, GAIN_PER_RAD), or_default(given.node_m, NODE_M),
        or_default(given.near_m, NEAR_M), or_default(given.lookahead_m, LOOKAHEAD_M), given.settle_m,
        given.replan_beyond_m, given.replans,
    )  # fmt: skip
