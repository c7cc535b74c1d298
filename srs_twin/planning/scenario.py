"""Planner of a scenario: from start, goal and world to a plan, made once for all who ask."""

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
from srs_twin.io.files import find
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import Checker
from srs_twin.planning.follower import Conditions, Follower
from srs_twin.planning.footprint import Footprint, FootprintFile, checked, load_footprint_file
from srs_twin.planning.margins import SPREADS, ConditionsFile, Margin, margin
from srs_twin.planning.plan import Plan
from srs_twin.planning.planner import plan, plan_shaped
from srs_twin.planning.problem import Outcome, Problem, Segment, Settings, path_of
from srs_twin.planning.steering import BearingLaw, PathLaw, Steering
from srs_twin.robot.file import RobotFile
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.scenario.controllers import (
    Contradiction,
    ControllerContext,
    ControllerSection,
    FileSections,
    GaitFile,
    LearningFile,
)
from srs_twin.scenario.fields import PathOrName, Section, constructor_default, quantity
from srs_twin.scenario.sections import ExtensionSection, Loading, SectionEntry

_KIND = "How the way is found."

Turn = Annotated[float, Field(ge=-math.pi, le=math.pi)]


class PrimitivesFile(Section):
    """Arcs of one length to plan with (Section 5.2.1)."""

    constructors = (Primitives,)

    count: int = quantity(3, 201)
    """N, how many; odd."""
    turn_rad: float = quantity(0.001, 3.14)
    """Largest turn of one."""
    length_m: float = quantity(0.001, 100.0)
    """Length of each."""


