"""Sections that extensions add to a scenario.

A section is read when the scenario is loaded. What it makes of its keys and files, its product, is kept in
`Scenario.products` under the name of the section.
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
    """A scenario while it is loaded.

    Attributes:
        document: the file; problems are reported to it.
        file: the validated sections.
        robot: the robot file, overrides included.
        world: obstacles, bounds and goal.
        products: section → what it made so far.
        warnings: for the user, before the results.
    """

    document: Document
    file: FileSections
    robot: RobotFile
    world: World
    products: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


class ExtensionSection(Section):
    """A section of a scenario that an extension adds. Each hook does nothing by default.

    Attributes:
        measures: whether its product holds a measured trajectory to compare with.
        uses_goal: whether it takes notice of the goal and bounds of the world.
    """

    measures: ClassVar[bool] = False
    uses_goal: ClassVar[bool] = False

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """Yield what contradicts other sections of the file."""
        return iter(())

    def read(self, loading: Loading) -> Any:
        """Return the product; called before the controller is checked. Problems are reported."""
        return None

    def prepare(self, loading: Loading) -> Any:
        """Return the product; called once everything else of the file is sound. Problems are reported."""
        return None

    def resolve(self, document: dict[str, Any], file: FileSections, product: Any) -> None:
        """Write defaults and absolute paths into the resolved document; product: None if it was not read."""

    def chambers(self, product: Any, robot: RobotSpec, supply_pa: float, layout: str) -> Pneumatics | None:
        """Return chambers that replace the ones of `pneumatics`."""
        return None

    def measured(self, product: Any) -> Trajectory | None:
        """Return the measured trajectory."""
        return None

    def check_run(self, product: Any) -> None:
        """Refuse a run that cannot start, before anything is simulated.

        Raises:
            InputError: it cannot start.
        """


def _no_files(section: Mapping[str, Any]) -> Iterator[str]:
    return iter(())


@dataclass(frozen=True)
class SectionEntry:
    """Registry entry of a section.

    Attributes:
        annotation: type of the section in the pydantic model of the file.
        description: for the reference and the JSON Schema.
        input_files: yields the paths of the files that a section, as plain data, reads.
    """

    annotation: Any
    description: str
    input_files: Callable[[Mapping[str, Any]], Iterator[str]] = _no_files


def section_entries() -> dict[str, SectionEntry]:
    """Return name → entry of the sections of the installed extensions."""
    return dict(objects(SECTIONS))


def input_files(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the paths of the files that the extension sections of a scenario read.

    Args:
        document: plain data of the scenario.
    """
    for name, entry in SECTIONS.items():
        if isinstance(section := document.get(name), Mapping):
            yield from load(entry).input_files(section)
