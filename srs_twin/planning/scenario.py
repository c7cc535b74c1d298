"""Sections `planner` and `controller: follow` of a scenario, and the cached plan of a scenario."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import Field, PrivateAttr, model_validator

from srs_twin.control.base import Controller
from srs_twin.control.camera import Camera
from srs_twin.errors import InputError
from srs_twin.io.files import find_file
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import Checker
from srs_twin.planning.follower import Conditions, Follower
from srs_twin.planning.footprint import Footprint, FootprintFile, load_footprint_file, validate_footprint
from srs_twin.planning.margins import SPREADS, ConditionsFile, Margin, margin_for
from srs_twin.planning.path import Segment, path_from_arcs
from srs_twin.planning.planner import plan, plan_with_transitions
from srs_twin.planning.problem import Outcome, Plan, Problem, Settings, TouchLimits
from srs_twin.planning.steering import BearingLaw, PathLaw, Steering
from srs_twin.planning.touch import touch_limits
from srs_twin.robot.file import RobotFile
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.scenario.controllers import ControllerContext, ControllerSection, GaitFile, LearningFile
from srs_twin.scenario.fields import (
    Contradiction,
    ExtensionSection,
    FileSections,
    Loading,
    PathOrName,
    Section,
    SectionEntry,
    constructor_default,
    quantity,
)

Turn = Annotated[float, Field(ge=-math.pi, le=math.pi)]


class PrimitivesFile(Section):
    """Motion primitives of equal length (Section 5.2.1)."""

    constructors = (Primitives,)

    count: int = quantity(3, 201)
    """Number N of arcs, odd."""
    turn_rad: float = quantity(0.001, 3.14)
    """Largest turn of an arc."""
    length_m: float = quantity(0.001, 100.0)
    """Length of each arc."""


class _PlannerFile(ExtensionSection):
    """Base class of the planner sections."""

    if TYPE_CHECKING:
        kind: str
    uses_goal = True

    footprint: PathOrName
    """Footprint of the body: a shipped name or the path of a footprint file."""
    turn_share: float = quantity(0.05, 1.0, 1.0)
    """Fraction of the tightest curvature that plans use; the follower needs the rest for corrections."""
    margin_m: float | None = quantity(0.0, 10.0, None)
    """Margin added to both edges of the footprint (default 0)."""
    margin_probability: float | None = quantity(0.5, 0.999, None)
    """Probability that a whole run stays within the margin, by the excursions in the footprint file;
    instead of margin_m."""
    touch: Literal["allowed"] | None = None
    """allowed: the path may lean on obstacles where the body can pass (best_first; default: keep clear)."""

    @model_validator(mode="after")
    def _keys_agree(self) -> _PlannerFile:
        if self.margin_m is not None and self.margin_probability is not None:
            raise ValueError("margin_m and margin_probability both set the margin; remove one")
        if self.touch and self.kind != "best_first":
            raise ValueError(f"kind: {self.kind} cannot lean on obstacles; remove touch, or use best_first")
        return self

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ExtensionSection.contradictions_with`."""
        if not isinstance(file.controller, FollowFile):
            yield ("planner",), "no controller follows its plan; set controller.kind: follow", True
        if file.bench:
            yield ("planner",), "there is no motion to plan on a bench; remove planner or bench", True
        if self.kind != "given" and file.world.goal is None:
            yield ("planner",), f"kind: {self.kind} needs world.goal", True
        analytical = file.plants.analytical
        if self.touch and analytical and not analytical.touch:
            text = "touch: allowed needs plants that touch obstacles; set model: compliant and touch: true"
            yield ("plants", "analytical"), f"{text}, or remove analytical", True

    def prepare(self, loading: Loading) -> ScenarioPlanner | None:
        """See `ExtensionSection.prepare`."""
        document, file = loading.document, loading.file
        if not isinstance(file.controller, FollowFile) or document.problems:
            return None
        key: tuple[str, ...] = ("planner", "footprint")
        try:
            footprint = load_footprint_file(self.footprint)
            key = ("planner",)
            conditions = [
                file.controller.conditions(
                    kind, getattr(plant, "contact", None), file.pneumatics.kind, loading.robot, self
                )
                for kind, plant in file.plants.running.items()
            ]
            if file.plants.twin and (text := footprint.mismatch(file.plants.twin.contact)):
                loading.warnings.append(f"planner.footprint: {text}")
            return ScenarioPlanner.from_section(
                self, footprint, file.start.build(), loading.world, conditions, loading.robot.spec()
            )
        except InputError as error:
            document.report(key, str(error) if len(key) == 1 else str(error).splitlines()[0])
            return None

    def check_run(self, product: ScenarioPlanner) -> None:
        """See `ExtensionSection.check_run`: plan."""
        product.plan()

    def goal(self, start: Pose, goal: Goal | None, footprint: Footprint) -> Goal:
        """Return the goal of the plan.

        Raises:
            InputError: the scenario has no goal.
        """
        if goal is None:
            raise InputError("the scenario has no goal; set world.goal")
        return goal

    @abstractmethod
    def find(self, problem: Problem, wider: float = 0.0) -> Plan:
        """Return the plan of a problem.

        Args:
            problem: the problem.
            wider: additional width of the footprint on the straight run-up, m.

        Raises:
            InputError: start or goal is not possible, or the extra `ompl` is missing.
        """


