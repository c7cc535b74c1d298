"""Base classes for sections of scenario files, which convert keys with units to SI.

The name of a key ends with a unit, as in ``frequency_hz``, ``k_per_rad`` and
``distance_mm``. A section passes the values to a constructor whose parameters have the
same names without units, such as ``frequency``, ``k`` (or ``K``) and ``distance``. If a
file omits a key, the default of the constructor is used.

The docstring of a key is the description of the key in JSON Schemas. The unit and the
range of a number are appended, and ``{default}`` is replaced with the default of the
constructor.

When a scenario is loaded, each extension section reads its keys and files and returns a
product, for example a planner or a recording. `Scenario.products` stores the products,
keyed by section name.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol, Self

from pydantic import ConfigDict, Field, model_validator

from srs_twin.extensions import SECTIONS, load
from srs_twin.io.documents import Document, Loc
from srs_twin.io.validation import StrictModel, attribute_docstrings
from srs_twin.robot.sourced import from_si, split_unit, to_si

if TYPE_CHECKING:
    from srs_twin.pneumatics import Pneumatics
    from srs_twin.robot.file import RobotFile
    from srs_twin.robot.spec import RobotSpec
    from srs_twin.robot.world import World
    from srs_twin.trajectory import Trajectory

Line = Annotated[str, Field(min_length=1, max_length=200)]
PathOrName = Annotated[str, Field(min_length=1, max_length=4096)]
FilePath = Annotated[str, Field(min_length=1, max_length=1000)]


def quantity(
    low: float, high: float, default: object = ..., *, unit: str | None = None
) -> Any:
    """Define a bounded number in a `Section`.

    Args:
        low: minimum allowed value.
        high: maximum allowed value.
        default: default value. If omitted, the default of the constructor is used, or
            the key is required if the constructor has no default.
        unit: unit of the number, if the name of the key contains no unit.
    """
    options = {} if default is ... else {"default": default}
    extra = {"unit": unit} if unit else None
    return partial(Field, ge=low, le=high, json_schema_extra=extra, **options)


def constructor_default() -> Any:
    """Return a field that uses the default of the constructor."""
    return partial(Field)


def _describe(schema: dict[str, Any], cls: type[Section]) -> None:
    for key, description in attribute_docstrings(cls).items():
        node = schema["properties"][key]
        node |= {
            "title": description.partition(";")[0].rstrip("."),
            "description": description,
        }
        for bounds in (node, *node.get("anyOf", ())):
            if "minimum" in bounds:
                parameter = cls.parameter(key)
                title = description.rstrip(".").format(
                    default=from_si(key, parameter and parameter.default)
                )
                unit = node.setdefault("unit", split_unit(key)[1])
                range_text = f"{bounds['minimum']:.10g} to {bounds['maximum']:.10g}"
                in_unit = "" if unit == "1" else f" in {unit}"
                node["title"] = title
                node["description"] = f"{title}{in_unit}, {range_text}."


class Section(StrictModel):
    """Group of keys in a file, with units and bounds.

    Attributes:
        constructors: constructors whose parameters the keys set. The method `build`
            calls the first constructor. If several constructors have a parameter with
            the same name, the first of them determines the default.
        parameters: parameters of the constructors, keyed by name in lower case.
        only: names of keys that are allowed only if another key has a given value,
            keyed by this other key and the value.
    """

    model_config = ConfigDict(json_schema_extra=_describe)

    constructors: ClassVar[tuple[Callable[..., Any], ...]] = ()
    parameters: ClassVar[dict[str, inspect.Parameter]] = {}
    only: ClassVar[dict[tuple[str, str], tuple[str, ...]]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        signatures = [
            inspect.signature(function).parameters
            for function in reversed(cls.constructors)
        ]
        cls.parameters = {
            name.lower(): p for signature in signatures for name, p in signature.items()
        }
        for key, value in list(vars(cls).items()):
            if isinstance(value, partial):
                parameter = cls.parameter(key)
                options = {}
                if parameter and parameter.default is not parameter.empty:
                    options = {"default": parameter.default}
                setattr(cls, key, Field(**options | value.keywords))

    @classmethod
    def parameter(cls, key: str) -> inspect.Parameter | None:
        """Return the constructor parameter that a key sets, or None."""
        return cls.parameters.get(key) or cls.parameters.get(split_unit(key)[0])

    @model_validator(mode="after")
    def _is_applicable(self) -> Self:
        for (key, required), names in self.only.items():
            present = [name for name in names if getattr(self, name) is not None]
            if present and getattr(self, key) != required:
                raise ValueError(
                    f"`{present[0]}` is allowed only with `{key}: {required}`; set"
                    f" `{key}: {required}`, or remove `{present[0]}`"
                )
        return self

    def arguments(self, *constructors: Callable[..., object]) -> dict[str, Any]:
        """Return the arguments of the constructors in SI units.

        A key whose value is None is omitted if the constructor has a default. If
        `constructors` is empty, all constructors of the section are used.
        """
        known = {
            name
            for function in constructors
            for name in inspect.signature(function).parameters
        }
        arguments = {}
        for key, value in self:
            parameter = self.parameter(key)
            if parameter is None or (constructors and parameter.name not in known):
                continue
            if not (value is None and parameter.default is not parameter.empty):
                arguments[parameter.name] = to_si(key, value)
        return arguments

    def build(self) -> Any:
        """Return the object that the section describes."""
        return self.build_with()

    def build_with(self, **context: object) -> Any:
        """Return the object that the section describes.

        Args:
            context: further constructor arguments, which are ignored if the constructor
                does not accept them.
        """
        given = {
            name: value for name, value in context.items() if name in self.parameters
        }
        return self.constructors[0](**given, **self.arguments())

    def written(self) -> dict[str, object]:
        """Return the section as plain data with all defaults."""
        return self.model_dump(mode="json", exclude_none=True, by_alias=True)

    def with_scaled_defaults(self, keys: Iterable[str], factor: float) -> Self:
        """Return the section with the defaults of some keys multiplied by a factor.

        Values that the file sets are not changed.
        """
        changed: dict[str, object] = {}
        for key in set(keys) - self.model_fields_set:
            value = getattr(self, key)
            if isinstance(value, tuple):
                changed[key] = tuple(factor * x for x in value)
            else:
                changed[key] = factor * value
        copied = self.model_copy()
        copied.__dict__.update(
            changed
        )  # `model_fields_set` must contain only the keys of the file
        return copied

    def with_defaults(self, *keys: str) -> Self:
        """Return the section with constructor defaults for `keys` that are None."""
        missing = {
            key: self.parameter(key) for key in keys if getattr(self, key) is None
        }
        return self.model_copy(
            update={key: from_si(key, p.default) for key, p in missing.items() if p}
        )


class Contradiction(NamedTuple):
    """Contradiction between keys of a scenario.

    Attributes:
        loc: path of a key in the file.
        text: message for the user.
        at_key: whether the message points to the key instead of the value.
    """

    loc: Loc
    text: str
    at_key: bool = False


class FileSections(Protocol):
    """Attributes of `scenario.file.ScenarioFile` that sections may read."""

    bench: bool
    seed: int
    duration_s: float
    controller: Any
    start: Any
    world: Any
    pneumatics: Any
    plants: Any

    @property
    def model_fields_set(self) -> set[str]:
        """Names of the fields set in the file."""

    def section(self, name: str) -> Any:
        """Return an extension section, or None if the file does not contain it."""


@dataclass
class Loading:
    """State of a scenario while it is loaded.

    Attributes:
        document: scenario file, which also collects problems.
        file: validated sections.
        robot: robot file with overrides applied.
        world: obstacles, bounds and goal.
        products: products of the sections read so far, keyed by section name.
        warnings: warnings for the user.
        supply_pa: gauge supply pressure, Pa.
        layout: valve layout, "3/2" or "in_out".
        initial_state: initial state of the plants (`start.InitialState`), or None for a
            straight snake at rest.
    """

    document: Document
    file: FileSections
    robot: RobotFile
    world: World
    products: dict[str, object] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    supply_pa: float = 0.0
    layout: str = ""
    initial_state: Any = None


class ExtensionSection(Section):
    """Base class of sections that extensions add to a scenario.

    Attributes:
        measures: whether the product contains a measured trajectory.
        uses_goal: whether the section uses the goal and bounds of the world.
    """

    measures: ClassVar[bool] = False
    uses_goal: ClassVar[bool] = False

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """Yield contradictions with other sections of the file."""
        return iter(())

    def read(self, loading: Loading) -> object:
        """Read the section and return the product.

        This method is called before the controller is checked. It reports problems to
        `loading.document`.
        """
        return None

    def prepare(self, loading: Loading) -> object:
        """Return the product if `read` returned None.

        This method is called after all sections have been read.
        """
        return None

    def resolve(
        self, document: dict[str, Any], file: FileSections, product: Any
    ) -> None:
        """Write defaults and absolute paths into the resolved document."""

    def chambers(
        self, product: Any, robot: RobotSpec, supply_pa: float, layout: str
    ) -> Pneumatics | None:
        """Return chambers that replace those of the section `pneumatics`, or None."""
        return None

    def measured(self, product: Any) -> Trajectory | None:
        """Return the measured trajectory that a product contains, or None."""
        return None

    def check_run(self, product: Any) -> None:
        """Raise an `InputError` if a run cannot start."""


def _no_files(section: Mapping[str, object]) -> Iterator[str]:
    return iter(())


@dataclass(frozen=True)
class SectionEntry:
    """Registry entry of an extension section.

    Attributes:
        annotation: type in the pydantic model of the file.
        description: description for the reference pages and the JSON Schema.
        input_files: function that takes the section as plain data and yields the paths
            of the files that the section reads.
        paths: kind of shipped files (see `Document.locate`) for each key that contains
            a file name.
    """

    annotation: object
    description: str
    input_files: Callable[[Mapping[str, object]], Iterator[str]] = _no_files
    paths: Mapping[str, str] = field(default_factory=dict)


_CORE_PATHS: dict[Loc, str] = {
    ("robot",): "robot",
    ("robot", "base"): "robot",
    ("world", "map"): "",
    ("world", "circles"): "",
    ("start", "from"): "",
}


def path_fields(sections: Container[str]) -> dict[Loc, str]:
    """Return the kind of shipped file for each field that contains a file name.

    The extensions that define `sections` are imported.
    """
    used = (name for name in SECTIONS if name in sections)
    entries = {name: load(SECTIONS[name]) for name in used}
    more = {
        (name, key): kind
        for name in entries
        for key, kind in entries[name].paths.items()
    }
    return _CORE_PATHS | more


def input_files(document: Mapping[str, object]) -> Iterator[str]:
    """Yield the paths of the files that the extension sections of a scenario read."""
    for name, entry in SECTIONS.items():
        if isinstance(section := document.get(name), Mapping):
            yield from load(entry).input_files(section)
