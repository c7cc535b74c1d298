"""Sections that extensions add to a scenario.

When a scenario is loaded, each section reads its keys and files and returns a product, for example a planner
or a recording. The products are stored in `Scenario.products` by the name of the section.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from srs_twin.extensions import SECTIONS, load, objects
from srs_twin.io.documents import Document
from srs_twin.pneumatics import Pneumatics
from srs_twin.robot.file import RobotFile
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.scenario.controllers import Contradiction, FileSections
from srs_twin.scenario.fields import Section
from srs_twin.trajectory import Trajectory


@dataclass
class Loading:
    """State of loading a scenario.

    Attributes:
        document: scenario file; collects the problems.
        file: validated sections.
        robot: robot file with overrides.
        world: obstacles, bounds and goal.
        products: products so far, by section.
        warnings: warnings for the user.
    """

    document: Document
    file: FileSections
    robot: RobotFile
    world: World
    products: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


class ExtensionSection(Section):
    """Base class of sections that extensions add to a scenario; by default its methods do nothing.

    Attributes:
        measures: whether the product contains a measured trajectory.
        uses_goal: whether the section uses the goal and bounds of the world.
    """

    measures: ClassVar[bool] = False
    uses_goal: ClassVar[bool] = False

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """Yield contradictions with other sections of the file."""
        return iter(())

    def read(self, loading: Loading) -> Any:
        """Return the product; called before the controller is checked. Report problems to the document."""
        return None

    def prepare(self, loading: Loading) -> Any:
        """Return the product; called after all other sections. Problems are reported to the document."""
        return None

    def resolve(self, document: dict[str, Any], file: FileSections, product: Any) -> None:
        """Write defaults and absolute paths into the resolved document; the product may be None."""

    def chambers(self, product: Any, robot: RobotSpec, supply_pa: float, layout: str) -> Pneumatics | None:
        """Return chambers that replace those of `pneumatics`, or None."""
        return None

    def measured(self, product: Any) -> Trajectory | None:
        """Return the measured trajectory, or None."""
        return None

    def check_run(self, product: Any) -> None:
        """Check that a run can start.

        Raises:
            InputError: the run cannot start.
        """


def _no_files(section: Mapping[str, Any]) -> Iterator[str]:
    return iter(())


@dataclass(frozen=True)
class SectionEntry:
    """Registry entry of a section.

    Attributes:
        annotation: type of the section in the pydantic model of the file.
        description: description for the reference and the JSON Schema.
        input_files: function of a section as plain data; yields the paths of the files that the section
            reads.
    """

    annotation: Any
    description: str
    input_files: Callable[[Mapping[str, Any]], Iterator[str]] = _no_files


def section_entries() -> dict[str, SectionEntry]:
    """Return the section entries of the installed extensions by name."""
    return dict(objects(SECTIONS))


def input_files(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the paths of the files that the extension sections of a scenario read.

    Args:
        document: plain data of the scenario.
    """
    for name, entry in SECTIONS.items():
        if isinstance(section := document.get(name), Mapping):
            yield from load(entry).input_files(section)
