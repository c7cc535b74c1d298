"""Scenario section `planner`, and the planner that the section configures."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pydantic import Field, model_validator

from srs_twin.errors import InputError
from srs_twin.io.documents import parse_path
from srs_twin.io.files import find_file
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import Checker, obstacle_at
from srs_twin.planning.footprint import Footprint, validate_footprint
from srs_twin.planning.footprint_file import (
    ConditionsFile,
    FootprintFile,
    Margin,
    load_footprint_file,
    margin_for,
)
from srs_twin.planning.path import Segment, path_from_arcs
from srs_twin.planning.planner import plan, plan_with_transitions
from srs_twin.planning.problem import Plan, PlanOutcome, Problem, Settings, TouchLimits
from srs_twin.planning.touch import touch_limits
from srs_twin.robot.world import Goal, Pose
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
    """Number N of arcs, which must be odd."""
    turn_rad: float = quantity(0.001, 3.14)
    """Maximum turning angle of an arc."""
    length_m: float = quantity(0.001, 100.0)
    """Length of each arc."""


class PlannerSection(ExtensionSection):
    """Base class of the planner sections."""

    if TYPE_CHECKING:
        kind: str
    uses_goal = True

    footprint: PathOrName
    """Name of a shipped footprint, or path of a footprint file."""
    turn_fraction: float = quantity(0.05, 1.0, 1.0)
    """Fraction of the tightest curvature that plans may use."""
    margin_m: float | None = quantity(0.0, 10.0, None)
    """Margin added to both edges of the footprint (default 0)."""
    margin_probability: float | None = quantity(0.5, 0.999, None)
    """Probability that a whole run stays within the margin, which is then computed from
    the excursions in the footprint file.
    """

    @property
    def lead_in(self) -> float:
        """Length of the straight lead-in, m."""
        return 0.0

    @model_validator(mode="after")
    def _keys_agree(self) -> PlannerSection:
        if self.margin_m is not None and self.margin_probability is not None:
            raise ValueError(
                "`margin_m` and `margin_probability` both set the margin; remove one"
                " of them"
            )
        return self

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ExtensionSection.contradictions_with`."""
        if file.controller.kind != "follow":
            yield Contradiction(
                ("planner",),
                "no controller follows the plan; set `controller.kind: follow`",
                at_key=True,
            )
        if file.bench:
            yield Contradiction(
                ("planner",),
                "a robot on a bench does not move along a path; remove `planner` or"
                " `bench`",
                at_key=True,
            )

    def prepare(self, loading: Loading) -> ScenarioPlanner | None:
        """See `ExtensionSection.prepare`."""
        document = loading.document
        file = loading.file
        if file.controller.kind != "follow" or document.problems:
            return None
        try:
            footprint = load_footprint_file(self.footprint)
        except InputError as error:
            document.report(("planner", "footprint"), str(error).splitlines()[0])
            return None
        contact = file.plants.twin.contact if file.plants.twin else None
        if text := footprint.mismatch(loading.robot.name, contact):
            loading.warnings.append(f"planner.footprint: {text}")
        try:
            return self._planner(footprint, loading)
        except InputError as error:
            document.report(("planner",), str(error))
            return None

    def _planner(self, footprint: FootprintFile, loading: Loading) -> ScenarioPlanner:
        robot = footprint.footprint()
        start = loading.file.start.build()
        world = loading.world
        margin = Margin(self.margin_m or 0.0, self.margin_m or 0.0)
        if self.margin_probability is not None:
            margin = margin_for(
                footprint.excursions or (),
                self.margin_probability,
                self._conditions(loading),
            )
        reduced = validate_footprint(robot.reduced(self.turn_fraction, margin.path))
        goal = self.goal(start, world.goal, reduced)
        problem = Problem(start, goal, world, reduced)
        return ScenarioPlanner(self, robot, problem, margin)

    def _conditions(self, loading: Loading) -> list[ConditionsFile]:
        follow = loading.file.controller
        chambers = loading.file.pneumatics.kind
        return [
            follow.conditions(
                kind, getattr(plant, "contact", None), chambers, loading.robot, self
            )
            for kind, plant in loading.file.plants.running.items()
        ]

    def check_run(self, product: ScenarioPlanner) -> None:
        """See `ExtensionSection.check_run`. This check computes the plan."""
        product.plan()

    def goal(self, start: Pose, goal: Goal | None, footprint: Footprint) -> Goal:
        """Return the goal of the plan."""
        if goal is None:
            raise InputError("the scenario has no goal; set `world.goal`")
        return goal

    @abstractmethod
    def find(
        self, problem: Problem, wider: float = 0.0, limits: TouchLimits | None = None
    ) -> Plan:
        """Return the plan of a problem.

        `wider` is an outward shift (m) of both footprint edges on the straight lead-in.
        """