class _SearchFile(_PlannerFile):
    """Base class of the planners that search, with an optional straight run-up."""

    constructors = (Settings,)

    run_up_m: float = quantity(0.0, 100.0, 0.0)
    """Length of a straight run-up at the start of the path, over which the gait becomes steady."""
    _keep: bool = PrivateAttr(False)
    _touch_limits: TouchLimits | None = PrivateAttr(None)

    def settings(self) -> Settings:
        """Return the settings of the search."""
        return replace(self.build(), keep=self._keep, touch_limits=self._touch_limits)

    def find(self, problem: Problem, wider: float = 0.0) -> Plan:
        """See `_PlannerFile.find`."""
        if self.run_up_m == 0:
            return self.search(problem, ())
        (first,) = path_from_arcs(problem.start, [(0.0, self.run_up_m)], problem.footprint)
        if hit := Checker(problem.world, problem.footprint).first_collision(
            problem.start, self.run_up_m, wider
        ):
            raise InputError(
                f"the straight run-up of {self.run_up_m:g} m touches {hit}; set a shorter run_up_m"
            )
        # The run-up is fixed, so the search starts at its end.
        return self.search(replace(problem, start=first.end), (first,))

    def search(self, problem: Problem, begin: tuple[Segment, ...]) -> Plan:
        """Return the plan of a problem, with fixed first segments `begin`."""
        result = plan(problem, self.settings(), planner=self.kind)
        if not result.found:
            return result
        done = math.fsum(segment.length for segment in begin)
        touches = result.touches and tuple(
            replace(touch, begin=touch.begin + done, end=touch.end + done) for touch in result.touches
        )
        return replace(result, segments=(*begin, *result.segments), touches=touches)


class BestFirstFile(_SearchFile):
    """Best-first search from start and goal."""

    primitives: PrimitivesFile | None = None
    """Motion primitives (default: chosen by the planner)."""
    kind: Literal["best_first"]
    """Planner."""
    nodes: int = quantity(1, 100_000_000)
    """Largest number of expanded nodes."""
    seconds: float | None = quantity(0.001, 3600.0, unit="s")
    """Limit on the wall time; with a limit, the result may differ between machines (default: none)."""
    weight: float = quantity(1.0, 100.0)
    """Weight of the cost-to-go; values above 1 make the search faster and the path longer."""
    levels: int = quantity(1, 5)
    """Number of resolutions to try."""
    clearance_weight: float = quantity(0.0, 100.0)
    """Extra cost of a metre of path that touches an obstacle, in metres; above 0 paths avoid obstacles."""
    smooth: bool = constructor_default()
    """Shorten the path afterwards."""
    shape_changes: bool = False
    """Plan with transition arcs, the measured response to changes of offset, instead of curvature jumps."""
    improve: bool = constructor_default()
    """Continue at finer resolutions for a shorter path while the budget lasts."""

    @model_validator(mode="after")
    def _leans_alone(self) -> BestFirstFile:
        for name in ("clearance_weight", "shape_changes"):
            if self.touch and getattr(self, name):
                raise ValueError(f"touch: allowed and {name} exclude each other; remove one")
        return self

    def search(self, problem: Problem, begin: tuple[Segment, ...]) -> Plan:
        """See `_SearchFile.search`."""
        if self.shape_changes:
            return plan_with_transitions(problem, self.settings(), begin)
        return super().search(problem, begin)


