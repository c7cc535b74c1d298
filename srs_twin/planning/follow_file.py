"""Scenario section for the controller `follow` (dissertation, Section 5.2.2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import Field, model_validator

from srs_twin.control.base import Controller
from srs_twin.planning.camera import Camera
from srs_twin.planning.follower import Conditions, Follower
from srs_twin.planning.footprint_file import SPREADS, ConditionsFile
from srs_twin.planning.scenario import PlannerSection, ScenarioPlanner
from srs_twin.planning.steering import PathTracking, Steering, WaypointSteering
from srs_twin.robot.file import RobotFile
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.controllers import (
    ControllerContext,
    ControllerSection,
    GaitFile,
    LearningFile,
)
from srs_twin.scenario.fields import Contradiction, FileSections, Section, quantity


class CameraFile(Section):
    """Motion capture system that the follower uses."""

    constructors = (Camera,)

    rate_hz: float = quantity(5.0, 10_000.0)
    """Frame rate."""
    position_noise_m: float = quantity(0.0, 1.0)
    """RMS noise of the x and y coordinates."""
    heading_noise_rad: float = quantity(0.0, 3.0)
    """RMS noise of the heading."""


class FollowFile(ControllerSection):
    """Controller that follows a plan by changing the gait offset (Section 5.2.2)."""

    constructors = (PathTracking, WaypointSteering, Conditions)
    only = {
        ("follower", "bearing"): ("gain_per_rad", "node_m", "near_m"),
        ("follower", "path"): ("lookahead_m", "response_length_m"),
    }

    kind: Literal["follow"]
    """Kind of controller."""
    follower: Literal["bearing", "path"] = "path"
    """Steering law. With `bearing`, the snake steers from node to node as in the
    dissertation. `path` combines feedback of the cross-track error with curvature
    feedforward.
    """
    gait: Annotated[GaitFile | LearningFile, Field(discriminator="kind")]
    """Gait whose offset steers the snake."""
    delay_s: float = quantity(0.0, 10.0, 0.1)
    """Command delay between the follower and the gait."""
    camera: CameraFile = CameraFile()
    """Motion capture system that measures the pose of the snake."""
    gain_per_rad: float | None = quantity(0.001, 100.0, None)
    """Commanded offset per bearing error (`bearing`, default {default:g})."""
    node_m: float | None = quantity(0.001, 100.0, None)
    """Distance between nodes along the path (`bearing`, default {default:g})."""
    near_m: float | None = quantity(0.001, 100.0, None)
    """Distance at which a node counts as reached (`bearing`, default {default:g})."""
    lookahead_m: float | None = quantity(0.001, 100.0, None)
    """Path length over which a cross-track error decays (`path`, default {default:g}).
    """
    response_length_m: float | None = quantity(0.0, 100.0, None)
    """Path length over which the curvature responds to a change of offset (`path`,
    default {default:g}, or computed from the footprint if it has transients)."""
    replan_beyond_m: float | None = quantity(0.001, 100.0, None)
    """Cross-track error at which a new plan is requested (default: deviations cause no
    new plan)."""
    max_replans: int = quantity(0, 1000)
    """Maximum number of new plans."""

    @model_validator(mode="after")
    def _leaves_the_offset_alone(self) -> FollowFile:
        if self.gait.offset != 0:
            raise ValueError(
                "the follower itself sets the offset; remove `gait.offset`"
            )
        return self

    @property
    def gait_section(self) -> ControllerSection:
        """See `ControllerSection.gait_section`."""
        return self.gait

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ControllerSection.contradictions_with`."""
        if file.section("planner") is None:
            yield Contradiction(
                ("controller",),
                "`kind: follow` needs a plan; add the section `planner`",
            )
        if file.start.run is not None:
            yield Contradiction(
                ("start", "from"),
                "a plan begins at a single pose; set `x_m`, `y_m` and `heading_rad`"
                " instead",
                at_key=True,
            )

    def controller(self, context: ControllerContext) -> Controller:
        """See `ControllerSection.controller`. The first call computes the plan."""
        planner: ScenarioPlanner = context.products["planner"]
        body = planner.footprint
        problem = planner.problem
        response_length = self.response_length_m
        if response_length is None:
            response_length = (
                body.response_length or self.parameters["response_length"].default
            )
        steering: Steering = PathTracking(
            body, **self.arguments(PathTracking) | {"response_length": response_length}
        )
        if self.follower == "bearing":
            steering = WaypointSteering(**self.arguments(WaypointSteering))
        return Follower(
            self.gait.controller(context),
            steering,
            planner.plan(),
            problem.goal,
            body,
            Conditions(
                self.camera.build(),
                self.delay_s,
                response_length,
                self.replan_beyond_m,
                self.max_replans,
                planner.file.lead_in,
            ),
            body=problem.footprint,
            world=problem.world,
            replan=None if planner.file.kind == "given" else planner.plan_from,
            allows_contact=planner.touch_limits is not None,
        )

    def conditions(
        self,
        plant: str,
        contact: str | None,
        chambers: str,
        robot: RobotFile,
        planner: PlannerSection,
    ) -> ConditionsFile:
        """Return the conditions of a run, which determine its margin."""
        spreads = {name: getattr(robot.modules, name, None) for name in SPREADS}
        return ConditionsFile.model_validate(
            {
                **{
                    name: spread.value
                    for name, spread in spreads.items()
                    if spread is not None
                },
                "plant": plant,
                "contact": contact,
                "chambers": chambers,
                "follower": self.follower,
                "turn_fraction": planner.turn_fraction,
                "delay_s": self.delay_s,
                "position_noise_m": self.camera.position_noise_m,
                "heading_noise_rad": self.camera.heading_noise_rad,
                "lead_in_m": planner.lead_in,
            }
        )

    def layouts(self, products: Mapping[str, object]) -> tuple[str, ...]:
        """See `ControllerSection.layouts`."""
        return self.gait.layouts(products)

    def check(self, spec: RobotSpec, tick: float) -> None:
        """See `ControllerSection.check`."""
        self.gait.check(spec, tick)

    def warnings(self, limit: float) -> Iterator[str]:
        """See `ControllerSection.warnings`."""
        return self.gait.warnings(limit)