class _PlannerFile(ExtensionSection):
    if TYPE_CHECKING:
        kind: str
    uses_goal = True

    footprint: PathOrName
    """What the body sweeps at each offset: a shipped name or the path of a footprint file."""
    turn_share: float = quantity(0.05, 1.0, 1.0)
    """Share of the tightest turns to plan with; the rest is left to the follower."""
    margin_m: float | None = quantity(0.0, 10.0, None)
    """Added to both edges of the footprint (default 0)."""
    margin_probability: float | None = quantity(0.5, 0.999, None)
    """Take the margin that a whole run stays within so probably, by the excursions that the footprint file
    keeps; instead of margin_m."""

    @model_validator(mode="after")
    def _has_one_margin(self) -> _PlannerFile:
        if self.margin_m is not None and self.margin_probability is not None:
            raise ValueError("margin_m and margin_probability both say how wide; take one out")
        return self

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ExtensionSection.contradictions_with`."""
        if not isinstance(file.controller, FollowFile):
            yield ("planner",), "nobody follows its plan; set controller.kind: follow", True
        if file.bench:
            yield ("planner",), "nothing goes anywhere on a bench; take one out", True
        if self.kind != "given" and file.world.goal is None:
            yield ("planner",), f"kind: {self.kind} needs world.goal", True

    def prepare(self, loading: Loading) -> RoutePlanner | None:
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
            return RoutePlanner.of(self, footprint, file.start.build(), loading.world, conditions)
        except InputError as error:
            document.report(key, str(error) if len(key) == 1 else str(error).splitlines()[0])
            return None

    def check_run(self, product: RoutePlanner) -> None:
        """See `ExtensionSection.check_run`: plan."""
        product.plan()

    def goal(self, start: Pose, goal: Goal | None, footprint: Footprint) -> Goal:
        """Return where the way is to end.

        Raises:
            InputError: there is no goal.
        """
        if goal is None:
            raise InputError("there is no goal to plan to; give world.goal")
        return goal

    @abstractmethod
    def find(self, problem: Problem, wider: float = 0.0) -> Plan:
        """Return the plan of a problem.

        Args:
            problem: from where to where.
            wider: what a straight beginning has to be free of beside the footprint, m.

        Raises:
            InputError: start or goal cannot be, or the extra `ompl` is missing.
        """


class _SearchFile(_PlannerFile):
    constructors = (Settings,)

    run_up_m: float = quantity(0.0, 100.0, 0.0)
    """Straight beginning of the path, over which the gait gets going."""
    _keep: bool = PrivateAttr(False)

    def settings(self) -> Settings:
        """Return how hard to try, and whether to keep the search."""
        return replace(self.build(), keep=self._keep)

    def find(self, problem: Problem, wider: float = 0.0) -> Plan:
        """See `_PlannerFile.find`."""
        if self.run_up_m == 0:
            return self.search(problem, ())
        (first,) = path_of(problem.start, [(0.0, self.run_up_m)], problem.footprint)
        if hit := Checker(problem.world, problem.footprint).blocker(problem.start, self.run_up_m, wider):
            raise InputError(f"the straight beginning of {self.run_up_m:g} m touches {hit}; run_up_m sets it")
        return self.search(replace(problem, start=first.end), (first,))

    def search(self, problem: Problem, begin: tuple[Segment, ...]) -> Plan:
        """Return the plan behind a fixed beginning."""
        found = plan(problem, self.settings(), planner=self.kind)
        return replace(found, segments=(*begin, *found.segments)) if found.found else found


class BestFirstFile(_SearchFile):
    """Best-first search, from both sides where that helps."""

    primitives: PrimitivesFile | None = None
    """Arcs to plan with (default: the planner's own)."""
    kind: Literal["best_first"]
    """How the way is found."""
    nodes: int = quantity(1, 100_000_000)
    """How many may be expanded."""
    seconds: float | None = quantity(0.001, 3600.0, unit="s")
    """Wall time; only without it is a run the same on every machine (default: no limit)."""
    weight: float = quantity(1.0, 100.0)
    """Of the bound; above 1 faster and longer."""
    levels: int = quantity(1, 5)
    """Resolutions to try."""
    clearance_weight: float = quantity(0.0, 100.0)
    """How many metres of way a metre beside something is worth; above 0 paths keep away from things."""
    smooth: bool = constructor_default()
    """Shorten the path afterwards."""
    shape_changes: bool = False
    """Plan the way that changes of offset take, as the footprint has it measured, not jumps of curvature."""
    improve: bool = constructor_default()
    """Go on to finer levels for shorter paths while the budget lasts."""

    def search(self, problem: Problem, begin: tuple[Segment, ...]) -> Plan:
        """See `_SearchFile.search`."""
        if self.shape_changes:
            return plan_shaped(problem, self.settings(), begin)
        return super().search(problem, begin)


class GreedyFile(_SearchFile):
    """The text's search: the best child of either side in turn, for good."""

    kind: Literal["greedy"]
    """How the way is found."""
    primitives: PrimitivesFile = PrimitivesFile(count=21, turn_rad=math.pi / 3, length_m=0.2)
    """Arcs to plan with (default: Section 5.2's: 21, turns of 60 degrees at most, 0.2 m)."""


class OmplFile(_SearchFile):
    """RRT-Connect of the Open Motion Planning Library (extra ompl)."""

    kind: Literal["ompl"]
    """How the way is found."""
    seconds: float = quantity(0.001, 3600.0, 1.0, unit="s")
    """Wall time."""


class GivenFile(_PlannerFile):
    """A path that is given, as in Fig. 56; obstacles are not looked at."""

    kind: Literal["given"]
    """How the way is found."""
    turns_rad: Annotated[tuple[Turn, ...], Field(min_length=1, max_length=1000)]
    """Turn of each step, positive to the left, rad, -3.14159 to 3.14159."""
    step_m: float = quantity(0.001, 100.0)
    """Length of each step."""

    def goal(self, start: Pose, goal: Goal | None, footprint: Footprint) -> Goal:
        """Return the end of the path."""
        end = self._path(start, footprint)[-1].end
        return Goal(end.x, end.y, end.heading, goal.radius if goal else 0.05)

    def find(self, problem: Problem, wider: float = 0.0) -> Plan:
        """See `_PlannerFile.find`."""
        return Plan(Outcome.FOUND, "the path is given", self._path(problem.start, problem.footprint))

    def _path(self, start: Pose, footprint: Footprint) -> tuple[Segment, ...]:
        return path_of(start, [(turn / self.step_m, self.step_m) for turn in self.turns_rad], footprint)


PlannerFile = Annotated[BestFirstFile | GreedyFile | OmplFile | GivenFile, Field(discriminator="kind")]
PLANNER_FILES: dict[str, type[_PlannerFile]] = {
    get_args(each.model_fields["kind"].annotation)[0]: each
    for each in (BestFirstFile, GreedyFile, OmplFile, GivenFile)
}
"""Kind → keys that a planner of this kind has."""


@dataclass(frozen=True)
class RoutePlanner:
    """What plans the way of a scenario.

    Attributes:
        file: how.
        footprint: the robot's, whole: what it can do.
        problem: start, goal, world, and the footprint to plan with.
        margin: by which that is wider than the robot's.
    """

    file: _PlannerFile
    footprint: Footprint
    problem: Problem
    margin: Margin

    @classmethod
    def of(
        cls,
        file: _PlannerFile,
        footprint: FootprintFile,
        start: Pose,
        world: World,
        conditions: Sequence[ConditionsFile] = (),
    ) -> RoutePlanner:
        """Return the planner of a section.

        Args:
            file: the section.
            footprint: that it names.
            start: of the snake.
            world: what is in the way, and the goal.
            conditions: under which the plan is followed, one for each plant.

        Raises:
            InputError: a turn tighter than the footprint has, edges that are too wide, no goal, no margin of
                that probability.
        """
        robot, wider = footprint.footprint(), Margin(file.margin_m or 0.0, file.margin_m or 0.0)
        if file.margin_probability is not None:
            wider = margin(footprint.excursions or (), file.margin_probability, conditions)
        reduced = checked(robot.reduced(file.turn_share, wider.path))
        arcs = getattr(file, "primitives", None)
        goal = file.goal(start, world.goal, reduced)
        problem = Problem(start, goal, world, reduced, arcs.build() if arcs else None)
        return cls(file, robot, problem, wider)

    def plan(self) -> Plan:
        """Return the plan, made once: both plants and the report ask for the same.

        Raises:
            InputError: start or goal cannot be, or the extra `ompl` is missing.
        """
        return _plan(self)

    def plan_anew(self, *, keep: bool = False) -> Plan:
        """Return the plan, made now, if wanted with its search; raises as `plan`."""
        file = self.file.model_copy()
        if isinstance(file, _SearchFile):
            file._keep = keep
        return file.find(self.problem, max(self.margin.run_up - self.margin.path, 0.0))

    def plan_from(self, pose: Pose, share: float = 1.0) -> Plan:
        """Return a plan from another pose, with a part of the margin and no run-up; raises as `plan`."""
        file = self.file.model_copy(update={"run_up_m": 0.0})
        body = checked(self.footprint.reduced(file.turn_share, share * self.margin.path))
        return _plan(replace(self, file=file, problem=replace(self.problem, start=pose, footprint=body)))


@lru_cache(maxsize=16)
def _plan(planner: RoutePlanner) -> Plan:
    return planner.plan_anew()


class CameraFile(Section):
    """Motion capture: how a follower sees the snake."""

    constructors = (Camera,)

    rate_hz: float = quantity(5.0, 10_000.0)
    """Frames a second."""
    position_noise_m: float = quantity(0.0, 1.0)
    """RMS noise of x and y."""
    heading_noise_rad: float = quantity(0.0, 3.0)
    """RMS noise of the heading."""


class FollowFile(ControllerSection):
    """Following of a plan by the offset of a gait (Section 5.2.2); the scenario needs a planner."""

    constructors = (PathLaw, BearingLaw, Conditions)
    only = {
        ("follower", "bearing"): ("gain_per_rad", "node_m", "near_m"),
        ("follower", "path"): ("lookahead_m", "settle_m"),
    }

    kind: Literal["follow"]
    """Which controller."""
    follower: Literal["bearing", "path"] = "path"
    """bearing: the text's, towards one node after the other; path: feedback of the distance from the path
    with its curvature ahead."""
    gait: Annotated[GaitFile | LearningFile, Field(discriminator="kind")]
    """What is steered."""
    delay_s: float = quantity(0.0, 10.0, 0.1)
    """How long a command takes to the snake."""
    camera: CameraFile = CameraFile()
    """How it sees the snake."""
    gain_per_rad: float | None = quantity(0.001, 100.0, None)
    """Offset for an error of bearing (bearing; default {default:g})."""
    node_m: float | None = quantity(0.001, 100.0, None)
    """Distance of the nodes (bearing; default {default:g})."""
    near_m: float | None = quantity(0.001, 100.0, None)
    """How near to a node is near enough (bearing; default {default:g})."""
    lookahead_m: float | None = quantity(0.001, 100.0, None)
    """Path over which a distance from it dies out (path; default {default:g})."""
    settle_m: float | None = quantity(0.0, 100.0, None)
    """Path over which a new offset takes hold (path; default: by which the footprint's
    changes of offset turn it later, {default:g} without any)."""
    replan_beyond_m: float | None = quantity(0.001, 100.0, None)
    """Distance from the path that calls for a new plan (default: none is made)."""
    replans: int = quantity(0, 1000)
    """How often a new plan is asked for at most."""

    @model_validator(mode="after")
    def _leaves_the_offset_alone(self) -> FollowFile:
        if self.gait.offset != 0:
            raise ValueError("the follower decides the offset; take gait.offset out")
        return self

    @property
    def gait_section(self) -> ControllerSection:
        """See `ControllerSection.gait_section`."""
        return self.gait

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ControllerSection.contradictions_with`."""
        if file.section("planner") is None:
            yield ("controller",), "kind: follow has nothing to follow; give planner as well", False
        if file.start.run is not None:
            yield ("start", "from"), "a plan begins at one pose; give it by x_m, y_m and heading_rad", True

    def controller(self, context: ControllerContext) -> Controller:
        """See `ControllerSection.controller`; the first time this plans.

        Raises:
            InputError: start or goal cannot be, or the extra `ompl` is missing.
        """
        planner: RoutePlanner = context.products["planner"]
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
        )

    def conditions(
        self, plant: str, contact: str | None, chambers: str, robot: RobotFile, planner: _PlannerFile
    ) -> ConditionsFile:
        """Return what makes following hard, as margins with a probability are measured.

        Args:
            plant: "analytical" or "twin".
            contact: that of the twin; None for the analytical model.
            chambers: kind of pneumatics.
            robot: whose modules may differ.
            planner: section of the scenario.
        """
        spreads = {name: getattr(robot.modules, name, None) for name in SPREADS}
        return ConditionsFile.model_validate(
            {
                **{name: each.value for name, each in spreads.items() if each is not None},
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
        """Return ℓ."""
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


def _input_files(section: Mapping[str, Any]) -> Iterator[str]:
    if isinstance(name := section.get("footprint"), str):
        try:
            yield str(find("footprint", name))
        except InputError:
            yield name


PLANNER = SectionEntry(
    PlannerFile | None,
    "How the way to the goal is found (controller.kind: follow).",
    _input_files,
)