class GreedyFile(_SearchFile):
    """Search of the dissertation: the best arc of each side in turn, without backtracking."""

    kind: Literal["greedy"]
    """Planner."""
    primitives: PrimitivesFile = PrimitivesFile(count=21, turn_rad=math.pi / 3, length_m=0.2)
    """Motion primitives (default: those of Section 5.2: 21 arcs of 0.2 m with turns up to 60 degrees)."""


class OmplFile(_SearchFile):
    """RRT-Connect of the Open Motion Planning Library (extra ompl)."""

    kind: Literal["ompl"]
    """Planner."""
    seconds: float = quantity(0.001, 3600.0, 1.0, unit="s")
    """Limit on the wall time."""


class GivenFile(_PlannerFile):
    """Given path, as in Fig. 56; obstacles are ignored."""

    kind: Literal["given"]
    """Planner."""
    turns_rad: Annotated[tuple[Turn, ...], Field(min_length=1, max_length=1000)]
    """Turn of each step, positive to the left, rad, -3.14159 to 3.14159."""
    step_m: float = quantity(0.001, 100.0)
    """Length of each step."""

    def goal(self, start: Pose, goal: Goal | None, footprint: Footprint) -> Goal:
        """Return the end of the path."""
        # The path is given, so its end replaces the scenario's goal.
        end = self._path(start, footprint)[-1].end
        return Goal(end.x, end.y, end.heading, goal.radius if goal else 0.05)

    def find(self, problem: Problem, wider: float = 0.0) -> Plan:
        """See `_PlannerFile.find`."""
        return Plan(Outcome.FOUND, "the path is given", self._path(problem.start, problem.footprint))

    def _path(self, start: Pose, footprint: Footprint) -> tuple[Segment, ...]:
        return path_from_arcs(
            start, [(turn / self.step_m, self.step_m) for turn in self.turns_rad], footprint
        )


PlannerFile = Annotated[BestFirstFile | GreedyFile | OmplFile | GivenFile, Field(discriminator="kind")]
PLANNER_FILES: dict[str, type[_PlannerFile]] = {
    get_args(section.model_fields["kind"].annotation)[0]: section
    for section in (BestFirstFile, GreedyFile, OmplFile, GivenFile)
}
"""Section of each kind of planner."""