class BestFirstFile(PlannerSection):
    """Best-first search from start and goal, with an optional straight lead-in."""

    constructors = (Settings,)

    contact: Literal["allowed"] | None = None
    """With `allowed`, the snake may lean on obstacles (default: keep clear)."""
    lead_in_m: float = quantity(0.0, 100.0, 0.0)
    """Length of the straight lead-in at the start of the path."""
    primitives: PrimitivesFile | None = None
    """Motion primitives (default: chosen by the planner)."""
    kind: Literal["best_first"]
    """Kind of planner."""
    nodes: int = quantity(1, 100_000_000)
    """Maximum number of expanded nodes."""
    seconds: float | None = quantity(0.001, 3600.0, unit="s")
    """Wall-time limit, with which results may differ between machines (default: none).
    """
    weight: float = quantity(1.0, 100.0)
    """Weight of the estimated remaining length, where a larger weight makes the search
    faster and the path longer."""
    levels: int = quantity(1, 5)
    """Maximum number of resolution levels."""
    clearance_weight: float = quantity(0.0, 100.0)
    """Extra cost of one metre of path without clearance from obstacles, in metres."""
    smooth: bool = constructor_default()
    """Whether to shorten the path after the search."""
    shape_changes: bool = False
    """Whether to plan transition arcs instead of curvature jumps. The transition arcs
    are computed from the measured responses to changes of offset.
    """
    improve: bool = constructor_default()
    """Whether to search for a shorter path at finer resolutions while the budget lasts.
    """

    @property
    def lead_in(self) -> float:
        """See `PlannerSection.lead_in`."""
        return self.lead_in_m

    @model_validator(mode="after")
    def _leans_alone(self) -> BestFirstFile:
        for name in ("clearance_weight", "shape_changes"):
            if self.contact and getattr(self, name):
                raise ValueError(
                    f"`contact: allowed` and `{name}` cannot be combined; remove one"
                    " of them"
                )
        return self

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ExtensionSection.contradictions_with`."""
        yield from super().contradictions_with(file)
        if file.world.goal is None:
            yield Contradiction(
                ("planner",),
                "the planner `best_first` needs a goal; set `world.goal`",
                at_key=True,
            )
        analytical = file.plants.analytical
        if self.contact and analytical and not analytical.contact:
            text = (
                "with `contact: allowed`, all plants must be able to touch obstacles;"
                " set `model: compliant` and `contact: true`, or remove `analytical`"
            )
            yield Contradiction(("plants", "analytical"), text, at_key=True)

    def read(self, loading: Loading) -> None:
        """Report a start or goal that is inside an obstacle or outside the bounds."""
        document = loading.document
        start = loading.file.start.build()
        goal = loading.world.goal
        if not goal:
            return
        for name, x, y in (("world.goal", goal.x, goal.y), ("start", start.x, start.y)):
            if hit := obstacle_at(loading.world, x, y):
                axes = [parse_path(f"{name}.{axis}_m") for axis in "xy"]
                # The positions of overrides are negative, so these come first.
                loc = min(axes, key=lambda axis: document.values.get(axis, (1e9, 0)))
                problem = f"({x:g}, {y:g}) is not free because of {hit}; move it"
                document.report(loc, problem)

    def _planner(self, footprint: FootprintFile, loading: Loading) -> ScenarioPlanner:
        planner = super()._planner(footprint, loading)
        if self.primitives:
            problem = planner.problem
            with loading.document.report_errors("planner", "primitives"):
                primitives = self.primitives.build()
                for curvature in primitives.curvatures:
                    problem.footprint.at(curvature)  # raises outside the table
                problem = replace(problem, primitives=primitives)
            planner = replace(planner, problem=problem)
        if self.contact:
            limits = touch_limits(loading.robot.spec(), planner.footprint)
            planner = replace(planner, touch_limits=limits)
        return planner

    def find(
        self, problem: Problem, wider: float = 0.0, limits: TouchLimits | None = None
    ) -> Plan:
        """See `PlannerSection.find`."""
        begin = path_from_arcs(
            problem.start, [(0.0, self.lead_in_m)], problem.footprint
        )
        if begin:
            checker = Checker(problem.world, problem.footprint)
            if hit := checker.first_collision(problem.start, self.lead_in_m, wider):
                raise InputError(
                    f"the straight lead-in of {self.lead_in_m:g} m touches {hit}; set"
                    " a shorter `lead_in_m`"
                )
            problem = replace(problem, start=begin[-1].end)
        settings = replace(self.build(), touch_limits=limits)
        if self.shape_changes:
            result = plan_with_transitions(problem, settings, begin)
        else:
            result = plan(problem, settings)
            if result.found:
                result = result.after(begin)
        return replace(result, lead_in=self.lead_in_m)


class GivenFile(PlannerSection):
    """Given path that is followed without regard to obstacles, as in Fig. 56."""

    kind: Literal["given"]
    """Kind of planner."""
    turns_rad: Annotated[tuple[Turn, ...], Field(min_length=1, max_length=1000)]
    """Turning angle of each step, positive to the left, rad, -3.14159 to 3.14159."""
    step_m: float = quantity(0.001, 100.0)
    """Length of each step."""

    def goal(self, start: Pose, goal: Goal | None, footprint: Footprint) -> Goal:
        """Return the end of the path, with the radius of the scenario's goal."""
        end = self._path(start, footprint)[-1].end
        return Goal(end.x, end.y, end.heading, goal.radius if goal else 0.05)

    def find(
        self, problem: Problem, wider: float = 0.0, limits: TouchLimits | None = None
    ) -> Plan:
        """See `PlannerSection.find`."""
        return Plan(
            PlanOutcome.FOUND,
            "the path is given",
            self._path(problem.start, problem.footprint),
            problem=problem,
        )

    def _path(self, start: Pose, footprint: Footprint) -> tuple[Segment, ...]:
        return path_from_arcs(
            start,
            [(turn / self.step_m, self.step_m) for turn in self.turns_rad],
            footprint,
        )


PlannerFile = Annotated[BestFirstFile | GivenFile, Field(discriminator="kind")]
PLANNER_FILES: dict[str, type[PlannerSection]] = {
    get_args(section.model_fields["kind"].annotation)[0]: section
    for section in (BestFirstFile, GivenFile)
}
"""Section classes, keyed by kind of planner."""


@dataclass(frozen=True)
class ScenarioPlanner:
    """Planner configured by a scenario.

    Attributes:
        footprint: measured footprint, with all turns and without margin.
        problem: problem whose footprint has a reduced range of turns and includes the
            margin.
    """

    file: PlannerSection
    footprint: Footprint
    problem: Problem
    margin: Margin
    touch_limits: TouchLimits | None = None

    def plan(self) -> Plan:
        """Return the plan, which is computed only once and then cached."""
        return _plan(self)

    def plan_uncached(self) -> Plan:
        """Compute the plan without using the cache."""
        wider = max(self.margin.lead_in - self.margin.path, 0.0)
        return self.file.find(self.problem, wider, self.touch_limits)

    def plan_from(self, pose: Pose, fraction: float = 1.0) -> Plan:
        """Return a plan that starts at another pose, with a fraction of the margin."""
        # A new plan needs no lead-in, because the gait is already steady.
        file = self.file.model_copy(update={"lead_in_m": 0.0})
        body = validate_footprint(
            self.footprint.reduced(file.turn_fraction, fraction * self.margin.path)
        )
        return _plan(
            replace(
                self,
                file=file,
                problem=replace(self.problem, start=pose, footprint=body),
            )
        )


@lru_cache(maxsize=16)
def _plan(planner: ScenarioPlanner) -> Plan:
    return planner.plan_uncached()


def _input_files(section: Mapping[str, object]) -> Iterator[str]:
    if isinstance(name := section.get("footprint"), str):
        try:
            yield str(find_file("footprint", name))
        except InputError:
            yield name


PLANNER = SectionEntry(
    PlannerFile | None,
    "Planner that computes the path to the goal (controller.kind: follow).",
    _input_files,
    {"footprint": "footprint"},
)