@dataclass(frozen=True)
class ScenarioPlanner:
    """Planner of a scenario.

    Attributes:
        file: section of the scenario.
        footprint: footprint of the robot with all its turns and without margin.
        problem: start, goal, world, and the reduced footprint with margin.
        margin: margin of the problem's footprint.
    """

    file: _PlannerFile
    footprint: Footprint
    problem: Problem
    margin: Margin

    @classmethod
    def from_section(
        cls,
        file: _PlannerFile,
        footprint: FootprintFile,
        start: Pose,
        world: World,
        conditions: Sequence[ConditionsFile] = (),
        spec: RobotSpec | None = None,
    ) -> ScenarioPlanner:
        """Return the planner of a section.

        Args:
            file: section of the scenario.
            footprint: footprint file of the section.
            start: pose of the snake at the start.
            world: obstacles, bounds and goal.
            conditions: conditions of following, one per plant.
            spec: robot; required if the path may lean on obstacles.

        Raises:
            InputError: a turn is tighter than the footprint allows, the edges are too wide, there is no goal,
                or no margin of the given probability.
        """
        robot, wider = footprint.footprint(), Margin(file.margin_m or 0.0, file.margin_m or 0.0)
        if file.margin_probability is not None:
            wider = margin_for(footprint.excursions or (), file.margin_probability, conditions)
        reduced = validate_footprint(robot.reduced(file.turn_share, wider.path))
        arcs = getattr(file, "primitives", None)
        goal = file.goal(start, world.goal, reduced)
        if file.touch:
            assert isinstance(file, BestFirstFile) and spec is not None, "only it has the key"
            file = file.model_copy()
            file._touch_limits = touch_limits(spec, robot)
        problem = Problem(start, goal, world, reduced, arcs.build() if arcs else None)
        return cls(file, robot, problem, wider)

    def plan(self) -> Plan:
        """Return the plan, computed once for both plants and the report.

        Raises:
            InputError: start or goal is not possible, or the extra `ompl` is missing.
        """
        return _plan(self)

    def plan_uncached(self, *, keep: bool = False) -> Plan:
        """Compute the plan without the cache, optionally with its search trees; raises as `plan`."""
        file = self.file.model_copy()
        if isinstance(file, _SearchFile):
            file._keep = keep
        return file.find(self.problem, max(self.margin.run_up - self.margin.path, 0.0))

    def plan_from(self, pose: Pose, share: float = 1.0) -> Plan:
        """Return a plan from another pose, with a fraction of the margin and no run-up; raises as `plan`."""
        # The gait is already steady, so a new plan needs no run-up.
        file = self.file.model_copy(update={"run_up_m": 0.0})
        body = validate_footprint(self.footprint.reduced(file.turn_share, share * self.margin.path))
        return _plan(replace(self, file=file, problem=replace(self.problem, start=pose, footprint=body)))


@lru_cache(maxsize=16)
def _plan(planner: ScenarioPlanner) -> Plan:
    return planner.plan_uncached()


class CameraFile(Section):
    """Motion capture of a follower."""

    constructors = (Camera,)

    rate_hz: float = quantity(5.0, 10_000.0)
    """Frames per second."""
    position_noise_m: float = quantity(0.0, 1.0)
    """RMS noise of x and y."""
    heading_noise_rad: float = quantity(0.0, 3.0)
    """RMS noise of the heading."""


class FollowFile(ControllerSection):
    """Follower of a plan by the offset of a gait (Section 5.2.2); requires a planner."""

    constructors = (PathLaw, BearingLaw, Conditions)
    only = {
        ("follower", "bearing"): ("gain_per_rad", "node_m", "near_m"),
        ("follower", "path"): ("lookahead_m", "settle_m"),
    }

    kind: Literal["follow"]
    """Controller."""
    follower: Literal["bearing", "path"] = "path"
    """Steering law; bearing: that of the dissertation, towards one node after the other; path: feedback of
    the cross-track error with curvature feedforward."""
    gait: Annotated[GaitFile | LearningFile, Field(discriminator="kind")]
    """Gait that is steered."""
    delay_s: float = quantity(0.0, 10.0, 0.1)
    """Command delay."""
    camera: CameraFile = CameraFile()
    """Motion capture."""
    gain_per_rad: float | None = quantity(0.001, 100.0, None)
    """Offset per bearing error (bearing; default {default:g})."""
    node_m: float | None = quantity(0.001, 100.0, None)
    """Distance between nodes (bearing; default {default:g})."""
    near_m: float | None = quantity(0.001, 100.0, None)
    """Distance at which a node counts as reached (bearing; default {default:g})."""
    lookahead_m: float | None = quantity(0.001, 100.0, None)
    """Path length over which a cross-track error decays (path; default {default:g})."""
    settle_m: float | None = quantity(0.0, 100.0, None)
    """Response length of the curvature to a change of offset (path; default: from the transients of the
    footprint, {default:g} without any)."""
    replan_beyond_m: float | None = quantity(0.001, 100.0, None)
    """Cross-track error at which a new plan is requested (default: no new plans)."""
    replans: int = quantity(0, 1000)
    """Largest number of new plans."""

    @model_validator(mode="after")
    def _leaves_the_offset_alone(self) -> FollowFile:
        if self.gait.offset != 0:
            raise ValueError("the follower sets the offset; remove gait.offset")
        return self

    @property
    def gait_section(self) -> ControllerSection:
        """See `ControllerSection.gait_section`."""
        return self.gait

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ControllerSection.contradictions_with`."""
        if file.section("planner") is None:
            yield ("controller",), "kind: follow needs a plan; add planner", False
        if file.start.run is not None:
            yield ("start", "from"), "a plan begins at one pose; set it by x_m, y_m and heading_rad", True

    def controller(self, context: ControllerContext) -> Controller:
        """See `ControllerSection.controller`; plans on the first call.

        Raises:
            InputError: start or goal is not possible, or the extra `ompl` is missing.
        """
        planner: ScenarioPlanner = context.products["planner"]
        body, settle, problem = planner.footprint, self._settle(planner.footprint), planner.problem
        law: Steering = PathLaw(body, **self.arguments(PathLaw) | {"settle": settle})
        if self.follower == "bearing":
            law = BearingLaw(**self.arguments(BearingLaw))
        return Follower(
            self.gait.controller(context),
            law,
            planner.plan(),
            problem.goal,
            body,
            Conditions(
                self.camera.build(),
                self.delay_s,
                settle,
                self.replan_beyond_m,
                self.replans,
                getattr(planner.file, "run_up_m", 0.0),
            ),
            body=problem.footprint,
            world=problem.world,
            replan=None if planner.file.kind == "given" else planner.plan_from,
            leans=planner.file.touch is not None,
        )

    def conditions(
        self, plant: str, contact: str | None, chambers: str, robot: RobotFile, planner: _PlannerFile
    ) -> ConditionsFile:
        """Return the conditions of following, for margins with a probability.

        Args:
            plant: "analytical" or "twin".
            contact: contact of the twin; None for the analytical model.
            chambers: kind of pneumatics.
            robot: robot file, with the spreads of its modules.
            planner: section of the scenario.
        """
        spreads = {name: getattr(robot.modules, name, None) for name in SPREADS}
        return ConditionsFile.model_validate(
            {
                **{name: spread.value for name, spread in spreads.items() if spread is not None},
                "plant": plant,
                "contact": contact,
                "chambers": chambers,
                "follower": self.follower,
                "turn_share": planner.turn_share,
                "delay_s": self.delay_s,
                "position_noise_m": self.camera.position_noise_m,
                "heading_noise_rad": self.camera.heading_noise_rad,
                "run_up_m": getattr(planner, "run_up_m", 0.0),
            }
        )

    def _settle(self, footprint: Footprint) -> float:
        """Return the response length ℓ, m."""
        if self.settle_m is not None:
            return self.settle_m
        return footprint.settle or self.parameters["settle"].default

    def layouts(self, products: Mapping[str, Any]) -> tuple[str, ...]:
        """See `ControllerSection.layouts`."""
        return self.gait.layouts(products)

    def check(self, spec: RobotSpec, tick: float) -> None:
        """See `ControllerSection.check`."""
        self.gait.check(spec, tick)

    def warnings(self, limit: float) -> Iterator[str]:
        """See `ControllerSection.warnings`."""
        return self.gait.warnings(limit)


def _input_files(section: Mapping[str, object]) -> Iterator[str]:
    """Yield the path of the footprint file; its name if it is not found."""
    if isinstance(name := section.get("footprint"), str):
        try:
            yield str(find_file("footprint", name))
        except InputError:
            yield name


PLANNER = SectionEntry(
    PlannerFile | None,
    "Planner of the path to the goal (controller.kind: follow).",
    _input_files,
)
